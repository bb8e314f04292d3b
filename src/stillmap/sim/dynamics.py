"""Motion of robot, people, doors, vehicles and movable objects, sampled at the scans."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Int32, Int64
from stillmap.core.errors import InputError
from stillmap.sim.laser import Movers, Outlines
from stillmap.sim.options import DoorOptions
from stillmap.sim.people import BODY_RADIUS, Crowd, Figures
from stillmap.sim.planner import FreeSpace, Planner
from stillmap.sim.robot import Robot, plan_route
from stillmap.sim.scene import Door, Scene, Stay, Thing
from stillmap.sim.vehicles import Traffic


def faces_at_all_places(things: tuple[Thing, ...]) -> Float:
    """(K, 4) faces of all objects at all their places."""
    faces = [place_faces(thing, stay) for thing in things for stay in thing.stays]
    return np.concatenate([np.empty((0, 4)), *faces])


def place_things(things: tuple[Thing, ...], seconds: Float) -> tuple[Float, Float, list[int]]:
    """Poses (T, P, 3) of P movable objects at times (T,), their faces (T, K, 4), whose each is (K).

    Poses of absent objects are NaN, their faces of length 0.
    """
    poses = np.full((len(seconds), len(things), 3), np.nan)
    for number, thing in enumerate(things):
        for stay in thing.stays:
            end = np.inf if stay.until is None else stay.until
            is_there = (seconds >= stay.since) & (seconds < end)
            poses[is_there, number] = (stay.x, stay.y, stay.yaw)
    faces = [transform_faces(thing, poses[:, number]) for number, thing in enumerate(things)]
    owner = [number for number, thing in enumerate(things) for _ in thing.faces]
    return poses, np.concatenate([np.empty((len(seconds), 0, 4)), *faces], axis=1), owner


def place_faces(thing: Thing, stay: Stay) -> Float:
    """(K, 4) faces of an object in the world during a stay."""
    return np.asarray(transform_faces(thing, np.array([[stay.x, stay.y, stay.yaw]]))[0])


def transform_faces(thing: Thing, poses: Float) -> Float:
    """(T, K, 4) faces of an object at poses (T, 3); of length 0 where these are NaN."""
    T = se2.matrix(*poses.T)[:, None]
    ends = np.reshape(thing.faces, (-1, 2)).astype(float)
    moved = np.einsum("tkij,nj->tni", T[..., :2, :2], ends) + T[..., :2, 2]
    return np.asarray(np.nan_to_num(moved.reshape(len(poses), -1, 4)), np.float64)


DOOR_RANGE = 3.0  # m from the doorway, at which a person opens the door

_MIN_CLEARANCE = 1.2  # m from the doorway's center to people, for a leaf to close


class Doors:
    """State of D doors.

    Attributes:
        share: (D,) opening, from 0 to 1.
        width: (D,) metres.
    """

    def __init__(
        self, doors: tuple[Door, ...], options: DoorOptions, rng: np.random.Generator
    ) -> None:
        D = len(doors)
        self._options, self._rng = options, rng
        self._hinge = np.array([door.hinge for door in doors]).reshape(-1, 2)
        self.width = np.array([door.width for door in doors])
        self._closed = np.array([door.closed for door in doors])
        self._sweep = np.array([door.opened for door in doors]) - self._closed
        leaf = self.width[:, None] * _direction(self._closed)
        self._end, self._middle = self._hinge + leaf, self._hinge + leaf / 2
        self._opens = rng.random(D) < 0.5
        self.share = self._opens.astype(float)
        self._left = rng.random(D) * [self._draw_duration(opens) for opens in self._opens.tolist()]

    @property
    def angle(self) -> Float:
        """(D,) rad, direction from the hinge along the leaf."""
        return np.asarray(self._closed + self.share * self._sweep)

    def poses(self) -> Float:
        """(D, 3) center of each leaf in metres and its direction in radians."""
        middle = self._hinge + self.width[:, None] / 2 * _direction(self.angle)
        return np.column_stack([middle, self.angle])

    def faces(self) -> Float:
        """(D, 4) each leaf as a segment from its hinge."""
        end = self._hinge + self.width[:, None] * _direction(self.angle)
        return np.concatenate([self._hinge, end], axis=1)

    def step(self, dt: float, standing: Float, ways: Float) -> None:
        """Advance by dt seconds.

        Args:
            dt: seconds.
            standing: (N, 2) positions of people and robot, metres.
            ways: (K, 4) next segments of their paths, x0, y0, x1, y1.
        """
        delta = self._middle[:, None] - standing
        near = np.any(np.hypot(delta[..., 0], delta[..., 1]) < _MIN_CLEARANCE, axis=1)
        start, end = ways[:, None, :2], ways[:, None, 2:]
        aside = _side_of(self._hinge, self._end, start) * _side_of(self._hinge, self._end, end)
        through = _side_of(start, end, self._hinge) * _side_of(start, end, self._end)
        passing = np.any((aside < 0) & (through < 0), axis=0)
        self._left -= dt
        over = (self._left <= 0) & ~passing & ~near
        for which in (passing & ~self._opens, over):
            for door in np.flatnonzero(which).tolist():
                self._opens[door] = not self._opens[door]
                self._left[door] = self._draw_duration(self._opens[door])
        step = dt / self._options.swing
        change = np.where(self._opens, step, np.where(near, 0.0, -step))
        self.share = np.clip(self.share + change, 0.0, 1.0)

    def _draw_duration(self, opens: bool) -> float:
        o = self._options
        limits = (o.min_open, o.max_open) if opens else (o.min_closed, o.max_closed)
        return float(np.exp(self._rng.uniform(*np.log(limits))))


def split_into_segments(corners: Float) -> Float:
    """(N (K - 1), 4) segments of N paths with K corners (N, K, 2)."""
    return np.concatenate([corners[:, :-1], corners[:, 1:]], axis=-1).reshape(-1, 4)


def _direction(angle: Float) -> Float:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _side_of(a: Float, b: Float, c: Float) -> Float:
    """Positive where c lies to the left of the line from a to b."""
    along, across = b - a, c - a
    return np.asarray(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])


Progress = Callable[[float], None]
Rngs = Sequence[np.random.Generator]

_MAX_STEP = 0.1  # s of a time step
_ROBOT_MARGIN = 0.15  # m between the robot's footprint and walls along its route
_PERSON_MARGIN = 0.1  # m
_MAX_DELAY = 5.0  # times the nominal time of the route, after which the robot is stuck
_MIN_MOTION = 1e-6  # m
MAX_SPEED = 40.0  # m/s; anything faster has restarted its lane
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
        still_thing: (K,) index of the movable object that each of these belongs to; -1: of another
            mover.
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
    still_thing: Int32
    sizes: Float
    moved: Bool


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
    carried = math.inf if o.carried_at is None else max(1, round(o.carried_at * expected))
    paused = math.inf if o.pause_at is None else max(1, round(o.pause_at * rate))
    log: list[tuple[Float, ...]] = []
    while not _is_done(scene, world.robot, len(log), expected):
        if len(log) == carried:
            world.robot.put_down(rngs[3], world.obstacles())
            world.rest_robot(o.carried_time, dt)
        if len(log) == paused:
            world.rest_robot(min(o.pause, _MAX_SIMULATED_PAUSE), dt)
        log.append(world.snapshot())
        if len(log) % 50 == 0:
            tell(min(len(log) / expected, 1.0))
        for _ in range(steps):
            world.step(dt)
    scan = np.arange(len(log))
    seconds = scan * (1.0 / rate) + o.carried_time * (scan >= carried) + o.pause * (scan >= paused)
    gaps = [int(min(first, len(log))) for first in (carried, paused)]
    return world.collect_motion(log, 1.0 / rate, seconds, *gaps)


class _World:
    """State of robot, people, doors, vehicles and movable objects of a scene."""

    def __init__(self, scene: Scene, rngs: Rngs) -> None:
        start, o = np.array(scene.route[0], float), scene.robot
        # an open leaf is an obstacle, a closed one opens
        leaves = [door.leaf(door.opened) for door in scene.leaves]
        self._things = scene.things
        things = faces_at_all_places(scene.things)
        solid = [*scene.walls, *scene.glass, *scene.mirrors, *scene.kerbs, *leaves, *things]
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

    def rest_robot(self, seconds: float, dt: float) -> None:
        """Stop the robot, while everything else moves in steps of dt seconds."""
        for _ in range(round(seconds / dt)):
            self.robot.stand(dt)
            self._step_others(dt)

    def step(self, dt: float) -> None:
        """Advance everything by dt seconds."""
        self.robot.step(dt, self.obstacles(), self._radius + BODY_RADIUS)
        self._step_others(dt)

    def obstacles(self) -> Float:
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
            ways = [split_into_segments(path) for path in (crowd.next_corners(DOOR_RANGE), way)]
            self.doors.step(dt, standing, np.concatenate(ways))
        if self.traffic.kinds:
            self.traffic.step(dt, robot.pose[:2], self._radius)

    def snapshot(self) -> tuple[Float, ...]:
        """Robot, other movers, parts of people and their headings, faces of doors and vehicles."""
        crowd, doors, traffic = self.crowd, self.doors, self.traffic
        people = np.column_stack([crowd.xy, crowd.heading])
        movers = np.concatenate([people, doors.poses(), traffic.poses()])
        faces = np.concatenate([doors.faces(), traffic.faces()])
        return self.robot.pose, movers, *self.figures.parts(crowd), faces

    def collect_motion(
        self, log: list[tuple[Float, ...]], period: float, seconds: Float, carried: int, paused: int
    ) -> Motion:
        """The motion of T snapshots; the other arguments as in `Motion`."""
        robot, poses, xy, heading, faces = map(np.stack, zip(*log, strict=True))
        persons, doors = len(self.crowd.xy), len(self.doors.share)
        kinds = ["person"] * persons + ["door"] * doors + self.traffic.kinds
        first = len(kinds)
        moved = np.any(np.ptp(poses, axis=0) > _MIN_MOTION, axis=1)
        things, thing_faces, owner = place_things(self._things, seconds)
        moved = np.append(moved, np.any(things != things[:1], axis=(0, 2)))
        vehicles = np.repeat(np.arange(persons + doors, first), 4)
        of_doors, of_things = np.arange(persons, persons + doors), first + np.array(owner, int)
        mover = np.concatenate([of_doors, vehicles, of_things]).astype(np.int32)
        faces = np.concatenate([faces, thing_faces], axis=1)
        moving, is_thing = moved[mover], mover >= first
        parts = (moving & ~is_thing, moving & is_thing)
        outlines, jumping = (Outlines(faces[:, part], mover[part]) for part in parts)
        sizes = np.full((len(moved), 2), np.nan)
        sizes[persons : persons + doors] = np.column_stack([self.doors.width, np.zeros(doors)])
        sizes[persons + doors : first] = self.traffic.size
        return Motion(
            period,
            seconds,
            carried,
            paused,
            robot,
            poses=np.concatenate([poses, things], axis=1),
            kinds=kinds + ["thing"] * len(self._things),
            people=Movers(xy, heading, self.figures.semi_axes, self.figures.mover),
            outlines=outlines,
            things=jumping,
            still=faces[0, ~moving],
            still_thing=np.where(is_thing, mover - first, -1)[~moving].astype(np.int32),
            sizes=sizes,
            moved=moved,
        )


def _is_done(scene: Scene, robot: Robot, scans: int, expected: float) -> bool:
    if scene.robot.scans is not None:
        return scans >= scene.robot.scans
    if scans > _MAX_DELAY * expected + 100:
        x, y, _ = robot.pose
        what = f"the robot gets stuck at ({x:.1f}, {y:.1f})"
        raise InputError(what, hint="fewer people, or a number of scans")
    return robot.arrived


class Moment:
    """N times, `seconds` (N,) after the stamps of `scans` (N,), for interpolation of the motion.

    Motion is linear between scans, and extrapolated after the last one.
    """

    def __init__(self, motion: Motion, scans: Int64, seconds: Float) -> None:
        self._motion = motion
        later = seconds / motion.period
        # no interpolation across the gaps where the robot is carried or pauses
        breaks = np.unique([0, motion.carried, motion.paused, len(motion.robot)])
        piece = np.searchsorted(breaks, scans, side="right")
        self._last = breaks[piece] - 1
        first, last = breaks[piece - 1], self._last - (later > 0)
        self._scan, self._leap = scans, MAX_SPEED * motion.period
        self._before = np.maximum(np.minimum(scans + later.astype(np.int64), last), first)
        self._share = scans + later - self._before

    def interpolate_movers(self) -> tuple[Movers, Outlines]:
        """Cross sections and faces of the movers."""
        people, outlines, things = self._motion.people, self._motion.outlines, self._motion.things
        xy, heading = self.interpolate(people.xy), self.interpolate(people.heading)
        # movable objects jump from place to place
        faces = np.concatenate([self.interpolate(outlines.faces), things.faces[self._scan]], axis=1)
        mover = np.concatenate([outlines.mover, things.mover])
        return Movers(xy, heading, people.semi_axes, people.mover), Outlines(faces, mover)

    def interpolate(self, values: Float) -> Float:
        """(N, ...) values interpolated from those of all scans (T, ...)."""
        before = values[self._before]
        change = values[np.minimum(self._before + 1, self._last)] - before
        share = self._share.reshape(-1, *[1] * (values.ndim - 1))
        leaps = np.abs(change) > self._leap
        return np.where(leaps, values[self._scan], before + share * change)
