"""Simulation of a recording: motion, odometry, sensors and cameras."""

import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.sim import laser, lidar, mirrors, mishaps, recorder
from stillmap.sim.camera import CameraSimulator
from stillmap.sim.dynamics import Moment, Motion, Progress
from stillmap.sim.episode import Episode, simulate_episode
from stillmap.sim.laser import Float, Returns
from stillmap.sim.options import LaserOptions
from stillmap.sim.recorder import World
from stillmap.sim.scene import Scene
from stillmap.sim.truth import ImageTruth, Truth

_MOTION_SHARE = 0.7  # of the computing time, for progress
_MOTION_SHARE_3D = 0.05  # the same with a lidar
_MAX_GROUPS = 64  # of simultaneous beams per scan
_BLOCK = 1000  # groups of beams processed at once
_MAX_SIGMAS = 10.0  # of a range


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated recording with its truth.

    Attributes:
        scene: the world and all parameters.
        recording: the recording; its images are rendered on access.
        truth: of the beams.
        photographs: the camera images with their truth; None without cameras.
        surfaces: the truth about images and surfaces.
    """

    scene: Scene
    recording: Recording
    truth: Truth
    photographs: CameraSimulator | None = None
    surfaces: ImageTruth | None = None


@dataclass(frozen=True, eq=False)
class RigSimulation:
    """Recordings of a horizontal and a tilting laser in the same world, on one clock.

    Attributes:
        horizontal: the first, in 2D.
        tilting: the second, in 3D; its points are in the frame of the pivot, not of the joint.
        joint_angle: (T,) rad at each stamp of `tilting`, nose down.
    """

    horizontal: Simulation
    tilting: Simulation
    joint_angle: Float


def simulate(
    scene: Scene,
    rng: np.random.Generator | int = 0,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Simulation:
    """Simulate the recording of a scene.

    People, laser, odometry, doors, vehicles and mishaps have random generators of their own,
    spawned from `rng`, so that another laser or odometry does not change the motion.

    A door, vehicle or movable object that never moves during the recording counts as a wall.

    Args:
        scene: the world and all parameters. With a lidar the recording and its truth are in 3D.
        rng: generator or seed. The same seed gives the same recording to the bit.
        progress: called with the completed share, 0 to 1.
        scratch: folder for arrays of a lidar that exceed memory; None: the system's temporary
            folder.

    Raises:
        InputError: no room for the robot on its route or for the people, or the robot is held up;
            or two lasers record, see `simulate_rig`.
        OSError: the disk is full.
    """
    if scene.rig.tilts:
        raise InputError("a rig of two lasers makes two recordings", hint="simulate_rig")
    share = _MOTION_SHARE_3D if scene.in_3d else _MOTION_SHARE
    first, rest = _partial_progress(0.0, share, progress), _partial_progress(share, 1.0, progress)
    happening = simulate_episode(scene, np.random.default_rng(rng), first)
    if scene.in_3d:
        world, sensor = World.of(happening), lidar.make_spinning_lidar(scene)
        recorded = recorder.record(world, sensor, happening.sensor_rng, rest, scratch)
        made = _with_images(world, *recorded)
    else:
        recording, mover, thing = _record(happening)
        static, T_world_base = recording.hit & (mover == -1), se2.matrix(*happening.motion.robot.T)
        mount = _mounts(scene.laser, (scene.laser.x, scene.laser.y, scene.laser.yaw))
        wrong = None if np.array_equal(mount, recording.T_base_sensor) else mount
        truth = happening.truth(static, mover, T_world_base, T_base_sensor=wrong, thing=thing)
        made = Simulation(scene, recording, truth)
    rest(1.0)
    return made


def simulate_rig(
    scene: Scene,
    rng: np.random.Generator | int = 0,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> RigSimulation:
    """Simulate the recordings of a robot with a horizontal and a tilting laser.

    Arguments and errors are those of `simulate`; `scene.rig.tilts` must be set.
    """
    if not scene.rig.tilts:
        raise InputError("no laser of the scene tilts", hint="rig.tilts=true")
    ends = (0.0, _MOTION_SHARE_3D, (1 + _MOTION_SHARE_3D) / 2, 1.0)
    first, second, third = (_partial_progress(*part, progress) for part in itertools.pairwise(ends))
    happening = simulate_episode(scene, np.random.default_rng(rng), first)
    world, (flat, tilted) = World.of(happening), lidar.make_rig_lasers(scene)
    below = recorder.record(world, flat, happening.sensor_rng, second, scratch)
    above = recorder.record(world, tilted, happening.body_rng, third, scratch)
    # images belong to the 3D recording
    horizontal, tilting = Simulation(scene, *below), _with_images(world, *above)
    third(1.0)
    stamps = np.arange(len(happening.motion.robot)) / scene.scan_rate
    return RigSimulation(horizontal, tilting, lidar.compute_joint_angle(stamps, scene.rig))


def _with_images(world: World, recording: Recording, truth: Truth) -> Simulation:
    """A 3D recording with the images of the scene's cameras, if there are any."""
    scene = world.happening.scene
    if not scene.camera.enabled:
        return Simulation(scene, recording, truth)
    photographs = CameraSimulator(world)
    recording = replace(recording, images=photographs.images)
    return Simulation(scene, recording, truth, photographs, photographs.truth())


def _record(
    happening: Episode,
) -> tuple[Recording, NDArray[np.int32], NDArray[np.int32] | None]:
    """The recording of a planar laser, and the mover and thing (M,) that reflected each beam."""
    scene, motion, walls = happening.scene, happening.motion, happening.walls
    o, T = scene.laser, len(motion.robot)
    sensor = np.arange(T, dtype=np.int32) % o.count
    T_base_sensor = _mounts(o, (o.x, o.y, o.yaw))[sensor]
    exact = cast_sweeps(motion, walls, T_base_sensor, o)
    angles = laser.compute_beam_angles(o.beams, o.fov)
    bearing = se2.parameters(T_base_sensor)[:, 2:]
    bearing = bearing + (angles if o.upside_down == "no" else -angles)
    exact = _add_mirrors(exact, happening, T_base_sensor, bearing)
    exact = _add_bumps(exact, happening, bearing)
    on_glass = laser.find_glass(exact.wall, scene)
    ranges, hit = laser.simulate_measurement(exact.range, on_glass, o, happening.sensor_rng)
    blind = mishaps.find_blind_scans(motion.seconds, o, happening.mishap_rng)
    ranges[blind], hit[blind] = o.max_range, False
    if o.upside_down == "known":
        angles = -angles
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    recording = Recording(
        stamp_ns=happening.stamp_ns,
        offset=np.arange(T + 1, dtype=np.int64) * o.beams,
        points=points.reshape(-1, 2).astype(np.float32),
        hit=hit.ravel(),
        T_base_sensor=_mounts(o, o.recorded_mount),
        sensor=sensor,
        T_odom_base=happening.T_odom_base,
        source=happening.source(_sensor_records(o, angles)),
        beam_time=np.tile(Sweep.of(o).beam_times(o.beams), T) if o.sweep_time > 0 else None,
    )
    mover = np.where(hit, exact.mover, np.int32(-1)).ravel()
    return recording, mover, _find_standing_things(exact, hit, happening)


def _find_standing_things(
    exact: Returns, hit: NDArray[np.bool_], happening: Episode
) -> NDArray[np.int32] | None:
    """(M,) index of the movable object, standing still, that each beam (T, n) hit; -1: none."""
    if not happening.has_standing_things:
        return None
    scene, still_thing = happening.scene, happening.motion.still_thing
    first = len(scene.walls) + len(scene.glass)
    of_wall = np.full(len(happening.walls), -1, np.int32)
    of_wall[first : first + len(still_thing)] = still_thing
    stands = hit & (exact.mover == -1) & (exact.wall >= 0)
    return np.where(stands, of_wall[exact.wall], np.int32(-1)).ravel()


def _mounts(o: LaserOptions, pose: tuple[float, float, float]) -> Float:
    """(S, 3, 3) T_base_sensor of the lasers, the first of which is at x, y, yaw."""
    front = se2.matrix(*pose)
    return np.stack([front, se2.matrix(0.0, 0.0, np.pi) @ front][: o.count])


def _add_mirrors(
    exact: Returns, happening: Episode, T_base_sensor: Float, bearing: Float
) -> Returns:
    """Returns (T, n) with what mirrors show, of beams at bearings (T, n) in the base frame."""
    scene, motion, walls = happening.scene, happening.motion, happening.walls
    if not scene.mirrors:
        return exact
    o, rng = scene.laser, happening.mishap_rng
    by = exact.wall >= len(walls) - len(scene.mirrors)
    by &= rng.random(by.shape) >= o.mirror_return_share
    seconds = Sweep.of(o).beam_times(o.beams).astype(np.float64)
    geometry = (walls, T_base_sensor, bearing, seconds, scene.robot.radius)
    return mirrors.reflect_beams(exact, by, motion, *geometry)


def _add_bumps(exact: Returns, happening: Episode, bearing: Float) -> Returns:
    """Returns (T, n) with the floor where bumps show it, at bearings (T, n) in the base frame."""
    o, motion, rng = happening.scene.laser, happening.motion, happening.mishap_rng
    bumps = mishaps.simulate_bumps(motion.robot, motion.seconds, happening.scene.robot, rng)
    if not len(bumps.start):
        return exact
    sweep = Sweep.of(o)
    tilt = bumps.tilt(motion.seconds[:, None] + sweep.seconds)
    tilt = np.repeat(tilt, sweep.group, axis=1)[:, : o.beams]
    return mishaps.add_floor(exact, bearing, tilt, o.height)


@dataclass(frozen=True, eq=False)
class Sweep:
    """Times of the beams of a scan.

    Attributes:
        group: number of simultaneous beams; the last group may be smaller.
        seconds: (G,) after the scan's stamp, of each group.
    """

    group: int
    seconds: Float

    @classmethod
    def of(cls, options: LaserOptions) -> "Sweep":
        """The sweep of a laser: times proportional to the beam angles."""
        n = options.beams
        if options.sweep_time == 0:
            return cls(n, np.zeros(1))
        group = max(2, math.ceil(n / _MAX_GROUPS))
        first = np.arange(0, n, group)
        middle = (first + np.minimum(first + group, n) - 1) / 2
        angles = laser.compute_beam_angles(n, options.fov)
        share = middle * (angles[1] - angles[0]) / options.fov
        return cls(group, options.sweep_time * share)

    def beam_times(self, beams: int) -> NDArray[np.float32]:
        """(n,) seconds after the stamp, of each beam of a scan."""
        return np.repeat(self.seconds, self.group)[:beams].astype(np.float32)


def cast_sweeps(motion: Motion, walls: Float, T_base_sensor: Float, o: LaserOptions) -> Returns:
    """The nearest surface on every beam of every scan.

    Args:
        motion: of T scans.
        walls: (W, 4) segments in metres.
        T_base_sensor: (T, 3, 3) pose of the laser of each scan.
        o: the lasers.

    Returns:
        Beams in the order of the scan: from the last angle to the first if the laser is mounted
        upside down.
    """
    sweep, angles = Sweep.of(o), laser.compute_beam_angles(o.beams, o.fov)
    T, G = len(motion.robot), len(sweep.seconds)
    reach = o.max_range + _MAX_SIGMAS * o.range_noise
    # a group of beams is cast as a scan of its own, rotated to the angles of the first group
    turned, group = np.arange(G) * sweep.group * (angles[1] - angles[0]), angles[: sweep.group]
    order = slice(None)
    if o.upside_down != "no":
        turned, group, order = -turned, -group[::-1], slice(None, None, -1)
    block = max(1, _BLOCK // G)
    parts = []
    for first in range(0, T, block):
        scans = np.arange(first, min(first + block, T))
        now = Moment(motion, np.repeat(scans, G), np.tile(sweep.seconds, len(scans)))
        T_robot_sensor = np.repeat(T_base_sensor[scans], G, axis=0)
        poses = se2.parameters(se2.matrix(*now.interpolate(motion.robot).T) @ T_robot_sensor)
        poses[:, 2] += np.tile(turned, len(scans))
        part = laser.cast_beams(poses, group, walls, *now.interpolate_movers(), reach)
        in_order = (values[:, order].reshape(-1, G * sweep.group) for values in part)
        parts.append([values[:, : o.beams] for values in in_order])
    return Returns(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _sensor_records(o: LaserOptions, angles: Float) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "beams_per_scan": len(angles),
            "start_angle": float(angles[0]),
            "angle_step": float(angles[1] - angles[0]),
        }
        for name in ("simulated laser", "simulated rear laser")[: o.count]
    ]


def _partial_progress(first: float, last: float, tell: Progress | None) -> Progress:
    """Progress of a part of the whole."""
    return lambda share: tell(first + (last - first) * share) if tell else None
