"""Simulation of a recording, and the folder with its truth that it is written to."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from stillmap.core import se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Float
from stillmap.core.arrays import write_npy
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes
from stillmap.io import stillmap_folder
from stillmap.io.carmen.writer import write_log
from stillmap.io.registry import RIG_FOLDERS
from stillmap.sim import lidar, truth
from stillmap.sim.camera import CameraSimulator, Color
from stillmap.sim.dynamics import Progress
from stillmap.sim.episode import simulate_episode
from stillmap.sim.geometry import make_pose
from stillmap.sim.laser import simulate_measurement
from stillmap.sim.lidar import Sensor
from stillmap.sim.planar import record_planar
from stillmap.sim.scene import Scene
from stillmap.sim.truth import Truth
from stillmap.sim.world_3d import STANDING, World

CARMEN_LOG = "recording.log"
MARK = "truth"  # every simulation has it
RIG_MARK = "tilting/truth"  # every one of two lasers has it
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
    """

    scene: Scene
    recording: Recording
    truth: Truth
    photographs: CameraSimulator | None = None


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
    rest = _part(progress, share, 1.0)
    episode = simulate_episode(scene, np.random.default_rng(rng), _part(progress, 0.0, share))
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
    first, middle = _MOTION_SHARE_3D, (1 + _MOTION_SHARE_3D) / 2
    episode = simulate_episode(scene, np.random.default_rng(rng), _part(progress, 0.0, first))
    world, (flat, tilted) = World.of(episode), lidar.make_rig_lasers(scene)
    below = _record(world, flat, episode.sensor_rng, _part(progress, first, middle), scratch)
    above = _record(world, tilted, episode.body_rng, _part(progress, middle, 1.0), scratch)
    # images belong to the 3D recording
    horizontal, tilting = Simulation(scene, *below), _with_images(world, *above)
    _part(progress, middle, 1.0)(1.0)
    stamps = np.arange(len(episode.motion.robot)) / scene.scan_rate
    return RigSimulation(horizontal, tilting, lidar.compute_joint_angle(stamps, scene.rig))


def _part(progress: Progress | None, first: float, last: float) -> Progress:
    """Progress of a part of the whole."""
    return lambda share: progress(first + (last - first) * share) if progress else None


def _with_images(world: World, recording: Recording, truth: Truth) -> Simulation:
    """A 3D recording with the images of the scene's cameras, if there are any."""
    scene = world.episode.scene
    if not scene.camera.enabled:
        return Simulation(scene, recording, truth)
    photographs = CameraSimulator(world)
    recording = replace(recording, images=photographs.images)
    return Simulation(scene, recording, truth, photographs)


def _record(
    world: World, sensor: Sensor, rng: np.random.Generator, tell: Progress, scratch: Path | None
) -> tuple[Recording, Truth]:
    """The recording of a sensor of a 3D world, scan by scan in bounded memory, with its truth."""
    episode, T, dimension = world.episode, len(world.robot), sensor.dimension
    has_things, offset = episode.has_standing_things, [0]
    points = ArrayBuilder(np.float32, (dimension,), scratch)
    types = {"hit": np.bool_, "static": np.bool_, "mover": np.int32, "thing": np.int32}
    beams = {
        name: ArrayBuilder(t, (), scratch) for name, t in (*types.items(), ("time", np.float32))
    }
    for scan in range(T):
        pattern = sensor.pattern(scan)
        exact = sensor.cast_rays(world, pattern, scan)
        ranges, hit = simulate_measurement(exact.range, exact.on_glass, sensor.options, rng)
        stands = exact.mover <= STANDING
        mover = np.where(hit & ~stands, exact.mover, np.int32(-1))
        use = hit if sensor.leaves_out else np.ones_like(hit)
        local = (ranges * pattern.direction[:dimension]).astype(np.float32)
        points.append(np.moveaxis(local, 0, -1)[use])
        values = {"hit": hit, "static": hit & (mover == -1), "mover": mover}
        if has_things:
            values["thing"] = np.where(hit & stands, STANDING - exact.mover, -1)
        if sensor.takes_time:
            values["time"] = np.broadcast_to(pattern.seconds[:, None], hit.shape)
        for name, of_beams in values.items():
            beams[name].append(of_beams[use])
        offset.append(len(points))
        if scan % 10 == 0:
            tell(scan / T)
    made = {name: builder.finish() for name, builder in beams.items()}
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
        hit=made["hit"],
        T_base_sensor=T_base_sensor[None],
        sensor=np.zeros(T, np.int32),
        T_odom_base=T_odom_base,
        source=episode.source([SensorNotes(sensor.name)]),
        beam_time=made["time"] if sensor.takes_time else None,
        scratch=scratch,
    )
    sizes = np.column_stack([episode.motion.sizes, world.movers.tall])
    more = {"mover_sizes": np.where(np.isnan(sizes), np.array(None), sizes).tolist()}
    thing = made["thing"] if has_things else None
    return recording, episode.truth(made["static"], made["mover"], T_world_base, more, thing=thing)


def write_simulation(
    simulation: Simulation,
    path: str | Path,
    *,
    format: Literal["stillmap", "carmen"] = "stillmap",
    overwrite: bool = False,
) -> None:
    """Write recording and truth into one folder that appears complete or not at all.

    Args:
        simulation: what `simulate` returned.
        path: the folder.
        format: "stillmap" writes the files of a recording folder, "carmen" a `recording.log`.
        overwrite: replace an earlier simulation.

    Raises:
        InputError: the folder holds something already or cannot be written to, or the format
            cannot say what the laser measures.
    """
    with atomic_folder(Path(path), MARK, overwrite) as work:
        if format == "carmen":
            write_log(simulation.recording, work / CARMEN_LOG)
            truth.write_truth(simulation.truth, simulation.recording.stamp_ns, work)
        else:
            write_folder(simulation, work)


def write_rig(rig: RigSimulation, path: str | Path, *, overwrite: bool = False) -> None:
    """Write what two lasers recorded, each with its truth, into one folder.

    `horizontal` and `tilting` are folders as `write_simulation` makes them; `joint_angle.npy` (T,)
    beside them has the joint's angle in rad at each stamp.

    Raises:
        InputError: the folder holds something already or cannot be written to.
    """
    with atomic_folder(Path(path), RIG_MARK, overwrite) as work:
        for name, simulation in zip(RIG_FOLDERS, (rig.horizontal, rig.tilting), strict=True):
            (work / name).mkdir()
            write_folder(simulation, work / name)
        write_npy(work / "joint_angle.npy", rig.joint_angle)


def count_beams(simulation: Simulation) -> dict[str, int]:
    """Numbers of scans, beams, hits, and hits on movers."""
    return {
        "scans": simulation.recording.n_scans,
        "beams": simulation.recording.n_beams,
        "hits": int(np.count_nonzero(simulation.recording.hit)),
        "dynamic": int(np.count_nonzero(simulation.truth.mover >= 0)),
    }


def write_folder(simulation: Simulation, work: Path) -> None:
    """A recording folder with its truth, and pictures with theirs, into an existing folder."""
    recording, photographs = simulation.recording, simulation.photographs
    truth.write_truth(simulation.truth, recording.stamp_ns, work)
    if photographs is not None:
        truth.write_image_truth(photographs.truth(), work / truth.FOLDER)
        images = replace(photographs.images, load=_write_on_read(photographs, work / truth.FOLDER))
        recording = replace(recording, images=images)
    stillmap_folder.write_into(recording, work)


def _write_on_read(photographs: CameraSimulator, folder: Path) -> Callable[[int], Color]:
    """Renders an image and writes its truth, so that each is rendered once only."""

    def load(image: int) -> Color:
        seen = photographs.render(image)
        truth.write_seen(folder, image, seen.mask, seen.distance)
        return seen.color

    return load
