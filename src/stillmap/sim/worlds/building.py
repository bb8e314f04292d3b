"""A building whose wings and floors grow with the number of scans."""

import itertools
import math
from collections.abc import Iterable, Iterator
from functools import cache
from typing import NamedTuple

import numpy as np

from stillmap.sim.options import CrowdOptions, RobotOptions
from stillmap.sim.scene import Point, Scene, Segment
from stillmap.sim.walls import Opening, Side, box, box_along, locate, pillar, room, wall

_SEED = 41
_LENGTH, _DEPTH = 34.0, 21.6  # m, of the ground that a wing stands on
_ENTRANCE = 2.4  # m, how wide its entrance is
_WEST, _EAST, _SOUTH, _NORTH = 5.2, 28.8, 1.6, 16.8  # m, the outer walls of the ring
_WIDTH = 2.2  # m, of its corridors
_INNER = _EAST - _WEST - 2 * _WIDTH, _NORTH - _SOUTH - 2 * _WIDTH  # m, of the block within it
_THICK = 0.15  # m, of walls
_DOOR = 1.0  # m, width of a doorway
_INSIDE = 1.5  # m behind its doorway, where the robot turns that looks into a room

# rooms along a wall of the ring: where the wall begins, its length, their side and depth
_ROWS: tuple[tuple[Point, float, Side, float], ...] = (
    ((_WEST, _SOUTH), _NORTH - _SOUTH, "west", 4.3),
    ((_WEST, _NORTH), _EAST - _WEST, "north", 4.3),
    ((_EAST, _SOUTH), _NORTH - _SOUTH, "east", 4.3),
    ((_WEST + _WIDTH, _NORTH - _WIDTH), _INNER[0], "south", 5.1),
    ((_WEST + _WIDTH, _SOUTH + _WIDTH), _INNER[0], "north", 5.1),
)


class _Wing(NamedTuple):
    """A wing with its entrance on the x axis, in metres; y into it.

    Attributes:
        walls: everything in it.
        entrance: where its entrance begins, on the x axis.
        views: for rooms that one can look into, a point before the doorway and one behind it.
    """

    walls: list[Segment]
    entrance: float
    views: list[tuple[Point, Point]]

    def tour(self, rooms: Iterable[int], westward: bool) -> list[Point]:
        """Once round the ring from the entrance, with a view into these rooms of `views`."""
        near, far = _SOUTH + _WIDTH / 2, _NORTH - _WIDTH / 2
        west, east = _WEST + _WIDTH / 2, _EAST - _WIDTH / 2
        gate: Point = (self.entrance + _ENTRANCE / 2, near)
        corners: list[Point] = [gate, (west, near), (west, far), (east, far), (east, near), gate]
        if not westward:
            corners.reverse()
        way, left = [corners[0]], [self.views[k] for k in rooms]
        for a, b in itertools.pairwise(corners):
            long = math.dist(a, b) + 1e-6
            passed = [v for v in left if math.dist(a, v[0]) + math.dist(v[0], b) < long]
            left = [view for view in left if view not in passed]
            for before, behind in sorted(passed, key=lambda view: math.dist(a, view[0])):
                way += [before, behind, before]
            way.append(b)
        return way


@cache
def _wing(number: int) -> _Wing:
    """Each has its own doors and furniture, and other rooms are open."""
    rng = np.random.default_rng([_SEED, number])
    entrance = float(rng.uniform(12.0, 19.0))
    wing = _Wing([], entrance, [])
    for row in _ROWS:
        _add_rooms(wing, *row, rng)
    gate = Opening(entrance - _WEST, _ENTRANCE, _SOUTH, is_open=True)
    closed = [Opening(float(rng.uniform(*ends)), 0.95, 0.18) for ends in ((1, 4), (18, 21))]
    openings = [closed[0], gate, closed[1]]
    wing.walls.extend(wall((_WEST, _SOUTH), _EAST - _WEST, "south", openings))
    sides: tuple[tuple[float, Side], ...] = ((_WEST + _WIDTH, "east"), (_EAST - _WIDTH, "west"))
    for x, side in sides:
        niche = Opening(float(rng.uniform(1.0, _INNER[1] - 2.0)), float(rng.uniform(0.8, 1.6)), 0.3)
        wing.walls.extend(wall((x, _SOUTH + _WIDTH), _INNER[1], side, [niche]))
    for x, out in ((_WEST + _WIDTH, -1.0), (_EAST - _WIDTH, 1.0)):  # cupboards
        deep, width, y = rng.uniform((0.3, 0.6, _SOUTH + 4.0), (0.5, 1.6, _NORTH - 4.0)).tolist()
        wing.walls.extend(box(x + out * deep / 2, y, deep, width))
    corner = rng.integers(4)
    x = _WEST + 0.3 if corner % 2 else _EAST - 0.3
    wing.walls.extend(pillar(x, _SOUTH + 0.3 if corner // 2 else _NORTH - 0.3, 0.2))
    return wing


def _add_rooms(
    wing: _Wing, start: Point, length: float, side: Side, depth: float, rng: np.random.Generator
) -> None:
    """Add a wall, the open rooms behind it, and where the robot looks into these."""
    openings, behind = [], []
    low = 0.2
    while length - low > 3.2:
        high = low + float(rng.uniform(3.6, 6.2))
        if length - high < 3.4:
            high = length - 0.2
        at = float(rng.uniform(low + 0.4, high - _DOOR - 0.4))
        opening = Opening(at, _DOOR, _THICK, rng.random() < 0.6)
        openings.append(opening)
        if opening.is_open:
            behind.append((low, high, opening))
        low = high + 0.2
    wing.walls.extend(wall(start, length, side, openings))
    for low, high, door in behind:
        wing.walls.extend(room(start, side, (low, high), depth, door))
        at = low + 0.2
        while high - at > 1.4:  # furniture in the back, out of the robot's way
            width, deep = rng.uniform((0.7, 0.5), (1.9, 0.9)).tolist()
            width = min(width, high - at - 0.2)
            back = depth - deep / 2 - float(rng.uniform(0.05, 0.5))
            center, angle = (at + width / 2, _THICK + back), float(rng.normal(0.0, 0.04))
            wing.walls.extend(box_along(start, side, center, width, deep, angle))
            at += max(width, deep) + float(rng.uniform(0.3, 1.6))
        middle = door.start + _DOOR / 2
        before = locate(start, side, middle, -_WIDTH / 2)
        wing.views.append((before, locate(start, side, middle, _THICK + _INSIDE)))


_COLUMNS = 4  # wings beside one another on each side of a floor's corridor
_ON_FLOOR = 2 * _COLUMNS  # wings
_HALF = 1.3  # m, half the width of the floors' corridors and of the one that joins them
_PITCH = 2 * (_HALF + _DEPTH) + 1.0  # m from floor to floor, which lie side by side
_ROOMS = 4  # that the robot looks into when it is in a wing for the first time
_ROBOT = RobotOptions(speed=0.8)
_SHARE = 0.8  # of the way at full speed: it turns, and people are in its way
_HUB: Point = (-_HALF, 0.0)


def building(scans: int | None = None) -> Scene:
    """As much of a building as a robot gets about in while it takes so many scans.

    Each floor has a corridor with four wings on each side, and floors lie side by side along a
    corridor that joins them, as if unrolled. A wing is a ring of corridors with rooms, 69 m around.
    The robot goes round one wing after the other and looks into rooms; after every second new wing
    it goes round an earlier one of the floor again, and after every second floor back to where it
    began. The route for more scans begins with the route for fewer; wings that this does not get to
    are not there, and their entrances are closed.

    Args:
        scans: how many; not given: one floor.
    """
    target = math.inf if scans is None else _SHARE * scans * _ROBOT.speed / _ROBOT.scan_rate
    route: list[Point] = [_HUB]
    length, wings = 0.0, 0
    for number, stops in _tours():
        if length >= target or (scans is None and number >= _ON_FLOOR):
            break
        length += sum(map(math.dist, [route[-1], *stops], stops))
        route += stops
        wings = max(wings, number + 1)
    y = (wings - 1) // _ON_FLOOR * _PITCH
    return Scene(
        name="building",
        walls=tuple(_walls(wings)),
        route=(*route, (route[-1][0], y), (-_HALF, y), _HUB),
        crowd=CrowdOptions(people=6 + wings),
        robot=_ROBOT,
    )


def _place(number: int, point: Point) -> Point:
    """A point of a wing in the building; y points down in wings south of their corridor."""
    floor, on_floor = divmod(number, _ON_FLOOR)
    column, is_south = divmod(on_floor, 2)
    y = floor * _PITCH + (-_HALF if is_south else _HALF)
    return (column * _LENGTH + point[0], y + (-point[1] if is_south else point[1]))


def _tours() -> Iterator[tuple[int, list[Point]]]:
    """Without end: the wing that the robot goes to next, and the way from the corridor and back."""
    rng = np.random.default_rng(_SEED)
    for number in itertools.count():
        floor, on_floor = divmod(number, _ON_FLOOR)
        here: Point = (-_HALF, floor * _PITCH)
        if on_floor == 0:
            yield number, [here]
        views = len(_wing(number).views)
        some = rng.choice(views, min(_ROOMS, views), replace=False)
        yield number, _tour(number, some.tolist(), rng.random() < 0.5)
        if on_floor % 2:
            earlier = floor * _ON_FLOOR + int(rng.integers(on_floor))
            yield number, _tour(earlier, [], rng.random() < 0.5)
        if on_floor == _ON_FLOOR - 1:
            yield number, [here, _HUB, here] if floor % 2 else [here]


def _tour(number: int, rooms: list[int], westward: bool) -> list[Point]:
    stops = _wing(number).tour(rooms, westward)
    corridor = _place(number, (stops[0][0], -_HALF))
    return [corridor, *(_place(number, stop) for stop in stops), corridor]


def _walls(wings: int) -> list[Segment]:
    """The wings, the corridors of their floors, and the one that joins these."""
    floors = (wings - 1) // _ON_FLOOR + 1
    walls: list[Segment] = []
    for number in range(wings):
        walls += [(*_place(number, s[:2]), *_place(number, s[2:])) for s in _wing(number).walls]
    for floor in range(floors):
        walls += _floor(floor, wings)
    north = (floors - 1) * _PITCH + _HALF
    rng = np.random.default_rng([_SEED, 1])
    doors = [Opening(y, 1.2, 0.3) for y in _space_doors(north + _HALF, rng)]
    walls += wall((-2 * _HALF, -_HALF), north + _HALF, "west", doors)
    for floor in range(floors - 1):
        between = floor * _PITCH + _HALF
        doors = [Opening(y, 0.95, 0.18) for y in _space_doors(_PITCH - 2 * _HALF, rng)]
        walls += wall((0.0, between), _PITCH - 2 * _HALF, "east", doors)
    return [*walls, (-2 * _HALF, -_HALF, 0.0, -_HALF), (-2 * _HALF, north, 0.0, north)]


def _floor(floor: int, wings: int) -> list[Segment]:
    """A floor's corridor: entrances of its wings, closed doors before, between and after them."""
    walls: list[Segment] = []
    sides: tuple[Side, Side] = ("north", "south")
    for k, side in enumerate(sides):
        rng = np.random.default_rng([_SEED, floor, k])
        openings = []
        for column in range(_COLUMNS):
            number, start = floor * _ON_FLOOR + 2 * column + k, column * _LENGTH
            is_there = number < wings
            before, after = rng.uniform((1.0, 22.5), (9.5, 31.0)).tolist()
            openings.append(Opening(start + before, 0.95, float(rng.uniform(0.1, 0.3))))
            entrance = start + _wing(number).entrance
            openings.append(Opening(entrance, _ENTRANCE, 0.0 if is_there else 0.3, is_there))
            openings.append(Opening(start + after, 0.95, float(rng.uniform(0.1, 0.3))))
        y = floor * _PITCH + (-_HALF if k else _HALF)
        walls += wall((0.0, y), _COLUMNS * _LENGTH, side, openings)
    end, y = _COLUMNS * _LENGTH, floor * _PITCH
    return [*walls, (end, y - _HALF, end, y + _HALF)]


def _space_doors(length: float, rng: np.random.Generator) -> list[float]:
    """Start positions of closed doors along a wall."""
    places, at = [], float(rng.uniform(3.0, 6.0))
    while at < length - 3.0:
        places.append(at)
        at += float(rng.uniform(4.0, 11.0))
    return places
