"""Simulation of a recording: motion, odometry, sensors and cameras."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.sim import laser, lidar, recorder, sweep
from stillmap.sim.camera import CameraSimulator
from stillmap.sim.dynamics import Progress
from stillmap.sim.episode import Episode, simulate_episode
from stillmap.sim.options import LaserOptions
from stillmap.sim.recorder import World
from stillmap.sim.scene import Scene
from stillmap.sim.sweep import Sweep
from stillmap.sim.truth import Truth
from stillmap.sim.truth_images import ImageTruth, make_image_truth

Float = NDArray[np.float64]

_MOTION_SHARE = 0.7  # of the computing time, for progress
_MOTION_SHARE_3D = 0.05  # the same with a lidar


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
    tell, share = progress or _silent, _MOTION_SHARE_3D if scene.in_3d else _MOTION_SHARE
    happening = simulate_episode(
        scene, np.random.default_rng(rng), _partial_progress(0.0, share, tell)
    )
    if scene.in_3d:
        world, sensor = World.of(happening), lidar.make_spinning_lidar(scene)
        rest, own_rng = _partial_progress(share, 1.0, tell), happening.sensor_rng
        made = _with_images(world, *recorder.record(world, sensor, own_rng, rest, scratch))
    else:
        recording, mover = _record(happening)
        static, T_world_base = recording.hit & (mover < 0), se2.matrix(*happening.motion.robot.T)
        made = Simulation(scene, recording, happening.truth(static, mover, T_world_base))
    tell(1.0)
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
    tell, share = progress or _silent, _MOTION_SHARE_3D
    rng = np.random.default_rng(rng)
    happening = simulate_episode(scene, rng, _partial_progress(0.0, share, tell))
    world, (flat, tilted), half = World.of(happening), lidar.make_rig_lasers(scene), (1 + share) / 2
    first, second = _partial_progress(share, half, tell), _partial_progress(half, 1.0, tell)
    below = recorder.record(world, flat, happening.sensor_rng, first, scratch)
    above = recorder.record(world, tilted, happening.body_rng, second, scratch)
    # images belong to the 3D recording
    horizontal, tilting = Simulation(scene, *below), _with_images(world, *above)
    tell(1.0)
    stamps = np.arange(len(happening.motion.robot)) / scene.scan_rate
    return RigSimulation(horizontal, tilting, lidar.compute_joint_angle(stamps, scene.rig))


def _with_images(world: World, recording: Recording, truth: Truth) -> Simulation:
    """A 3D recording with the images of the scene's cameras, if there are any."""
    scene = world.happening.scene
    if not scene.camera.enabled:
        return Simulation(scene, recording, truth)
    photographs = CameraSimulator(world)
    recording = replace(recording, images=photographs.images)
    return Simulation(scene, recording, truth, photographs, make_image_truth(world, photographs))


def _record(happening: Episode) -> tuple[Recording, NDArray[np.int32]]:
    """The recording of a planar laser, and the mover (M,) that reflected each beam."""
    scene, motion, walls = happening.scene, happening.motion, happening.walls
    o, T = scene.laser, len(motion.robot)
    T_base_sensor, sensor = _sensors(o), np.arange(T, dtype=np.int32) % o.count
    exact = sweep.cast_sweeps(motion, walls, T_base_sensor[sensor], o)
    # glass comes after the other walls of the scene
    pane = exact.wall - len(scene.walls)
    on_glass = (pane >= 0) & (pane < len(scene.glass))
    ranges, hit = laser.simulate_measurement(exact.range, on_glass, o, happening.sensor_rng)
    angles = laser.compute_beam_angles(o.beams, o.fov)
    if o.upside_down == "known":
        angles = -angles
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    recording = Recording(
        stamp_ns=happening.stamp_ns,
        offset=np.arange(T + 1, dtype=np.int64) * o.beams,
        points=points.reshape(-1, 2).astype(np.float32),
        hit=hit.ravel(),
        T_base_sensor=T_base_sensor,
        sensor=sensor,
        T_odom_base=happening.T_odom_base,
        source=happening.source(_described(o, angles)),
        beam_time=np.tile(Sweep.of(o).beam_times(o.beams), T) if o.sweep_time > 0 else None,
    )
    return recording, np.where(hit, exact.mover, np.int32(-1)).ravel()


def _sensors(o: LaserOptions) -> Float:
    """(S, 3, 3) T_base_sensor."""
    front = se2.matrix(o.x, o.y, o.yaw)
    return np.stack([front, se2.matrix(0.0, 0.0, np.pi) @ front][: o.count])


def _described(o: LaserOptions, angles: Float) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "beams_per_scan": len(angles),
            "start_angle": float(angles[0]),
            "angle_step": float(angles[1] - angles[0]),
        }
        for name in ("simulated laser", "simulated rear laser")[: o.count]
    ]


def _partial_progress(first: float, last: float, tell: Progress) -> Progress:
    """Progress of a part of the whole."""
    return lambda share: tell(first + (last - first) * share)


def _silent(share: float) -> None:
    pass
