"""Simulation of a recording: motion, odometry, sensors and cameras."""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stillmap.core import se2
from stillmap.core.arrays import ArrayBuilder
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes
from stillmap.sim import lidar
from stillmap.sim.camera import CameraSimulator
from stillmap.sim.dynamics import Progress
from stillmap.sim.episode import simulate_episode
from stillmap.sim.geometry import make_pose
from stillmap.sim.laser import Float, simulate_measurement
from stillmap.sim.lidar import Sensor
from stillmap.sim.planar import record_planar
from stillmap.sim.scene import Scene
from stillmap.sim.truth import ImageTruth, Truth
from stillmap.sim.world_3d import STANDING, World

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
    share = _MOTION_SHARE_3D if scene.in_3d else _MOTION_SHARE
    first, rest = _split_progress((0.0, share, 1.0), progress)
    episode = simulate_episode(scene, np.random.default_rng(rng), first)
    if scene.in_3d:
        world, sensor = World.of(episode), lidar.make_spinning_lidar(scene)
        made = _with_images(world, *_record(world, sensor, episode.sensor_rng, rest, scratch))
    else:
        made = Simulation(scene, *record_planar(episode))
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
    first, second, third = _split_progress(ends, progress)
    episode = simulate_episode(scene, np.random.default_rng(rng), first)
    world, (flat, tilted) = World.of(episode), lidar.make_rig_lasers(scene)
    below = _record(world, flat, episode.sensor_rng, second, scratch)
    above = _record(world, tilted, episode.body_rng, third, scratch)
    # images belong to the 3D recording
    horizontal, tilting = Simulation(scene, *below), _with_images(world, *above)
    third(1.0)
    stamps = np.arange(len(episode.motion.robot)) / scene.scan_rate
    return RigSimulation(horizontal, tilting, lidar.compute_joint_angle(stamps, scene.rig))


def _split_progress(ends: tuple[float, ...], tell: Progress | None) -> list[Progress]:
    """Progress of each part of the whole."""

    def part(first: float, last: float) -> Progress:
        return lambda share: tell(first + (last - first) * share) if tell else None

    return [part(*pair) for pair in itertools.pairwise(ends)]


def _with_images(world: World, recording: Recording, truth: Truth) -> Simulation:
    """A 3D recording with the images of the scene's cameras, if there are any."""
    scene = world.episode.scene
    if not scene.camera.enabled:
        return Simulation(scene, recording, truth)
    photographs = CameraSimulator(world)
    recording = replace(recording, images=photographs.images)
    return Simulation(scene, recording, truth, photographs, photographs.truth())


def _record(
    world: World, sensor: Sensor, rng: np.random.Generator, tell: Progress, scratch: Path | None
) -> tuple[Recording, Truth]:
    """The recording of a sensor of a 3D world, scan by scan in bounded memory, with its truth."""
    episode, T, dimension = world.episode, len(world.robot), sensor.dimension
    points = ArrayBuilder(np.float32, (dimension,), scratch)
    hits, statics = (ArrayBuilder(np.bool_, (), scratch) for _ in range(2))
    movers, things = (ArrayBuilder(np.int32, (), scratch) for _ in range(2))
    times, offset = ArrayBuilder(np.float32, (), scratch), [0]
    for scan in range(T):
        pattern = sensor.pattern(scan)
        exact = sensor.cast_rays(world, pattern, scan)
        ranges, hit = simulate_measurement(exact.range, exact.on_glass, sensor.options, rng)
        stands = exact.mover <= STANDING
        mover = np.where(hit & ~stands, exact.mover, np.int32(-1))
        use = hit if sensor.leaves_out else np.ones_like(hit)
        local = (ranges * pattern.direction[:dimension]).astype(np.float32)
        points.append(np.moveaxis(local, 0, -1)[use])
        hits.append(hit[use])
        statics.append((hit & (mover == -1))[use])
        movers.append(mover[use])
        if episode.has_standing_things:
            things.append(np.where(hit & stands, STANDING - exact.mover, -1)[use].astype(np.int32))
        if sensor.takes_time:
            times.append(np.repeat(pattern.seconds, hit.shape[1]).reshape(hit.shape)[use])
        offset.append(len(hits))
        if scan % 10 == 0:
            tell(scan / T)
    if dimension == 2:
        T_world_base, T_odom_base = se2.matrix(*episode.motion.robot.T), episode.T_odom_base
        T_base_sensor = sensor.T_base_sensor[np.ix_([0, 1, 3], [0, 1, 3])]
    else:
        T_world_base = make_pose(world.robot[:, :3], *world.robot[:, 3:].T)
        T_base_sensor, T_odom_base = sensor.T_base_sensor, lidar.lift_poses(episode.T_odom_base)
    recording = Recording(
        stamp_ns=episode.stamp_ns,
        offset=np.array(offset, np.int64),
        points=points.finish(),
        hit=hits.finish(),
        T_base_sensor=T_base_sensor[None],
        sensor=np.zeros(T, np.int32),
        T_odom_base=T_odom_base,
        source=episode.source([SensorNotes(sensor.name)]),
        beam_time=times.finish() if sensor.takes_time else None,
        scratch=scratch,
    )
    sizes = np.column_stack([episode.motion.sizes, world.movers.tall])
    more = {"mover_sizes": np.where(np.isnan(sizes), np.array(None), sizes).tolist()}
    thing = things.finish() if episode.has_standing_things else None
    truth = episode.truth(statics.finish(), movers.finish(), T_world_base, more, thing=thing)
    return recording, truth
