"""A recording turn by turn: what does not fit into memory goes to files."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.spool import Column
from stillmap.simulation import lidar, rays
from stillmap.simulation.carriers import Carried
from stillmap.simulation.ground import Ground
from stillmap.simulation.lidar import Pattern
from stillmap.simulation.motion import Motion
from stillmap.simulation.scene import Scene
from stillmap.simulation.standing import standing
from stillmap.simulation.sweep import Moment

Float = NDArray[np.float64]


class Turns(NamedTuple):
    """T turns of a lidar with M beams in all; fields as in Recording and Truth.

    Attributes:
        tall: (P,) metres, of the movers.
    """

    offset: NDArray[np.int64]
    points: NDArray[np.float32]
    hit: NDArray[np.bool_]
    beam_time: NDArray[np.float32] | None
    static: NDArray[np.bool_]
    mover: NDArray[np.int32]
    T_base_sensor: Float
    T_world_base: Float
    tall: Float


def record(
    scene: Scene,
    motion: Motion,
    rngs: tuple[np.random.Generator, np.random.Generator],
    tell: Callable[[float], None],
    scratch: Path | None = None,
) -> Turns:
    """What the lidar of a scene records.

    Args:
        scene: the world and all parameters.
        motion: where everything is at each of T scans.
        rngs: for the lidar, and for how tall people are and how the robot shakes.
        tell: called now and then with the share that is done.
        scratch: folder for what is large; None: the system's temporary folder.
    """
    o, pattern = scene.lidar, Pattern.of(scene.lidar)
    ground = Ground.of(scene.ground, np.reshape(scene.pavements, (-1, 4)).astype(float))
    faces, still = standing(scene, ground)
    carried = Carried(scene, motion, ground, rngs[1])
    ridden = lidar.ridden(motion.robot, ground, o, rngs[1])
    T_base_sensor, own = lidar.mounted(o), None
    if o.sees_robot:
        own = lidar.own_body(scene, pattern)
    columns = _Columns(o.sweep, scratch)
    for scan in range(len(motion.robot)):
        moment = Moment(motion, np.full(o.columns, scan), pattern.seconds)
        x, y, z, *angles = moment.at(ridden).T
        T = lidar.matrix(np.stack([x, y, z], axis=-1), *angles) @ T_base_sensor
        beams, solids = lidar.looking(pattern, T), [still, carried.at(moment, scan)]
        exact = rays.cast(beams, faces, solids, ground, scene.heights.ceiling)
        columns.add(_with_own(exact, own), pattern, scene, rngs[0])
        if scan % 10 == 0:
            tell(scan / len(motion.robot))
    T_world_base = lidar.matrix(ridden[:, :3], *ridden[:, 3:].T)
    return columns.turns(T_base_sensor[None], T_world_base, carried.tall)


def _with_own(exact: rays.Echoes, own: rays.Echoes | None) -> rays.Echoes:
    if own is None:
        return exact
    nearer = own.range < exact.range
    return rays.Echoes(
        np.where(nearer, own.range, exact.range),
        np.where(nearer, own.mover, exact.mover),
        exact.on_glass & ~nearer,
    )


class _Columns:
    """The beams of all turns so far."""

    def __init__(self, timed: bool, folder: Path | None) -> None:
        self._points = Column(np.float32, (3,), folder)
        self._hit, self._static = Column(np.bool_, (), folder), Column(np.bool_, (), folder)
        self._mover = Column(np.int32, (), folder)
        self._time = Column(np.float32, (), folder) if timed else None
        self._offset = [0]

    def add(
        self, exact: rays.Echoes, pattern: Pattern, scene: Scene, rng: np.random.Generator
    ) -> None:
        """One turn, seen exactly."""
        range, hit = lidar.measure(exact, scene.lidar, rng)
        points = np.moveaxis((range * pattern.direction).astype(np.float32), 0, -1)
        mover = np.where(hit, exact.mover, np.int32(-1))
        time = np.repeat(pattern.seconds, hit.shape[1]).reshape(hit.shape)
        use = hit if scene.lidar.no_returns == "left out" else np.ones_like(hit)
        self._points.append(points[use])
        self._hit.append(hit[use])
        self._static.append((hit & (mover == -1))[use])
        self._mover.append(mover[use])
        if self._time is not None:
            self._time.append(time[use])
        self._offset.append(len(self._hit))

    def turns(self, T_base_sensor: Float, T_world_base: Float, tall: Float) -> Turns:
        return Turns(
            offset=np.array(self._offset, np.int64),
            points=self._points.finished(),
            hit=self._hit.finished(),
            beam_time=None if self._time is None else self._time.finished(),
            static=self._static.finished(),
            mover=self._mover.finished(),
            T_base_sensor=T_base_sensor,
            T_world_base=T_world_base,
            tall=tall,
        )
