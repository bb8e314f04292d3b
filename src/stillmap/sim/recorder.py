"""Recording of a 3D sensor, scan by scan, in bounded memory."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.recording import Recording
from stillmap.sim import lidar, ray_casting
from stillmap.sim.dynamics import Moment, Progress
from stillmap.sim.episode import Episode
from stillmap.sim.geometry import Float, Ground
from stillmap.sim.laser import simulate_measurement
from stillmap.sim.lidar import Pattern, Sensor
from stillmap.sim.ray_casting import RayReturns
from stillmap.sim.truth import Truth
from stillmap.sim.truth_surfaces import MovingSurfaces, StaticSurfaces
from stillmap.sim.world_3d import STANDING, MoverSolids, make_static_world


class World(NamedTuple):
    """A simulated scene in 3D.

    Attributes:
        happening: the motion, in the plane.
        static: the static surfaces.
        carried: solids of the movers.
        ridden: (T, 6) x, y, z, roll, pitch, yaw of the robot.
    """

    happening: Episode
    static: StaticSurfaces
    carried: MoverSolids
    ridden: Float

    @classmethod
    def of(cls, happening: Episode) -> "World":
        """The 3D world of an episode, with heights of people and vibration of the robot."""
        scene, rng = happening.scene, happening.body_rng
        ground = Ground.of(scene.ground, np.reshape(scene.pavements, (-1, 4)).astype(float))
        carried = MoverSolids(scene, happening.motion, ground, rng)
        ridden = lidar.compute_robot_poses(happening.motion.robot, ground, scene.lidar, rng)
        return cls(happening, make_static_world(scene, ground), carried, ridden)

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
        rays = lidar.transform_rays(pattern, T)
        exact = ray_casting.cast_rays(rays, self.static, self.carried.at(moment, scan))
        if sensor.own is None:
            return exact
        nearer = sensor.own.range < exact.range
        both: Any = zip(sensor.own, exact, strict=True)
        return RayReturns._make(np.where(nearer, *pair) for pair in both)


def collect_surfaces(world: World) -> tuple[StaticSurfaces, MovingSurfaces]:
    """The surfaces of a world; movers that never moved are static."""
    poses = []
    for scan in range(len(world.ridden)):
        moment = world.moment(np.array([scan]), np.zeros(1))
        carried = world.carried.at(moment, scan)
        poses.append(carried.pose[0])
    carried = carried._replace(pose=np.stack(poses))
    moves = carried.mover >= 0
    never = carried._replace(pose=carried.pose[:1]).select(~moves)
    standing = world.static._replace(solids=world.static.solids.concatenate(never))
    return standing, MovingSurfaces(world.happening.exact_ns, carried.select(moves))


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
    beams = _Beams(sensor, scratch, happening.has_standing_things)
    for scan in range(T):
        pattern = sensor.pattern(scan)
        beams.add(world.cast_rays(sensor, pattern, scan), pattern, rng)
        if scan % 10 == 0:
            tell(scan / T)
    if sensor.dimension == 2:
        T_world_base, T_odom_base = se2.matrix(*happening.motion.robot.T), happening.T_odom_base
        T_base_sensor = sensor.T_base_sensor[np.ix_([0, 1, 3], [0, 1, 3])]
    else:
        T_world_base = lidar.make_pose(world.ridden[:, :3], *world.ridden[:, 3:].T)
        T_base_sensor, T_odom_base = sensor.T_base_sensor, lidar.lift_poses(happening.T_odom_base)
    recording = Recording(
        stamp_ns=happening.stamp_ns,
        offset=np.array(beams.offset, np.int64),
        points=beams.points.finish(),
        hit=beams.hit.finish(),
        T_base_sensor=T_base_sensor[None],
        sensor=np.zeros(T, np.int32),
        T_odom_base=T_odom_base,
        source=happening.source([{"name": sensor.name}]),
        beam_time=None if beams.time is None else beams.time.finish(),
        scratch=scratch,
    )
    sizes = np.column_stack([happening.motion.sizes, world.carried.tall])
    more = {"mover_sizes": np.where(np.isnan(sizes), np.array(None), sizes).tolist()}
    static, mover = beams.static.finish(), beams.mover.finish()
    thing = None if beams.thing is None else beams.thing.finish()
    return recording, happening.truth(static, mover, T_world_base, more, thing=thing)


class _Beams:
    """Builders of the per-beam arrays of Recording and Truth."""

    def __init__(self, sensor: Sensor, folder: Path | None, has_things: bool) -> None:
        self._sensor = sensor
        self.points = ArrayBuilder(np.float32, (sensor.dimension,), folder)
        self.hit, self.static = (ArrayBuilder(np.bool_, (), folder) for _ in range(2))
        self.mover = ArrayBuilder(np.int32, (), folder)
        self.thing = ArrayBuilder(np.int32, (), folder) if has_things else None
        self.time = ArrayBuilder(np.float32, (), folder) if sensor.takes_time else None
        self.offset = [0]

    def add(self, exact: RayReturns, pattern: Pattern, rng: np.random.Generator) -> None:
        """Append a scan, given its exact returns."""
        range, hit = simulate_measurement(exact.range, exact.on_glass, self._sensor.options, rng)
        points = (range * pattern.direction[: self._sensor.dimension]).astype(np.float32)
        stands = exact.mover <= STANDING
        thing = np.where(hit & stands, STANDING - exact.mover, np.int32(-1)).astype(np.int32)
        mover = np.where(hit & ~stands, exact.mover, np.int32(-1))
        time = np.repeat(pattern.seconds, hit.shape[1]).reshape(hit.shape)
        use = hit if self._sensor.leaves_out else np.ones_like(hit)
        self.points.append(np.moveaxis(points, 0, -1)[use])
        self.hit.append(hit[use])
        self.static.append((hit & (mover == -1))[use])
        self.mover.append(mover[use])
        if self.thing is not None:
            self.thing.append(thing[use])
        if self.time is not None:
            self.time.append(time[use])
        self.offset.append(len(self.hit))
