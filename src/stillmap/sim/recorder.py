"""Recording of a 3D sensor, scan by scan, in bounded memory."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.arrays import ArrayBuilder
from stillmap.core.recording import Recording
from stillmap.sim import lidar, ray_casting
from stillmap.sim.dynamics import Progress
from stillmap.sim.episode import Episode
from stillmap.sim.geometry import Faces, Ground, Solids
from stillmap.sim.lidar import Pattern, Sensor
from stillmap.sim.ray_casting import RayReturns
from stillmap.sim.sweep import Moment
from stillmap.sim.truth import Truth
from stillmap.sim.world_3d import MoverSolids, make_static_world

Float = NDArray[np.float64]


class World(NamedTuple):
    """A simulated scene in 3D.

    Attributes:
        happening: the motion, in the plane.
        ground: the ground.
        faces, still: static surfaces.
        carried: solids of the movers.
        ridden: (T, 6) x, y, z, roll, pitch, yaw of the robot.
    """

    happening: Episode
    ground: Ground
    faces: Faces
    still: Solids
    carried: MoverSolids
    ridden: Float

    @classmethod
    def of(cls, happening: Episode) -> "World":
        """The 3D world of an episode, with heights of people and vibration of the robot."""
        scene, rng = happening.scene, happening.body_rng
        ground = Ground.of(scene.ground, np.reshape(scene.pavements, (-1, 4)).astype(float))
        carried = MoverSolids(scene, happening.motion, ground, rng)
        ridden = lidar.compute_robot_poses(happening.motion.robot, ground, scene.lidar, rng)
        return cls(happening, ground, *make_static_world(scene, ground), carried, ridden)

    def moment(self, scans: NDArray[np.int64], seconds: Float) -> Moment:
        """N times: `seconds` after the stamps of scans."""
        return Moment(self.happening.motion, scans, seconds)

    def T_world_base(self, moment: Moment) -> Float:
        """(N, 4, 4) pose of the robot at the times of a moment."""
        x, y, z, *angles = moment.interpolate(self.ridden).T
        return lidar.make_pose(np.stack([x, y, z], axis=-1), *angles)

    def cast_rays(self, sensor: Sensor, pattern: Pattern, scan: int) -> RayReturns:
        """Exact returns of the beams of one scan."""
        moment = self.moment(np.full(len(pattern.azimuth), scan), pattern.seconds)
        T = self.T_world_base(moment) @ sensor.T_base_sensor
        solids = [self.still, self.carried.at(moment, scan)]
        ceiling = self.happening.scene.heights.ceiling
        exact = ray_casting.cast_rays(
            lidar.transform_rays(pattern, T), self.faces, solids, self.ground, ceiling
        )
        return exact if sensor.own is None else _nearer(sensor.own, exact)


def record(
    world: World,
    sensor: Sensor,
    rng: np.random.Generator,
    tell: Progress,
    scratch: Path | None = None,
) -> tuple[Recording, Truth]:
    """Simulate the recording of a sensor, with its truth.

    Args:
        world: the world.
        sensor: takes a scan at each of T stamps.
        rng: of noise and losses.
        tell: called with the completed share.
        scratch: folder for large arrays; None: the system's temporary folder.

    Raises:
        OSError: the disk is full.
    """
    happening, T = world.happening, len(world.ridden)
    beams = _Beams(sensor, scratch)
    for scan in range(T):
        pattern = sensor.pattern(scan)
        beams.add(world.cast_rays(sensor, pattern, scan), pattern, rng)
        if scan % 10 == 0:
            tell(scan / T)
    T_world_base = lidar.make_pose(world.ridden[:, :3], *world.ridden[:, 3:].T)
    T_base_sensor, T_odom_base = sensor.T_base_sensor, lidar.lift_poses(happening.T_odom_base)
    if sensor.dimension == 2:
        T_world_base, T_odom_base = se2.matrix(*happening.motion.robot.T), happening.T_odom_base
        T_base_sensor = T_base_sensor[np.ix_([0, 1, 3], [0, 1, 3])]
    columns = beams.columns()
    recording = Recording(
        stamp_ns=happening.stamp_ns,
        offset=columns.offset,
        points=columns.points,
        hit=columns.hit,
        T_base_sensor=T_base_sensor[None],
        sensor=np.zeros(T, np.int32),
        T_odom_base=T_odom_base,
        source=happening.source([{"name": sensor.name}]),
        beam_time=columns.beam_time,
        scratch=scratch,
    )
    more = {"mover_sizes": _sizes(world)}
    return recording, happening.truth(columns.static, columns.mover, T_world_base, more)


def _nearer(one: RayReturns, other: RayReturns) -> RayReturns:
    nearer = one.range < other.range
    return RayReturns(
        np.where(nearer, one.range, other.range),
        np.where(nearer, one.mover, other.mover),
        np.where(nearer, one.on_glass, other.on_glass),
    )


def _sizes(world: World) -> list[list[float | None]]:
    """Length, width and height of each mover in metres; None where undefined."""
    rows: list[list[Any]]
    rows = np.column_stack([world.happening.motion.sizes, world.carried.tall]).tolist()
    return [[None if value != value else value for value in row] for row in rows]


class _Recorded(NamedTuple):
    """Fields of Recording and Truth."""

    offset: NDArray[np.int64]
    points: NDArray[np.float32]
    hit: NDArray[np.bool_]
    beam_time: NDArray[np.float32] | None
    static: NDArray[np.bool_]
    mover: NDArray[np.int32]


class _Beams:
    """Builder of the per-beam arrays."""

    def __init__(self, sensor: Sensor, folder: Path | None) -> None:
        self._sensor = sensor
        self._points = ArrayBuilder(np.float32, (sensor.dimension,), folder)
        self._hit, self._static = (
            ArrayBuilder(np.bool_, (), folder),
            ArrayBuilder(np.bool_, (), folder),
        )
        self._mover = ArrayBuilder(np.int32, (), folder)
        self._time = ArrayBuilder(np.float32, (), folder) if sensor.takes_time else None
        self._offset = [0]

    def add(self, exact: RayReturns, pattern: Pattern, rng: np.random.Generator) -> None:
        """Append a scan, given its exact returns."""
        range, hit = lidar.simulate_measurement(exact, self._sensor.options, rng)
        points = (range * pattern.direction[: self._sensor.dimension]).astype(np.float32)
        mover = np.where(hit, exact.mover, np.int32(-1))
        time = np.repeat(pattern.seconds, hit.shape[1]).reshape(hit.shape)
        use = hit if self._sensor.leaves_out else np.ones_like(hit)
        self._points.append(np.moveaxis(points, 0, -1)[use])
        self._hit.append(hit[use])
        self._static.append((hit & (mover == -1))[use])
        self._mover.append(mover[use])
        if self._time is not None:
            self._time.append(time[use])
        self._offset.append(len(self._hit))

    def columns(self) -> _Recorded:
        """All arrays; nothing can be added afterwards."""
        return _Recorded(
            offset=np.array(self._offset, np.int64),
            points=self._points.finish(),
            hit=self._hit.finish(),
            beam_time=None if self._time is None else self._time.finish(),
            static=self._static.finish(),
            mover=self._mover.finish(),
        )
