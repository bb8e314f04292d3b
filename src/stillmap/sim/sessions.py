"""Sessions: recordings of one world on different days, between which things change."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.sim.objects import faces_at_all_places
from stillmap.sim.planner import Float, FreeSpace, Planner
from stillmap.sim.scene import Point, Scene, Segment
from stillmap.sim.session_layout import Layout, StandingObject
from stillmap.sim.simulator import Simulation, simulate
from stillmap.sim.walls import polyline

Region = tuple[float, float, float, float]  # x0, y0, x1, y1 in metres

_MARGIN = 0.15  # m between the robot's footprint and walls, as along its route
_CANDIDATES = 24  # random points, the farthest of which from all visited ones comes next
_MAX_LEG = 18.0  # m between one point of a tour and the next, as the crow flies
_MAX_DETOUR = 3.0  # times as long as the crow flies
_MAX_POINTS = 400  # of a tour
_ANCHORS = 12  # random points of a region, the largest part around which it explores
_VIA = 8.0  # m between the points of a piece of a street
_MAX_ASIDE = 0.5  # m, by which a car drives beside the route
_SECONDS = 200.0  # of a session, unless the number of scans is given
_SECONDS_3D = 12.0  # the same with a lidar
_MIN_SPEED = 0.8  # m/s, of the robot indoors, so that a session shows much of the place
_DAY = 86_400  # s


@dataclass(frozen=True)
class SessionOptions:
    """Common settings of sessions, and their differences.

    Attributes:
        count: number of sessions.
        regions: of each session, where the robot stays, metres; None: anywhere.
        has_changes: whether things are moved between sessions.
        other_mounts: whether each session has the sensor mounted otherwise.
        odd_sensor: whether one session has half the beams or a narrower field of view.
        begins: of each session in a street, metres along its route; empty: random.
    """

    count: int
    regions: tuple[Region | None, ...] = ()
    has_changes: bool = True
    other_mounts: bool = True
    odd_sensor: bool = True
    begins: tuple[float, ...] = ()


class SessionPlan(NamedTuple):
    """The scenes of S sessions.

    Attributes:
        name: of the world.
        scenes: one of each session; its things are the objects that are there, in order.
        objects: everything that may change; a scene's things are those present, in this order.
        first_stamp_ns: (S,) when each begins.
        seeds: (S,) of each simulation.
    """

    name: str
    scenes: tuple[Scene, ...]
    objects: tuple[StandingObject, ...]
    first_stamp_ns: tuple[int, ...]
    seeds: tuple[int, ...]

    def present(self, session: int) -> list[int]:
        """Index of the object of each thing of a session's scene."""
        return [k for k, one in enumerate(self.objects) if one.places[session] is not None]


def plan_sessions(scene: Scene, options: SessionOptions, seed: int = 0) -> SessionPlan:
    """Plan the sessions of a world: what stands where, routes, sensors, times.

    With one more session, the former ones stay as they are, but for the odd sensor.

    Args:
        scene: the world; its doors get a constant angle in each session.
        options: number of sessions, and in what they differ.
        seed: of everything, the simulations too.

    Raises:
        InputError: the world cannot be recorded in sessions, or the robot finds no room.
    """
    _require_plain(scene, options)
    layout_rng, *rngs = np.random.default_rng(seed).spawn(1 + options.count)
    odd = _draw_odd(options, seed)
    layout = Layout(scene, layout_rng)
    for _ in range(1, options.count):
        layout.go_on(options.has_changes)
    objects = layout.objects()
    scenes, stamps = [], []
    for session, rng in enumerate(rngs):
        region = options.regions[session] if options.regions else None
        region = None if region is None else clip_region(region, scene.walls)
        base = dataclasses.replace(
            scene,
            walls=layout.walls,
            leaves=(),
            lights=(),
            things=tuple(t for one in objects if (t := one.thing(session)) is not None),
        )
        begin = options.begins[session] if options.begins else None
        scenes.append(_vary(base, options, session == odd, (region, begin), rng))
        stamps.append((session * _DAY + int(rng.integers(0, _DAY // 3))) * 10**9)
    seeds = tuple(int(rng.integers(1 << 31)) for rng in rngs)
    return SessionPlan(scene.name, tuple(scenes), objects, tuple(stamps), seeds)


def simulate_sessions(plan: SessionPlan) -> Iterator[Simulation]:
    """Simulate one session after the other.

    Each truth has `thing`: the index of the object of the plan that each beam hit, or -1.

    Raises:
        InputError: no room for the robot or the people.
    """
    for session, (scene, seed) in enumerate(zip(plan.scenes, plan.seeds, strict=True)):
        made = simulate(scene, seed)
        recording, truth = made.recording, made.truth
        later = recording.stamp_ns + plan.first_stamp_ns[session]
        thing = np.full(len(truth.mover), -1, np.int32) if truth.thing is None else truth.thing
        which = np.array([*plan.present(session), -1], np.int32)  # -1 stays -1
        yield dataclasses.replace(
            made,
            recording=dataclasses.replace(recording, stamp_ns=later),
            truth=dataclasses.replace(truth, thing=which[thing]),
        )


def _require_plain(scene: Scene, options: SessionOptions) -> None:
    """Refuse worlds whose things change during a recording, and what sessions do not have.

    Raises:
        InputError: such a world.
    """
    if options.count < 1:
        raise InputError(f"the number of sessions must be 1 or more, got {options.count}")
    for of_sessions in (options.regions, options.begins):
        if of_sessions and len(of_sessions) != options.count:
            raise InputError("as many regions and begins as sessions")
    if scene.things:
        hint = "the same world without '-moved'"
        raise InputError(f"the things of '{scene.name}' move within a recording", hint=hint)
    if scene.rig.tilts or scene.camera.enabled or scene.robot.pause_at is not None:
        raise InputError("sessions have one laser or lidar, no camera and no pause")


def _draw_odd(options: SessionOptions, seed: int) -> int | None:
    """The session, not the first one, with another sensor."""
    if not options.odd_sensor or options.count < 2:
        return None
    return int(np.random.default_rng([seed, options.count]).integers(1, options.count))


def _vary(
    scene: Scene,
    options: SessionOptions,
    odd: bool,
    where: tuple[Region | None, float | None],
    rng: np.random.Generator,
) -> Scene:
    """The scene with a route, a number of scans and a sensor of its own.

    where: the region in which the robot stays, or where along a street it begins.
    """
    region, begin = where
    is_drive = scene.robot.radius > 0.5  # a car keeps to the street
    speed = scene.robot.speed if is_drive else max(_MIN_SPEED, scene.robot.speed)
    seconds = _SECONDS_3D if scene.in_3d else _SECONDS
    scans = scene.robot.scans or round(seconds * scene.scan_rate)
    length = speed * scans / scene.scan_rate
    route = (
        draw_piece(scene.route, length, rng, begin)
        if is_drive
        else draw_tour(scene, length, rng, region)
    )
    scene = dataclasses.replace(
        scene,
        route=route,
        people_at=scene.people_at or route[:1],
        kerbs=scene.kerbs if region is None else (*scene.kerbs, *fence(region)),
        robot=dataclasses.replace(scene.robot, speed=speed, scans=scans),
    )
    x, y, yaw = rng.uniform((-0.1, -0.1, -0.4), (0.2, 0.1, 0.4)).tolist()
    narrow = rng.random() < 0.5
    laser, lidar = scene.laser, scene.lidar
    if options.other_mounts:
        laser = dataclasses.replace(laser, x=laser.x + x, y=laser.y + y, yaw=laser.yaw + yaw)
        lidar = dataclasses.replace(lidar, x=lidar.x + x, y=lidar.y + y, yaw=lidar.yaw + yaw)
    if odd:
        laser = dataclasses.replace(
            laser,
            fov=laser.fov * (0.75 if narrow else 1.0),
            beams=max(2, round(laser.beams * (0.75 if narrow else 0.5))),
        )
        lidar = dataclasses.replace(lidar, columns=max(4, lidar.columns // 2))
    return dataclasses.replace(scene, laser=laser, lidar=lidar)


def draw_tour(
    scene: Scene, length: float, rng: np.random.Generator, region: Region | None = None
) -> tuple[Point, ...]:
    """A random tour of `length` metres, from any place to points far from all visited so far.

    Args:
        scene: the world with everything that stands in it.
        length: metres, at least.
        rng: generator.
        region: the robot stays in it; None: anywhere that it can reach.

    Raises:
        InputError: the robot finds no room.
    """
    planner = _planner(scene, rng, region)
    nodes = planner.point(planner.nodes)
    if region is not None:
        inside = is_within(nodes, region)
        nodes = nodes[inside] if inside.any() else nodes
    at = nodes[rng.integers(len(nodes))]
    tour, visited, driven = [at], at[None], 0.0
    while driven < length and len(tour) < _MAX_POINTS:
        goal = _next_goal(at, visited, nodes, rng)
        way = planner.path(at, planner.node(goal))
        legs = np.concatenate([at[None], way])
        driven += float(np.hypot(*np.diff(legs, axis=0).T).sum())
        tour += list(way)
        visited, at = np.concatenate([visited, way]), way[-1]
    return tuple((float(x), float(y)) for x, y in tour)


def _next_goal(at: Float, visited: Float, nodes: Float, rng: np.random.Generator) -> Float:
    """A node not too far away, and far from all that were visited."""
    some = nodes[rng.integers(len(nodes), size=_CANDIDATES)]
    away = np.hypot(*(some - at).T)
    near = (away > 1.0) & (away < _MAX_LEG)
    if near.any():
        some = some[near]
    gap = np.hypot(*(some[:, None] - visited).transpose(2, 0, 1)).min(axis=1)
    return np.asarray(some[gap.argmax()])


def _planner(scene: Scene, rng: np.random.Generator, region: Region | None) -> Planner:
    """The planner of the largest part of free space that the world's route leads into."""
    things = faces_at_all_places(scene.things)
    solid = np.array([*scene.walls, *scene.glass, *scene.mirrors, *scene.kerbs, *things], float)
    radius = scene.robot.radius + _MARGIN
    space = FreeSpace(solid)
    if region is None:
        return _largest_part(space, np.array(scene.route, float), radius)
    parts = _parts(space, np.array(scene.route, float), radius)
    inside = np.concatenate([part.point(part.nodes) for part in parts])
    inside = inside[is_within(inside, region)]
    if not len(inside):
        raise InputError("the robot finds no room in its region", hint="another seed or region")
    some = inside[rng.integers(len(inside), size=_ANCHORS)]
    return _largest_part(space.with_walls(np.array(fence(region), float)), some, radius)


def _largest_part(space: FreeSpace, anchors: Float, radius: float) -> Planner:
    """The planner of the part with most room, among those that points (K, 2) lie in."""
    parts = _parts(space, anchors, radius)
    if not parts:
        raise InputError("the robot finds no room for a tour", hint="another seed or region")
    return max(parts, key=lambda part: len(part.nodes))


def _parts(space: FreeSpace, anchors: Float, radius: float) -> list[Planner]:
    """Planners of the parts of free space that points (K, 2) lie in."""
    parts: list[Planner] = []
    for anchor in anchors:
        try:
            if not any(part.contains(anchor) for part in parts):
                parts.append(Planner(space, anchor, radius))
        except InputError:  # something stands there
            continue
    return parts


def clip_region(region: Region, walls: tuple[Segment, ...]) -> Region:
    """The part of a region that lies within the extent of walls."""
    ends = np.reshape(walls, (-1, 2)).astype(float)
    low = np.maximum(region[:2], ends.min(axis=0)).tolist()
    high = np.minimum(region[2:], ends.max(axis=0)).tolist()
    return (low[0], low[1], high[0], high[1])


def fence(region: Region) -> tuple[Segment, ...]:
    """The outline of a region as kerbs, which nobody crosses and no laser sees."""
    x0, y0, x1, y1 = region
    return tuple(polyline([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], closed=True))


def is_within(points: Float, region: Region) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) lie in a region."""
    x0, y0, x1, y1 = region
    x, y = points.T
    return np.asarray((x > x0) & (x < x1) & (y > y0) & (y < y1))


def draw_piece(
    route: tuple[Point, ...], length: float, rng: np.random.Generator, begin: float | None = None
) -> tuple[Point, ...]:
    """A piece of a street's route of `length` metres, or all of it, a little to the side.

    Args:
        route: points in metres.
        length: metres.
        rng: generator.
        begin: metres along the route; None: random.
    """
    line = np.array(route, float)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    room = max(0.0, along[-1] - length)
    begin = room * rng.random() if begin is None else min(max(begin, 0.0), room)
    end = min(begin + length, along[-1])
    aside = rng.uniform(-_MAX_ASIDE, _MAX_ASIDE)
    corners = along[(along > begin + 1.0) & (along < end - 1.0)]
    at = np.unique(np.concatenate([np.arange(begin, end, _VIA), corners, [end]]))
    points = np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])
    heading = np.gradient(points, axis=0)
    heading /= np.maximum(np.hypot(*heading.T), 1e-9)[:, None]
    points += aside * np.column_stack([-heading[:, 1], heading[:, 0]])
    return tuple((float(x), float(y)) for x, y in points)
