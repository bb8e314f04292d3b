"""Simulation of a recording, and the folder with its truth that it is written to."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stillmap.core import se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Float
from stillmap.core.arrays import write_npy
from stillmap.core.files import atomic_folder
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes
from stillmap.io import stillmap_folder
from stillmap.io.registry import RIG_FOLDERS
from stillmap.io.trajectory import embed_in_3d
from stillmap.sim import lidar, truth
from stillmap.sim.camera import CameraSimulator, Color
from stillmap.sim.dynamics import Progress
from stillmap.sim.episode import Episode, simulate_episode
from stillmap.sim.geometry import make_pose
from stillmap.sim.laser import simulate_measurement
from stillmap.sim.lidar import Sensor
from stillmap.sim.planar import record_planar
from stillmap.sim.scene import Scene
from stillmap.sim.truth import Truth
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
        tilting: of the scene's tilting laser, in 3D, where `recording` is of the horizontal one;
            its points are in the frame of the pivot, not of the joint.
        joint_angle: (T,) rad at each stamp of `tilting`, nose down.
    """

    scene: Scene
    recording: Recording
    truth: Truth
    photographs: CameraSimulator | None = None
    tilting: "Simulation | None" = None
    joint_angle: Float | None = None

    @property
    def parts(self) -> "list[Simulation]":
        """Itself, and that of a tilting laser."""
        return [self] if self.tilting is None else [self, self.tilting]


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
        InputError: no room for the robot on its route or for the people, or the robot is held up.
        OSError: the disk is full.
    """
    tell = progress or (lambda _: None)
    share = _MOTION_SHARE_3D if scene.in_3d else _MOTION_SHARE
    episode = simulate_episode(scene, np.random.default_rng(rng), _part(tell, 0.0, share))
    if scene.in_3d:
        made = _simulate_in_3d(episode, _part(tell, share, 1.0), scratch)
    else:
        made = Simulation(scene, *record_planar(episode))
    tell(1.0)
    return made


def _part(tell: Progress, first: float, last: float) -> Progress:
    """Progress of a part of the whole."""
    return lambda share: tell(first + (last - first) * share)


def _simulate_in_3d(episode: Episode, tell: Progress, scratch: Path | None) -> Simulation:
    """The recording of a lidar, or of a horizontal and a tilting laser."""
    scene = episode.scene
    world, sensors, made = World.of(episode), lidar.make_sensors(scene), list[Simulation]()
    for sensor, rng in zip(sensors, (episode.sensor_rng, episode.body_rng), strict=False):
        first, last = (k / len(sensors) for k in (len(made), len(made) + 1))
        recorded = _record(world, sensor, rng, _part(tell, first, last), scratch)
        made.append(Simulation(scene, *recorded))
    if scene.camera.enabled:  # images belong to the 3D recording
        photographs = CameraSimulator(world)
        recording = replace(made[-1].recording, images=photographs.images)
        made[-1] = replace(made[-1], recording=recording, photographs=photographs)
    if not scene.rig.tilts:
        return made[0]
    stamps = np.arange(len(episode.motion.robot)) / scene.scan_rate
    joint_angle = lidar.compute_joint_angle(stamps, scene.rig)
    return replace(made[0], tilting=made[1], joint_angle=joint_angle)


def _record(
    world: World, sensor: Sensor, rng: np.random.Generator, tell: Progress, scratch: Path | None
) -> tuple[Recording, Truth]:
    """The recording of a sensor of a 3D world, scan by scan in bounded memory, with its truth."""
    episode, T, dimension = world.episode, len(world.robot), sensor.dimension
    has_things, offset = episode.has_standing_things, [0]
    points = ArrayBuilder(np.float32, (dimension,), scratch)
    types = {"hit": "?", "static": "?", "mover": "i4", "thing": "i4", "time": "f4"}
    beams = {name: ArrayBuilder(dtype, (), scratch) for name, dtype in types.items()}
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
        T_base_sensor, T_odom_base = sensor.T_base_sensor, embed_in_3d(episode.T_odom_base)
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


def write_simulation(simulation: Simulation, path: str | Path, *, overwrite: bool = False) -> None:
    """Write recording and truth into one folder that appears complete or not at all.

    What two lasers recorded, one of which tilts, are the folders `horizontal` and `tilting`;
    `joint_angle.npy` (T,) beside them has the joint's angle in rad at each stamp.

    Args:
        simulation: what `simulate` returned.
        path: the folder.
        overwrite: replace an earlier simulation.

    Raises:
        InputError: the folder holds something already or cannot be written to.
    """
    with atomic_folder(Path(path), find_marker(simulation.scene), overwrite) as work:
        if simulation.joint_angle is None:
            write_folder(simulation, work)
            return
        for name, part in zip(RIG_FOLDERS, simulation.parts, strict=True):
            (work / name).mkdir()
            write_folder(part, work / name)
        write_npy(work / "joint_angle.npy", simulation.joint_angle)


def find_marker(scene: Scene) -> str:
    """A file that every simulation of such a scene has."""
    return "tilting/truth" if scene.rig.tilts else "truth"


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
