"""Sessions: recordings of one world on different days, between which things change; their truth."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.sim.dynamics import faces_at_all_places
from stillmap.sim.options import HeightOptions
from stillmap.sim.planner import Float, FreeSpace, Planner
from stillmap.sim.scene import Point, Scene, Segment
from stillmap.sim.session_layout import Layout, StandingObject
from stillmap.sim.simulator import Simulation, simulate
from stillmap.sim.walls import polyline
from stillmap.sim.world_3d import make_parts, trace_loops

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


SESSIONS_FILE = "sessions.json"
_CELL, _CELL_3D = 0.1, 0.5  # m, of the area that counts as observed
_EVERY = 3  # of the scans, for that area
_BLOCK = 200  # scans at once


class TrueChange(NamedTuple):
    """A change between two successive sessions.

    Attributes:
        object: index of the object.
        kind: "appeared", "gone", "moved" or "door".
        box: x0, y0, x1, y1 in metres and in 3D z0, z1; where it is now, or was.
        from_box: where it was, of what moved and of doors.
        between: the last session before and the first one after.
    """

    object: int
    kind: str
    box: tuple[float, ...]
    from_box: tuple[float, ...] | None
    between: tuple[int, int]

    def to_dict(self, number: int, names: list[str]) -> dict[str, Any]:
        """As JSON; `number`: its id."""
        made: dict[str, Any] = {"id": number, "object": self.object, "kind": self.kind}
        made["box"] = list(self.box)
        if self.from_box is not None:
            made["from_box"] = list(self.from_box)
        return {**made, "between": [names[k] for k in self.between]}


def list_changes(
    objects: tuple[StandingObject, ...], heights: HeightOptions | None
) -> list[TrueChange]:
    """The changes between successive sessions, in order.

    Args:
        objects: with their places in each session.
        heights: of a 3D world, for z; None: in 2D.
    """
    changes = []
    sessions = len(objects[0].places) if objects else 0
    for after in range(1, sessions):
        for number, one in enumerate(objects):
            old, new = one.places[after - 1], one.places[after]
            if old == new:
                continue
            z = () if heights is None else (0.0, _height(one, heights))
            was = None if old is None else (*one.extent(after - 1), *z)
            box = None if new is None else (*one.extent(after), *z)
            kind = "appeared" if was is None else "gone" if box is None else "moved"
            kind = "door" if one.kind == "door" else kind
            moved = was if box is not None else None
            changes.append(TrueChange(number, kind, box or was or (), moved, (after - 1, after)))
    return changes


def _height(one: StandingObject, heights: HeightOptions) -> float:
    """m, of the highest part of an object in 3D."""
    loops, _ = trace_loops(one.faces)
    tops = [part.z[1] for loop in loops for part in make_parts(loop, heights)]
    return max(tops, default=heights.furniture)


class Sight(NamedTuple):
    """Observations of one session: cells (K, 2) that it observed, and of each static hit (H, 2)."""

    observed: NDArray[np.int64]
    hits: NDArray[np.int64]


def observe(one: Simulation) -> Sight:
    """The cells that a session observed: passed or hit in 2D, hit in 3D."""
    cell = _CELL_3D if one.scene.in_3d else _CELL
    hits, seen = [], [np.empty((0, 2), np.int64)]
    for scans, start, end, static in _beams_in_world(one):
        hits.append(np.floor(end[static] / cell).astype(np.int64))
        if one.scene.in_3d:
            seen.append(np.unique(hits[-1], axis=0))
        else:
            some = scans % _EVERY == 0
            seen.append(_passed_cells(start[some], end[some], cell))
    return Sight(np.unique(np.concatenate(seen), axis=0), np.concatenate(hits))


def _beams_in_world(
    one: Simulation,
) -> Iterator[tuple[NDArray[np.int64], Float, Float, NDArray[np.bool_]]]:
    """Scan, start and end in the plane, and whether a static surface was hit, of M beams."""
    recording, truth = one.recording, one.truth
    T_world_sensor = truth.T_world_base @ recording.T_base_sensor[recording.sensor]
    for first in range(0, recording.n_scans, _BLOCK):
        last = min(first + _BLOCK, recording.n_scans)
        part = slice(int(recording.offset[first]), int(recording.offset[last]))
        counts = np.diff(recording.offset[first : last + 1])
        scans = np.repeat(np.arange(first, last), counts)
        T = T_world_sensor[scans]
        points = np.asarray(recording.points[part], np.float64)
        end = np.einsum("nij,nj->ni", T[:, :2, :-1], points) + T[:, :2, -1]
        yield scans, T[:, :2, -1], end, np.asarray(truth.static[part])


def _passed_cells(start: Float, end: Float, cell: float) -> NDArray[np.int64]:
    """(K, 2) cells that hold points, a cell apart, along beams from (N, 2) to (N, 2)."""
    if not len(start):
        return np.empty((0, 2), np.int64)
    low = np.floor(np.minimum(start, end).min(axis=0) / cell).astype(np.int64)
    high = np.floor(np.maximum(start, end).max(axis=0) / cell).astype(np.int64)
    seen = np.zeros(high - low + 1, bool)
    steps = np.ceil(np.hypot(*(end - start).T) / cell).astype(np.int64)
    order = np.argsort(-steps)
    start, along, steps = start[order], (end - start)[order], steps[order]
    for n in range(int(steps.max()) + 1):
        longer = np.searchsorted(-steps, -n, side="right")
        at = start[:longer] + (n / np.maximum(steps[:longer], 1))[:, None] * along[:longer]
        seen[tuple((np.floor(at / cell).astype(np.int64) - low).T)] = True
    return np.asarray(np.argwhere(seen) + low)


def compute_overlap(sights: Sequence[Sight], places: Sequence[int]) -> Float:
    """(S, S) share of the static hits of session j in cells that session i observed.

    Sessions of different places have none in common.
    """
    every = np.concatenate([cells for sight in sights for cells in sight])
    low = every.min(axis=0)
    shape = every.max(axis=0) - low + 1
    overlap = np.zeros((len(sights), len(sights)))
    for i, one in enumerate(sights):
        seen = np.zeros(shape, bool)
        seen[tuple((one.observed - low).T)] = True
        for j, other in enumerate(sights):
            if places[i] == places[j] and len(other.hits):
                overlap[i, j] = seen[tuple((other.hits - low).T)].mean()
    return overlap
