"""The simulation itself: people and robot move, the laser looks, odometry drifts."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.errors import InputError
from stillmap.recording.model import Recording
from stillmap.simulation import laser, odometry
from stillmap.simulation.figures import Figures
from stillmap.simulation.free_space import FreeSpace, Planner
from stillmap.simulation.people import BODY_RADIUS, Crowd
from stillmap.simulation.robot import Robot, plan_way
from stillmap.simulation.scene import Scene
from stillmap.simulation.truth import Truth

Float = NDArray[np.float64]
Progress = Callable[[float], None]

_STEP = 0.1  # s, at most, between two positions of people and robot
_ROBOT_MARGIN = 0.15  # m beyond its radius that the robot's way keeps from walls
_PERSON_MARGIN = 0.1  # m
_SLOWEST = 5.0  # times the time that the route takes undisturbed: then something holds the robot
_FIRST_STAMP_NS = 1_000_000_000 * 10**9
_MOTION_SHARE = 0.7  # of the time that a simulation takes, for progress


@dataclass(frozen=True, eq=False)
class Simulation:
    """A scene, what the robot recorded in it, and what really happened."""

    scene: Scene
    recording: Recording
    truth: Truth


@dataclass(frozen=True, eq=False)
class _Motion:
    """Where everything is at each scan: robot (T, 3), people (T, P, 3), parts of people."""

    robot: Float
    people: Float
    movers: laser.Movers


def simulate(
    scene: Scene, rng: np.random.Generator | int = 0, progress: Progress | None = None
) -> Simulation:
    """Let a robot record a scene.

    People, laser and odometry draw from generators of their own, spawned from `rng`: another
    laser or odometry leaves the way everybody goes unchanged.

    Args:
        scene: the world and all parameters.
        rng: the generator, or a seed for one. The same seed gives the same recording to the bit.
        progress: called now and then with the share that is done, 0 to 1.

    Raises:
        InputError: no room for the robot on its route or for the people, or the robot is held up.
    """
    rng = np.random.default_rng(rng)
    seed = getattr(rng.bit_generator.seed_seq, "entropy", None)
    crowd_rng, laser_rng, odometry_rng = rng.spawn(3)
    walls = np.array([*scene.walls, *scene.glass], float)
    tell = progress or _silent
    motion = _move(scene, walls, crowd_rng, lambda share: tell(_MOTION_SHARE * share))
    T_world_base = se2.matrix(*motion.robot.T)
    T_odom_base = odometry.drifting(T_world_base, scene.odometry, odometry_rng)
    recording, mover = _record(scene, walls, motion, T_odom_base, laser_rng, seed)
    tell(1.0)
    static = recording.hit & (mover < 0)
    truth = Truth(static, mover, T_world_base, walls, motion.people, describe(scene, seed))
    return Simulation(scene, recording, truth)


def _record(
    scene: Scene,
    walls: Float,
    motion: _Motion,
    T_odom_base: Float,
    rng: np.random.Generator,
    seed: Any,
) -> tuple[Recording, NDArray[np.int32]]:
    """The recording, and the mover (M,) that each of its beams met."""
    o, T = scene.laser, len(motion.robot)
    T_base_sensor = se2.matrix(o.x, o.y, o.yaw)[None]
    angles = laser.beam_angles(o.beams, o.fov)
    poses = se2.parameters(se2.matrix(*motion.robot.T) @ T_base_sensor)
    exact = laser.cast(poses, angles, walls, motion.movers)
    is_glass = np.arange(len(walls)) >= len(scene.walls)
    ranges, hit = laser.measure(exact, is_glass, o, rng)
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    times_ns = np.round(np.arange(T) * (1e9 / scene.robot.scan_rate)).astype(np.int64)
    recording = Recording(
        stamp_ns=_FIRST_STAMP_NS + times_ns,
        offset=np.arange(T + 1, dtype=np.int64) * o.beams,
        points=points.reshape(-1, 2).astype(np.float32),
        hit=hit.ravel(),
        T_base_sensor=T_base_sensor,
        sensor=np.zeros(T, np.int32),
        T_odom_base=T_odom_base,
        source=_source(scene, seed, angles),
    )
    return recording, np.where(hit, exact.mover, np.int32(-1)).ravel()


def describe(scene: Scene, seed: Any) -> dict[str, Any]:
    """Name, seed and all parameters of a scene, JSON-able; its walls lie beside as an array."""
    parameters = dataclasses.asdict(scene)
    del parameters["walls"]
    return {"name": parameters.pop("name"), "seed": seed, **parameters}


def _silent(share: float) -> None:
    pass


def _source(scene: Scene, seed: Any, angles: Float) -> dict[str, Any]:
    sensor = {
        "name": "simulated laser",
        "beams_per_scan": len(angles),
        "start_angle": float(angles[0]),
        "angle_step": float(angles[1] - angles[0]),
    }
    return {"format": "simulation", "scene": scene.name, "seed": seed, "sensors": [sensor]}


def _move(scene: Scene, walls: Float, rng: np.random.Generator, tell: Progress) -> _Motion:
    """Let robot and people move, and note where everything is at each scan."""
    start = np.array(scene.route[0], float)
    space = FreeSpace(walls)
    o = scene.robot
    planner = Planner(space, start, o.radius + _ROBOT_MARGIN)
    way = plan_way(scene.route, planner, closed=o.scans is not None)
    robot = Robot(way, space, o, closed=o.scans is not None)
    people_planner = Planner(space, start, BODY_RADIUS + _PERSON_MARGIN)
    crowd = Crowd(scene.crowd, space, people_planner, start, rng)
    figures = Figures(scene.crowd.people, scene.crowd.shape, space, rng)
    contact = o.radius + BODY_RADIUS
    steps = max(1, math.ceil(1.0 / (o.scan_rate * _STEP) - 1e-9))
    dt = 1.0 / (o.scan_rate * steps)
    expected = o.scans or robot.undisturbed_time() * o.scan_rate
    log = _Log()
    while not log.done(scene, robot, expected):
        log.note(robot, crowd, figures)
        if len(log.robot) % 50 == 0:
            tell(min(len(log.robot) / expected, 1.0))
        for _ in range(steps):
            robot.step(dt, crowd.xy, contact)
            crowd.step(dt, robot.pose, contact, robot.impatient)
            figures.step(dt, crowd, robot.pose[:2], o.radius)
    return log.motion(figures)


class _Log:
    def __init__(self) -> None:
        self.robot: list[Float] = []
        self._people: list[Float] = []
        self._xy: list[Float] = []
        self._heading: list[Float] = []

    def note(self, robot: Robot, crowd: Crowd, figures: Figures) -> None:
        xy, heading = figures.parts(crowd)
        self.robot.append(robot.pose)
        self._people.append(np.column_stack([crowd.xy, crowd.heading]))
        self._xy.append(xy)
        self._heading.append(heading)

    def done(self, scene: Scene, robot: Robot, expected: float) -> bool:
        scans = scene.robot.scans
        if scans is not None:
            return len(self.robot) >= scans
        if len(self.robot) > _SLOWEST * expected + 100:
            x, y, _ = robot.pose
            raise InputError(
                f"the robot gets stuck at ({x:.1f}, {y:.1f})",
                hint="fewer people, or a number of scans",
            )
        return robot.arrived

    def motion(self, figures: Figures) -> _Motion:
        movers = laser.Movers(
            np.stack(self._xy), np.stack(self._heading), figures.semi_axes, figures.mover
        )
        return _Motion(np.stack(self.robot), np.stack(self._people), movers)
