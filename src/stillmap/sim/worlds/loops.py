"""Joined loops of corridors around courtyards, and ten identical corridors."""

import dataclasses
import itertools
from collections.abc import Iterable

import numpy as np

from stillmap.sim.options import CrowdOptions, RobotOptions
from stillmap.sim.scene import Point, Scene, Segment
from stillmap.sim.walls import Opening, Side, box, box_along, locate, pillar, room, wall

_WIDTH = 2.8  # m, of the corridors

_COLUMNS, _ROWS = (44.0, 62.0, 80.0), (30.0, 44.0)  # m, of the courtyards

_OFFICE = 4.2  # m, depth of the rooms along the outer walls

# column and row of the crossings that the robot comes to, one after the other
_WAY = (
    *((0, 0), (1, 0), (1, 1), (0, 1), (0, 0), (1, 0), (2, 0), (2, 1), (1, 1)),
    *((1, 2), (0, 2), (0, 1), (1, 1), (1, 2), (2, 2), (2, 1), (3, 1), (3, 2), (2, 2)),
    *((2, 1), (2, 0), (3, 0), (3, 1), (2, 1), (1, 1), (1, 0), (0, 0)),
)


def rounds() -> Scene:
    """Six courtyards with corridors around each: every corridor is part of one loop or two.

    The outer walls have offices and closed doors, those of the courtyards windows. The robot goes
    round the first loop, then from loop to loop through every corridor, and ends where it began.
    """
    rng = np.random.default_rng(43)
    x, y = _starts(_COLUMNS), _starts(_ROWS)
    walls, glass = _outside(x[-1] + _WIDTH, y[-1] + _WIDTH, rng), []
    for west, width in zip(x, _COLUMNS, strict=False):
        for south, depth in zip(y, _ROWS, strict=False):
            start = (west + _WIDTH, south + _WIDTH)
            more, windows = _courtyard(start, width, depth, rng)
            walls += more
            glass += windows
    route: list[Point] = [(x[i] + _WIDTH / 2, y[j] + _WIDTH / 2) for i, j in _WAY]
    return Scene(
        name="rounds",
        walls=tuple(walls),
        glass=tuple(glass),
        route=tuple(route),
        crowd=CrowdOptions(people=40),
        robot=RobotOptions(speed=0.8),
    )


def _starts(sizes: tuple[float, ...]) -> list[float]:
    """Start positions of corridors, with courtyards of these sizes between them."""
    starts = [0.0]
    for size in sizes:
        starts.append(starts[-1] + _WIDTH + size)
    return starts


def _sides(
    corner: Point, width: float, depth: float, sides: tuple[Side, ...]
) -> Iterable[tuple[Point, float, Side]]:
    """Start and length of the walls in the south, north, west and east, which step to `sides`."""
    x, y = corner
    starts = (corner, (x, y + depth), corner, (x + width, y))
    return zip(starts, (width, width, depth, depth), sides, strict=True)


def _outside(width: float, depth: float, rng: np.random.Generator) -> list[Segment]:
    walls: list[Segment] = []
    outwards: tuple[Side, ...] = ("south", "north", "west", "east")
    for start, length, side in _sides((0.0, 0.0), width, depth, outwards):
        openings = _openings(length, rng, rooms=True)
        walls += wall(start, length, side, openings)
        for door in openings:
            if door.is_open:
                low, high = rng.uniform((0.3, 1.4), (2.0, 2.6)).tolist()
                ends = (door.start - low, door.start + door.width + high)
                walls += room(start, side, ends, _OFFICE, door)
        walls += _cupboards(start, side, openings, rng)
    return walls


def _courtyard(
    start: Point, width: float, depth: float, rng: np.random.Generator
) -> tuple[list[Segment], list[Segment]]:
    """The walls around a courtyard, and the windows in them."""
    (x, y), walls = start, []
    glass: list[Segment] = []
    inwards: tuple[Side, ...] = ("north", "south", "east", "west")
    for begin, length, side in _sides(start, width, depth, inwards):
        openings = _openings(length, rng, rooms=False)
        walls += wall(begin, length, side, openings)
        for window in openings:
            if window.is_open:
                ends = (window.start, window.start + window.width)
                glass.append((*locate(begin, side, ends[0]), *locate(begin, side, ends[1])))
    corner = rng.integers(4)
    x = x - 0.3 if corner % 2 else x + width + 0.3
    return walls + pillar(x, y - 0.3 if corner // 2 else y + depth + 0.3, 0.2), glass


def _openings(length: float, rng: np.random.Generator, rooms: bool) -> list[Opening]:
    """Doors and niches all along a wall, and open offices, or gaps that windows close."""
    openings: list[Opening] = []
    at = float(rng.uniform(2.5, 5.0))
    while at < length - 6.0:
        kind = rng.random()
        if kind < 0.2 and rooms:
            openings.append(Opening(at, 1.0, 0.15, is_open=True))
        elif kind < 0.3 and not rooms:
            openings.append(Opening(at, float(rng.uniform(1.5, 4.5)), 0.0, is_open=True))
        elif kind < 0.75:
            openings.append(Opening(at, 0.95, float(rng.uniform(0.1, 0.25))))
        else:
            niche = rng.uniform((1.2, 0.25), (3.0, 0.7)).tolist()
            openings.append(Opening(at, *niche))
        at += openings[-1].width + float(rng.uniform(3.5, 11.0))
    return openings


def _cupboards(
    start: Point, side: Side, openings: list[Opening], rng: np.random.Generator
) -> list[Segment]:
    """Cupboards and benches along a wall, where it has no door."""
    walls: list[Segment] = []
    for before, after in itertools.pairwise(openings):
        low, high = before.start + before.width + 0.4, after.start - 0.4
        if rng.random() < 0.7 or high - low < 2.0:
            continue
        width, deep = rng.uniform((0.6, 0.3), (min(2.0, high - low), 0.5)).tolist()
        along = float(rng.uniform(low, high - width)) + width / 2
        walls += box_along(start, side, (along, -deep / 2), width, deep)
    return walls


_COUNT = 10
_APART = 6.0  # m from one corridor to the next
_CORRIDOR_WIDTH, _LENGTH = 2.2, 32.0  # m, of a corridor
_SPINE = 2.4  # m, width of the two corridors across their ends
# along each corridor, the same in all: closed doors, niches, and one open room with a desk
_WEST = (Opening(3.0, 0.95, 0.18), Opening(9.5, 0.95, 0.18), Opening(23.0, 1.6, 0.4))
_EAST = (Opening(6.0, 0.95, 0.18), Opening(27.5, 0.95, 0.18))
_DOOR, _ROOM, _DEPTH = Opening(15.0, 1.0, 0.15, is_open=True), (14.0, 19.5), 3.3
# along the spines, before each corridor and between two
_OPPOSITE, _BETWEEN = Opening(0.6, 1.0, 0.3), Opening(1.4, 0.95, 0.18)


def ten_corridors() -> Scene:
    """Ten parallel corridors of 32 m, alike to the millimetre, between two corridors across.

    The same doors and niches at the same places, and across their ends too; only the two outer
    walls tell where one is. The robot goes up one corridor and down the next, then once more up
    the seventh and down the fourth, and back to where it began.
    """
    walls: list[Segment] = []
    for k in range(_COUNT):
        walls += _corridor(k * _APART)
    east, north = (_COUNT - 1) * _APART + _CORRIDOR_WIDTH, _LENGTH + _SPINE
    first = _OPPOSITE.start
    opposite = [dataclasses.replace(_OPPOSITE, start=first + k * _APART) for k in range(_COUNT)]
    walls += wall((0.0, -_SPINE), east, "south", opposite)
    walls += wall((0.0, north), east, "north", opposite)
    for x in (0.0, east):
        walls += [(x, -_SPINE, x, 0.0), (x, _LENGTH, x, north)]
    return Scene(
        name="ten-corridors",
        walls=tuple(walls),
        route=tuple(_route()),
        crowd=CrowdOptions(people=4),
    )


def _corridor(x: float) -> list[Segment]:
    """A corridor with what lies between it and the next one, if there is one."""
    east = (x + _CORRIDOR_WIDTH, 0.0)
    walls = wall((x, 0.0), _LENGTH, "west", _WEST)
    walls += wall(east, _LENGTH, "east", [_EAST[0], _DOOR, _EAST[1]])
    walls += room(east, "east", _ROOM, _DEPTH, _DOOR)
    walls += box(x + _CORRIDOR_WIDTH + 2.9, 18.4, 0.8, 1.6)
    if x < (_COUNT - 1) * _APART:
        walls += wall(east, _APART - _CORRIDOR_WIDTH, "north", [_BETWEEN])
        walls += wall((x + _CORRIDOR_WIDTH, _LENGTH), _APART - _CORRIDOR_WIDTH, "south", [_BETWEEN])
    return walls


def _route() -> list[Point]:
    """There and back through one corridor after the other, and two of them again."""
    south, north = -_SPINE / 2, _LENGTH + _SPINE / 2
    route: list[Point] = []
    for k in [*range(_COUNT), 6, 3]:
        x = k * _APART + _CORRIDOR_WIDTH / 2
        up = len(route) % 4 == 0
        route += [(x, south), (x, north)] if up else [(x, north), (x, south)]
    return [*route, route[0]]
