"""Everybody and everything moves, scan by scan: robot, people, doors, vehicles and things."""

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

_STEP = 0.1  # s, at most, between two positions of people and robot
_ROBOT_MARGIN = 0.15  # m beyond its radius that the robot's way keeps from walls
_PERSON_MARGIN = 0.1  # m
_SLOWEST = 5.0  # times the time that the route takes undisturbed: then something holds the robot
_STILL = 1e-6  # m
_CARRIED = 20.0  # s, for which a robot that is carried elsewhere records nothing
_SETTLING = 30.0  # s of a pause after which nobody is where he was: the rest is not acted out


@dataclass(frozen=True, eq=False)
class Motion:
    """Where everything is at each of T scans.

    Attributes:
        period: seconds from one scan to the next.
        seconds: (T,) since the recording began.
        carried: the first scan after the robot was carried elsewhere; T if it never is.
        paused: the first scan after the robot stood without recording; T if it never does.
        robot: (T, 3) x, y in metres, theta in radians.
        poses: (T, P, 3) the same of all movers: people, doors, vehicles, things; NaN where there
            is no such thing.
        kinds: (P) what each mover is.
        people: what the laser sees of people.
        outlines: what it sees of doors and vehicles.
        things: what it sees of things: from one scan to the next they are elsewhere, or nowhere.
        still: (K, 4) faces of those among all these that never moved.
        sizes: (P, 2) metres, length and width of doors and vehicles; NaN of people and things.
        moved: (P,) whether each mover is anywhere else at any time.
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
    """Let everything move, and note where it is at each scan.

    Args:
        scene: the world and all parameters.
        rngs: for people, doors, vehicles, and the place that the robot is carried to.
        tell: called now and then with the share that is done.

    Raises:
        InputError: no room for the robot on its route or for the people, or the robot is held up.
    """
    world = _World(scene, rngs)
    o, rate = scene.robot, scene.scan_rate
    steps = max(1, math.ceil(1.0 / (rate * _STEP) - 1e-9))
    dt = 1.0 / (rate * steps)
    expected = o.scans or world.robot.nominal_time() * rate
    carried = None if o.carried_at is None else max(1, round(o.carried_at * expected))
    paused = None if o.pause_at is None else max(1, round(o.pause_at * rate))
    log = _Log()
    while not _is_done(scene, world.robot, len(log.robot), expected):
        if len(log.robot) == carried:
            world.carry_robot(dt, rngs[3])
        if len(log.robot) == paused:
            world.rest_robot(min(o.pause, _SETTLING), dt)
        log.note(world)
        if len(log.robot) % 50 == 0:
            tell(min(len(log.robot) / expected, 1.0))
        for _ in range(steps):
            world.step(dt)
    return log.motion(world, _clock(len(log.robot), 1.0 / rate, carried, paused, o.pause))


class _Clock(NamedTuple):
    """When T scans were taken; fields as in `Motion`."""

    period: float
    seconds: Float
    carried: int
    paused: int


def _clock(T: int, period: float, carried: int | None, paused: int | None, pause: float) -> _Clock:
    scan = np.arange(T)
    first = [T if one is None else min(one, T) for one in (carried, paused)]
    seconds = scan * period + _CARRIED * (scan >= first[0]) + pause * (scan >= first[1])
    return _Clock(period, seconds, *first)


class _World:
    """Robot, people with what is seen of them, doors, vehicles and things of a scene."""

    def __init__(self, scene: Scene, rngs: Rngs) -> None:
        start, o = np.array(scene.route[0], float), scene.robot
        # an open leaf is in the way, a closed one opens for whoever comes
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
        """Take the robot to another place; everything else goes on, by steps of dt seconds."""
        self.robot.put_down(rng, self._in_the_way())
        self.rest_robot(_CARRIED, dt)

    def rest_robot(self, seconds: float, dt: float) -> None:
        """The robot stands for so long; everything else goes on, by steps of dt seconds."""
        for _ in range(round(seconds / dt)):
            self.robot.stand(dt)
            self._others_step(dt)

    def step(self, dt: float) -> None:
        """Everything goes on for dt seconds."""
        self.robot.step(dt, self._in_the_way(), self._radius + BODY_RADIUS)
        self._others_step(dt)

    def _in_the_way(self) -> Float:
        """(N, 2) where people and corners of vehicles are."""
        if not self.traffic.kinds:
            return self.crowd.xy
        return np.concatenate([self.crowd.xy, self.traffic.faces().reshape(-1, 2)])

    def _others_step(self, dt: float) -> None:
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
    if scans > _SLOWEST * expected + 100:
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
        moved = np.any(np.ptp(poses, axis=0) > _STILL, axis=1)
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
