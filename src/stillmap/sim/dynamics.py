"""Motion of robot, people, doors, vehicles and movable objects, sampled at the scans."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.sim.laser import Movers, Outlines
from stillmap.sim.objects import DOOR_RANGE, Doors, MovableObjects, split_into_segments
from stillmap.sim.people import BODY_RADIUS, Crowd, Figures
from stillmap.sim.planner import FreeSpace, Planner
from stillmap.sim.robot import Robot, plan_route
from stillmap.sim.scene import Scene
from stillmap.sim.vehicles import Traffic

Float = NDArray[np.float64]
Progress = Callable[[float], None]
Rngs = tuple[np.random.Generator, np.random.Generator, np.random.Generator, np.random.Generator]

_MAX_STEP = 0.1  # s of a time step
_ROBOT_MARGIN = 0.15  # m between the robot's footprint and walls along its route
_PERSON_MARGIN = 0.1  # m
_MAX_DELAY = 5.0  # times the nominal time of the route, after which the robot is stuck
_MIN_MOTION = 1e-6  # m
_CARRY_TIME = 20.0  # s without scans while the robot is carried
_MAX_SIMULATED_PAUSE = 30.0  # s; the rest of a pause is not simulated


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of everything at each of T scans.

    Attributes:
        period: seconds from one scan to the next.
        seconds: (T,) since the beginning of the recording.
        carried: first scan after the robot was carried; T if it never was.
        paused: first scan after the pause; T without a pause.
        robot: (T, 3) x, y in metres, theta in radians.
        poses: (T, P, 3) the same of all movers: people, doors, vehicles, things; NaN where absent.
        kinds: (P) kind of each mover.
        people: cross sections of people.
        outlines: faces of doors and vehicles.
        things: faces of movable objects, which change between scans.
        still: (K, 4) faces of movers that never moved.
        sizes: (P, 2) metres, length and width of doors and vehicles; NaN of people and things.
        moved: (P,) whether each mover ever moved.
    """

    period: float
    seconds: Float
    carried: int
    paused: int
    robot: Float
    poses: Float
    kinds: list[str]
    people: Movers
    outlines: Outlines
    things: Outlines
    still: Float
    sizes: Float
    moved: NDArray[np.bool_]


def simulate_motion(scene: Scene, rngs: Rngs, tell: Progress) -> Motion:
    """Simulate the motion of everything, and sample it at each scan.

    Args:
        scene: the world and all parameters.
        rngs: of people, doors, vehicles, and the place that the robot is carried to.
        tell: called with the completed share.

    Raises:
        InputError: no room for the robot on its route or for the people, or the robot is held up.
    """
    world = _World(scene, rngs)
    o, rate = scene.robot, scene.scan_rate
    steps = max(1, math.ceil(1.0 / (rate * _MAX_STEP) - 1e-9))
    dt = 1.0 / (rate * steps)
    expected = o.scans or world.robot.nominal_time() * rate
    carried = None if o.carried_at is None else max(1, round(o.carried_at * expected))
    paused = None if o.pause_at is None else max(1, round(o.pause_at * rate))
    log = _Log()
    while not _is_done(scene, world.robot, len(log.robot), expected):
        if len(log.robot) == carried:
            world.carry_robot(dt, rngs[3])
        if len(log.robot) == paused:
            world.rest_robot(min(o.pause, _MAX_SIMULATED_PAUSE), dt)
        log.note(world)
        if len(log.robot) % 50 == 0:
            tell(min(len(log.robot) / expected, 1.0))
        for _ in range(steps):
            world.step(dt)
    return log.motion(world, _clock(len(log.robot), 1.0 / rate, carried, paused, o.pause))


class _Clock(NamedTuple):
    """Times of T scans; fields as in `Motion`."""

    period: float
    seconds: Float
    carried: int
    paused: int


def _clock(T: int, period: float, carried: int | None, paused: int | None, pause: float) -> _Clock:
    scan = np.arange(T)
    first = [T if one is None else min(one, T) for one in (carried, paused)]
    seconds = scan * period + _CARRY_TIME * (scan >= first[0]) + pause * (scan >= first[1])
    return _Clock(period, seconds, *first)


class _World:
    """State of robot, people, doors, vehicles and movable objects of a scene."""

    def __init__(self, scene: Scene, rngs: Rngs) -> None:
        start, o = np.array(scene.route[0], float), scene.robot
        # an open leaf is an obstacle, a closed one opens
        leaves = [door.leaf(door.opened) for door in scene.leaves]
        self.things = MovableObjects(scene.things)
        solid = [
            *scene.walls,
            *scene.glass,
            *scene.kerbs,
            *leaves,
            *self.things.faces_at_all_places(),
        ]
        space = FreeSpace(np.array(solid, float))
        planner = Planner(space, start, o.radius + _ROBOT_MARGIN)
        closed = o.scans is not None
        way = plan_route(scene.route, planner, closed)
        self.robot = Robot(way, space, o, closed, scene.lights)
        people_at = np.array(scene.people_at or scene.route[:1], float)
        people_planner = Planner(space, people_at, BODY_RADIUS + _PERSON_MARGIN)
        self.crowd = Crowd(scene.crowd, space, people_planner, start, rngs[0])
        shape = "whole" if scene.in_3d else scene.crowd.shape
        self.figures = Figures(scene.crowd.people, shape, space, rngs[0])
        self.doors = Doors(scene.leaves, scene.doors, rngs[1])
        self.traffic = Traffic(scene.lanes, scene.traffic, rngs[2])
        self._radius = o.radius

    def carry_robot(self, dt: float, rng: np.random.Generator) -> None:
        """Carry the robot to another place, while everything else moves in steps of dt seconds."""
        self.robot.put_down(rng, self._obstacles())
        self.rest_robot(_CARRY_TIME, dt)

    def rest_robot(self, seconds: float, dt: float) -> None:
        """Stop the robot, while everything else moves in steps of dt seconds."""
        for _ in range(round(seconds / dt)):
            self.robot.stand(dt)
            self._step_others(dt)

    def step(self, dt: float) -> None:
        """Advance everything by dt seconds."""
        self.robot.step(dt, self._obstacles(), self._radius + BODY_RADIUS)
        self._step_others(dt)

    def _obstacles(self) -> Float:
        """(N, 2) positions of people and corners of vehicles."""
        if not self.traffic.kinds:
            return self.crowd.xy
        return np.concatenate([self.crowd.xy, self.traffic.faces().reshape(-1, 2)])

    def _step_others(self, dt: float) -> None:
        robot, crowd, contact = self.robot, self.crowd, self._radius + BODY_RADIUS
        crowd.step(dt, robot.pose, contact, robot.is_impatient)
        self.figures.step(dt, crowd, robot.pose[:2], self._radius)
        if len(self.doors.share):
            standing = np.concatenate([crowd.xy, robot.pose[None, :2]])
            way = robot.route_ahead(DOOR_RANGE)[None]
            ways = np.concatenate(
                [split_into_segments(crowd.next_corners(DOOR_RANGE)), split_into_segments(way)]
            )
            self.doors.step(dt, standing, ways)
        if self.traffic.kinds:
            self.traffic.step(dt, robot.pose[:2], self._radius)


def _is_done(scene: Scene, robot: Robot, scans: int, expected: float) -> bool:
    if scene.robot.scans is not None:
        return scans >= scene.robot.scans
    if scans > _MAX_DELAY * expected + 100:
        x, y, _ = robot.pose
        raise InputError(
            f"the robot gets stuck at ({x:.1f}, {y:.1f})",
            hint="fewer people, or a number of scans",
        )
    return robot.arrived


class _Log:
    def __init__(self) -> None:
        self.robot: list[Float] = []
        self._poses: list[Float] = []
        self._xy: list[Float] = []
        self._heading: list[Float] = []
        self._faces: list[Float] = []

    def note(self, world: _World) -> None:
        crowd, doors, traffic = world.crowd, world.doors, world.traffic
        xy, heading = world.figures.parts(crowd)
        people = np.column_stack([crowd.xy, crowd.heading])
        self.robot.append(world.robot.pose)
        self._poses.append(np.concatenate([people, doors.poses(), traffic.poses()]))
        self._xy.append(xy)
        self._heading.append(heading)
        self._faces.append(np.concatenate([doors.faces(), traffic.faces()]))

    def motion(self, world: _World, clock: _Clock) -> Motion:
        figures, doors = world.figures, len(world.doors.share)
        persons = len(world.crowd.xy)
        kinds = ["person"] * persons + ["door"] * doors + world.traffic.kinds
        placed = world.things.place(clock.seconds, first=len(kinds))
        people = Movers(
            np.stack(self._xy), np.stack(self._heading), figures.semi_axes, figures.mover
        )
        poses, faces = np.stack(self._poses), np.stack(self._faces)
        moved = np.any(np.ptp(poses, axis=0) > _MIN_MOTION, axis=1)
        others = np.arange(persons, len(kinds), dtype=np.int32)
        mover = np.concatenate([others[:doors], np.repeat(others[doors:], 4)])
        moving = moved[mover]
        outlines = Outlines(faces[:, moving], mover[moving])
        poses = np.concatenate([poses, placed.poses], axis=1)
        sizes = np.full((poses.shape[1], 2), np.nan)
        sizes[persons : persons + doors] = np.column_stack([world.doors.width, np.zeros(doors)])
        sizes[persons + doors : len(kinds)] = world.traffic.size
        return Motion(
            **clock._asdict(),
            robot=np.stack(self.robot),
            poses=poses,
            kinds=kinds + ["thing"] * placed.poses.shape[1],
            people=people,
            outlines=outlines,
            things=placed.outlines,
            still=np.concatenate([faces[0, ~moving], placed.still]),
            sizes=sizes,
            moved=np.concatenate([moved, placed.moved]),
        )
