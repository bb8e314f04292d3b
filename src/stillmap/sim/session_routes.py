"""Routes of the robot in sessions: random tours of a building, pieces of a street."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.sim.objects import faces_at_all_places
from stillmap.sim.planner import Float, FreeSpace, Planner
from stillmap.sim.scene import Point, Scene, Segment
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
