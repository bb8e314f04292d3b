"""3D sensors: beam patterns, poses and measurements."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Float
from stillmap.sim import laser, ray_casting
from stillmap.sim.dynamics import Moment
from stillmap.sim.geometry import BOX, Part, assemble, make_pose
from stillmap.sim.options import LaserOptions, LidarOptions, RigOptions
from stillmap.sim.ray_casting import RayReturns, Rays
from stillmap.sim.scene import Scene
from stillmap.sim.world_3d import World

ROBOT = -2  # the mover's number of the robot itself


class Pattern(NamedTuple):
    """The beams of one turn, in the frame of the sensor.

    Attributes:
        azimuth: (n,) rad, rising, of the columns.
        elevation: (C,) rad, rising, of the channels.
        direction: (3, n, C) of length one.
        seconds: (n,) time of each column after the stamp.
        off: rad, maximum deviation of a beam from its channel's elevation.
    """

    azimuth: Float
    elevation: Float
    direction: Float
    seconds: Float
    off: float = 0.0

    @classmethod
    def of(cls, o: LidarOptions) -> "Pattern":
        """Pattern of a lidar that turns to the left, from behind."""
        share = np.arange(o.columns) / o.columns
        azimuth = -np.pi + 2 * np.pi * share
        elevation = np.linspace(*o.field, o.channels)
        flat, up = np.cos(elevation), np.sin(elevation)
        x, y = np.cos(azimuth)[:, None] * flat, np.sin(azimuth)[:, None] * flat
        direction = np.stack([x, y, np.broadcast_to(up, x.shape)])
        seconds = share / o.rate if o.sweep else np.zeros(o.columns)
        return cls(azimuth, elevation, direction, seconds)

    @classmethod
    def tilted(cls, o: LaserOptions, joint: Float, seconds: Float) -> "Pattern":
        """Pattern of a planar laser tilted by (n,) rad, nose down, at its beams."""
        angle = laser.compute_beam_angles(o.beams, o.fov)
        ahead, left = np.cos(angle), np.sin(angle)
        direction = np.stack([ahead * np.cos(joint), left, -ahead * np.sin(joint)])
        azimuth = np.unwrap(np.arctan2(direction[1], direction[0]))
        return cls(azimuth, np.zeros(1), direction[..., None], seconds, np.pi)


class Sensor(NamedTuple):
    """A sensor.

    Attributes:
        name: in the recording.
        dimension: of its recording, 2 or 3.
        T_base_sensor: (4, 4).
        options: ranges, noise and losses.
        pattern: the beams of each scan.
        takes_time: whether the beams of a scan have different times.
        leaves_out: whether beams without return are left out.
        own: (n, C) metres to the robot itself; inf: it is not met.
    """

    name: str
    dimension: int
    T_base_sensor: Float
    options: LidarOptions | LaserOptions
    pattern: Callable[[int], Pattern]
    takes_time: bool
    leaves_out: bool = False
    own: Float | None = None

    def cast_rays(self, world: World, pattern: Pattern, scan: int) -> RayReturns:
        """Exact returns of the beams of one scan."""
        scans = np.full(len(pattern.azimuth), scan)
        moment = Moment(world.episode.motion, scans, pattern.seconds)
        rays = transform_rays(pattern, world.T_world_base(moment) @ self.T_base_sensor)
        exact = ray_casting.cast_rays(rays, world.static, world.movers.at(moment, scan))
        if self.own is None:
            return exact
        nearer = self.own < exact.range
        return exact._replace(
            range=np.minimum(self.own, exact.range),
            mover=np.where(nearer, np.int32(ROBOT), exact.mover),
            on_glass=exact.on_glass & ~nearer,
        )


def make_sensors(scene: Scene) -> tuple[Sensor, ...]:
    """The lidar of a scene in 3D, or its two lasers, of which the second tilts."""
    return _make_rig_lasers(scene) if scene.rig.tilts else (_make_spinning_lidar(scene),)


def _make_spinning_lidar(scene: Scene) -> Sensor:
    """The lidar of a scene."""
    o, pattern = scene.lidar, Pattern.of(scene.lidar)
    T = make_pose((o.x, o.y, o.z), 0, o.pitch, o.yaw)
    own = cast_robot_body(scene, pattern, T) if o.sees_robot else None
    leaves_out = o.no_returns == "left out"
    return Sensor("simulated lidar", 3, T, o, lambda _: pattern, o.sweep, leaves_out, own)


def _make_rig_lasers(scene: Scene) -> tuple[Sensor, Sensor]:
    """The laser of a scene, mounted horizontally, and an identical one that tilts."""
    o, rig = scene.laser, scene.rig
    angle = laser.compute_beam_angles(o.beams, o.fov)
    seconds = o.sweep_time * (angle - angle[0]) / o.fov
    flat = Pattern.tilted(o, np.zeros(o.beams), seconds)

    def tilted(scan: int) -> Pattern:
        joint = compute_joint_angle(scan / scene.scan_rate + seconds, rig)
        return Pattern.tilted(o, joint, seconds)

    low = make_pose((o.x, o.y, rig.low_z), 0, 0, o.yaw)
    pivot = make_pose((rig.pivot_x, 0, rig.pivot_z), 0, 0, 0)
    takes_time = o.sweep_time > 0
    return (
        Sensor("simulated laser", 2, low, o, lambda _: flat, takes_time),
        Sensor("simulated tilting laser", 3, pivot, o, tilted, takes_time),
    )


def compute_joint_angle(seconds: Float, rig: RigOptions) -> Float:
    """(...) rad, nose down, of the tilting laser; it starts at the mean, moving down."""
    share = (seconds / rig.period + 0.25) % 1.0
    return np.asarray(rig.middle + rig.amplitude * (1.0 - 4.0 * np.abs(share - 0.5)))


def transform_rays(pattern: Pattern, T_world_sensor: Float) -> Rays:
    """The beams of one turn in the world.

    Args:
        pattern: the beams in the sensor frame.
        T_world_sensor: (n, 4, 4) sensor pose at each column, or (1, 4, 4).
    """
    n = len(pattern.azimuth)
    R = T_world_sensor[:, :3, :3]
    turned = np.einsum("nij,jnc->inc", np.broadcast_to(R, (n, 3, 3)), pattern.direction)
    upright = np.arccos(np.clip(R[:, 2, 2], -1.0, 1.0)).max()
    steepest = np.arcsin(np.minimum(np.abs(pattern.direction[2]).max(initial=0.0), 1.0))
    off = np.tan(upright) * np.tan(steepest) * 1.1 + upright**2 if upright > 1e-9 else 0.0
    # the column's azimuth is that of a beam in it without elevation
    heading = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    azimuth = np.maximum.accumulate(pattern.azimuth + heading)
    origin = np.broadcast_to(T_world_sensor[:, :3, 3].T[:, :, None], (3, n, 1))
    tilt = float(upright) + pattern.off + 1e-9
    return Rays(origin, turned, azimuth, float(off), pattern.elevation, tilt)


def cast_robot_body(scene: Scene, pattern: Pattern, T_base_sensor: Float) -> Float:
    """(n, C) metres to the robot itself: a box as large as its footprint, or as given."""
    o, radius = scene.lidar, scene.robot.radius
    top = max(o.z - o.roof_below, 0.1)
    ahead = radius if o.roof_length is None else 0.5 * o.roof_length
    aside = 0.8 * radius if o.roof_width is None else 0.5 * o.roof_width
    box = assemble([(0, ROBOT, Part(BOX, 0.0, 0.0, (ahead, aside), (0.0, top)))])
    body = box.at(np.zeros((1, 1, 3)), np.zeros((1, 1)))
    rays = transform_rays(pattern, T_base_sensor[None])
    return ray_casting.intersect_solid(rays.origin, rays.direction, body, 0, body.pose[:, 0])
