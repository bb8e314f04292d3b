"""A spinning lidar on a robot: where it looks, from where, and what it measures."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.simulation import rays
from stillmap.simulation.ground import Ground
from stillmap.simulation.lidar_options import GroundOptions, LidarOptions
from stillmap.simulation.rays import Echoes, Rays
from stillmap.simulation.scene import Scene
from stillmap.simulation.solids import BOX, Faces, Part, assembled

Float = NDArray[np.float64]

ROBOT = -2  # the mover's number of the robot itself
_ROOF = 0.35  # m, from the lidar down to it


class Pattern(NamedTuple):
    """The beams of one turn, in the frame of the sensor.

    Attributes:
        azimuth: (n,) rad, rising, of the columns.
        elevation: (C,) rad, rising, of the channels.
        direction: (3, n, C) of length one.
        seconds: (n,) after the scan's stamp, when each column looks.
    """

    azimuth: Float
    elevation: Float
    direction: Float
    seconds: Float

    @classmethod
    def of(cls, o: LidarOptions) -> "Pattern":
        """That of a lidar that turns to the left and begins each turn behind it."""
        share = np.arange(o.columns) / o.columns
        azimuth = -np.pi + 2 * np.pi * share
        elevation = np.linspace(*o.field, o.channels)
        flat, up = np.cos(elevation), np.sin(elevation)
        direction = np.stack(
            [
                np.cos(azimuth)[:, None] * flat,
                np.sin(azimuth)[:, None] * flat,
                np.broadcast_to(up, (o.columns, o.channels)),
            ]
        )
        seconds = share / o.rate if o.sweep else np.zeros(o.columns)
        return cls(azimuth, elevation, direction, seconds)


def matrix(xyz: Float, roll: Float, pitch: Float, yaw: Float) -> Float:
    """(..., 4, 4) poses: turned by roll about x, then pitch about y, then yaw about z, in rad.

    Args:
        xyz: (..., 3) metres.
        roll, pitch, yaw: (...) rad; a positive pitch is nose down.
    """
    (a, b, c), (u, v, w) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    T = np.zeros((*np.shape(yaw), 4, 4))
    T[..., 0, :3] = np.stack([c * b, c * v * u - w * a, c * v * a + w * u], axis=-1)
    T[..., 1, :3] = np.stack([w * b, w * v * u + c * a, w * v * a - c * u], axis=-1)
    T[..., 2, :3] = np.stack([-v, b * u, b * a], axis=-1)
    T[..., :3, 3], T[..., 3, 3] = xyz, 1.0
    return T


def ridden(robot: Float, ground: Ground, o: LidarOptions, rng: np.random.Generator) -> Float:
    """(T, 6) x, y, z, roll, pitch, yaw of a robot that stands on the ground and shakes.

    Args:
        robot: (T, 3) x, y, theta in the plan.
        ground: what it stands on.
        o: how much it shakes.
        rng: how it shakes.
    """
    x, y, yaw = robot.T
    gx, gy = ground.gradient(x, y)
    ahead, left = gx * np.cos(yaw) + gy * np.sin(yaw), gy * np.cos(yaw) - gx * np.sin(yaw)
    shaking = rng.standard_normal((3, len(robot)))
    shaking *= np.array([[o.vibration_roll], [o.vibration_pitch], [o.vibration_z]])
    pitch = -np.arctan(ahead) + shaking[1]
    roll = np.arctan(left * np.cos(np.arctan(ahead))) + shaking[0]
    return np.stack([x, y, ground.height(x, y) + shaking[2], roll, pitch, yaw], axis=-1)


def mounted(o: LidarOptions) -> Float:
    """(4, 4) T_base_sensor."""
    return matrix(np.array([o.x, o.y, o.z]), *np.array([0.0, o.pitch, o.yaw]))


def looking(pattern: Pattern, T_world_sensor: Float) -> Rays:
    """The beams of one turn in the world.

    Args:
        pattern: the same in the sensor's frame.
        T_world_sensor: (n, 4, 4) where the sensor is when each column looks, or (1, 4, 4).
    """
    n = len(pattern.azimuth)
    R = T_world_sensor[:, :3, :3]
    turned = np.einsum("nij,jnc->inc", np.broadcast_to(R, (n, 3, 3)), pattern.direction)
    upright = np.arccos(np.clip(R[:, 2, 2], -1.0, 1.0)).max()
    steepest = np.abs(pattern.elevation).max(initial=0.0)
    off = np.tan(upright) * np.tan(steepest) * 1.1 + upright**2 if upright > 1e-9 else 0.0
    # the column's azimuth is that of a beam in it without elevation
    a, b = R[:, 0, 0], R[:, 1, 0]
    heading = np.unwrap(np.arctan2(b, a))
    azimuth = np.maximum.accumulate(pattern.azimuth + heading)
    origin = np.broadcast_to(T_world_sensor[:, :3, 3].T[:, :, None], (3, n, 1))
    return Rays(origin, turned, azimuth, float(off), pattern.elevation, float(upright) + 1e-9)


def own_body(scene: Scene, pattern: Pattern) -> Echoes:
    """What of the robot itself its lidar sees: a box as long and wide as its footprint."""
    o, radius = scene.lidar, scene.robot.radius
    top = max(o.z - _ROOF, 0.1)
    box = assembled([(0, ROBOT, Part(BOX, 0.0, 0.0, (radius, 0.8 * radius), (0.0, top)))])
    body = box.at(np.zeros((1, 1, 3)), np.zeros((1, 1)))
    nothing = Faces(np.empty((0, 4)), np.empty((0, 2)), np.empty(0, bool))
    below = Ground.of(GroundOptions(), np.empty((0, 4)))
    seen = rays.cast(looking(pattern, mounted(o)[None]), nothing, [body], below, None)
    range = np.where(seen.mover == ROBOT, seen.range, np.inf)
    return seen._replace(range=range)


def measure(
    exact: Echoes, o: LidarOptions, rng: np.random.Generator
) -> tuple[Float, NDArray[np.bool_]]:
    """Measured ranges (n, C) and whether something came back (n, C).

    Args:
        exact: what the beams meet.
        o: noise and losses. A beam without return gets o.max_range.
        rng: noise and losses.
    """
    lost = rng.random(exact.range.shape)
    noisy = exact.range + o.range_noise * rng.standard_normal(exact.range.shape)
    share = o.no_return_share + exact.on_glass * o.glass_no_return_share
    hit = (noisy < o.max_range) & (lost >= share)
    return np.where(hit, np.maximum(noisy, 1e-3), o.max_range), hit


def planar(poses: Float) -> Float:
    """(T, 4, 4) of poses (T, 3, 3) in the plane."""
    x, y, yaw = se2.parameters(poses).T
    still = np.zeros_like(x)
    return matrix(np.stack([x, y, still], axis=-1), still, still, yaw)
