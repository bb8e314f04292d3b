"""A building that grows with the recording: wing after wing, floor after floor."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from stillmap.simulation.options import CrowdOptions, RobotOptions
from stillmap.simulation.scene import Point, Scene, Segment
from stillmap.simulation.walls import Opening, Side, wall
from stillmap.simulation.worlds.wing import DEPTH, ENTRANCE, LENGTH, Wing, wing

_LAYOUT_SEED = 41
_COLUMNS = 4  # wings beside one another on each side of a floor's corridor
_ON_FLOOR = 2 * _COLUMNS  # wings
_HALF = 1.3  # m, half the width of the floors' corridors and of the one that joins them
_PITCH = 2 * (_HALF + DEPTH) + 1.0  # m from floor to floor, which lie side by side
_ROOMS = 4  # that the robot looks into when it is in a wing for the first time
_ROBOT = RobotOptions(speed=0.8)
_SHARE = 0.8  # of the way at full speed: it turns, and people are in its way


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
    floor = (wings - 1) // _ON_FLOOR
    home = [(-_HALF, floor * _PITCH), _HUB]
    return Scene(
        name="building",
        walls=tuple(_walls(wings)),
        route=(*route, (route[-1][0], floor * _PITCH), *home),
        crowd=CrowdOptions(people=6 + wings),
        robot=_ROBOT,
    )


_HUB: Point = (-_HALF, 0.0)


@dataclass(frozen=True)
class _Place:
    """Where a wing stands: its own origin in metres, and whether y goes down."""

    x: float
    y: float
    south: bool

    @classmethod
    def of(cls, number: int) -> "_Place":
        floor, on_floor = divmod(number, _ON_FLOOR)
        column, side = divmod(on_floor, 2)
        return cls(column * LENGTH, floor * _PITCH + (-_HALF if side else _HALF), bool(side))

    def point(self, point: Point) -> Point:
        return (self.x + point[0], self.y + (-point[1] if self.south else point[1]))

    def segment(self, s: Segment) -> Segment:
        return (*self.point(s[:2]), *self.point(s[2:]))


@cache
def _wing(number: int) -> Wing:
    return wing(np.random.default_rng([_LAYOUT_SEED, number]))


def _tours() -> Iterator[tuple[int, list[Point]]]:
    """Without end: the wing that the robot goes to next, and the way from the corridor and back."""
    rng = np.random.default_rng(_LAYOUT_SEED)
    for number in itertools.count():
        floor, on_floor = divmod(number, _ON_FLOOR)
        if on_floor == 0:
            yield number, [(-_HALF, floor * _PITCH)]
        looks = len(_wing(number).looks)
        some = rng.choice(looks, min(_ROOMS, looks), replace=False)
        yield number, _tour(number, some.tolist(), rng.random() < 0.5)
        if on_floor % 2:
            earlier = floor * _ON_FLOOR + int(rng.integers(on_floor))
            yield number, _tour(earlier, [], rng.random() < 0.5)
        if on_floor == _ON_FLOOR - 1:
            there: list[Point] = [(-_HALF, floor * _PITCH)]
            yield number, [*there, _HUB, *there] if floor % 2 else there


def _tour(number: int, rooms: list[int], westward: bool) -> list[Point]:
    place = _Place.of(number)
    stops = [place.point(p) for p in _wing(number).tour(rooms, westward)]
    corridor: Point = (stops[0][0], place.y + (_HALF if place.south else -_HALF))
    return [corridor, *stops[1:-1], corridor]


def _walls(wings: int) -> list[Segment]:
    """The wings, the corridors of their floors, and the one that joins these."""
    floors = (wings - 1) // _ON_FLOOR + 1
    walls: list[Segment] = []
    for number in range(wings):
        place = _Place.of(number)
        walls += [place.segment(s) for s in _wing(number).walls]
    for floor in range(floors):
        walls += _floor(floor, wings)
    north = (floors - 1) * _PITCH + _HALF
    rng = np.random.default_rng([_LAYOUT_SEED, 1])
    doors = [Opening(y, 1.2, 0.3) for y in _spaced(north + _HALF, rng)]
    walls += wall((-2 * _HALF, -_HALF), north + _HALF, "west", doors)
    for floor in range(floors - 1):
        between = floor * _PITCH + _HALF
        doors = [Opening(y, 0.95, 0.18) for y in _spaced(_PITCH - 2 * _HALF, rng)]
        walls += wall((0.0, between), _PITCH - 2 * _HALF, "east", doors)
    return [*walls, (-2 * _HALF, -_HALF, 0.0, -_HALF), (-2 * _HALF, north, 0.0, north)]


def _floor(floor: int, wings: int) -> list[Segment]:
    """A floor's corridor: entrances of its wings, closed doors before, between and after them."""
    walls: list[Segment] = []
    sides: tuple[Side, Side] = ("north", "south")
    for k, side in enumerate(sides):
        rng = np.random.default_rng([_LAYOUT_SEED, floor, k])
        openings = []
        for column in range(_COLUMNS):
            number = floor * _ON_FLOOR + 2 * column + k
            start = column * LENGTH
            gate = start + _wing(number).entrance
            before, after = rng.uniform((1.0, 22.5), (9.5, 31.0)).tolist()
            openings.append(Opening(start + before, 0.95, float(rng.uniform(0.1, 0.3))))
            openings.append(Opening(gate, ENTRANCE, 0.0 if number < wings else 0.3, number < wings))
            openings.append(Opening(start + after, 0.95, float(rng.uniform(0.1, 0.3))))
        y = floor * _PITCH + (-_HALF if k else _HALF)
        walls += wall((0.0, y), _COLUMNS * LENGTH, side, openings)
    end, y = _COLUMNS * LENGTH, floor * _PITCH
    return [*walls, (end, y - _HALF, end, y + _HALF)]


def _spaced(length: float, rng: np.random.Generator) -> list[float]:
    """Where closed doors begin along a wall."""
    places, at = [], float(rng.uniform(3.0, 6.0))
    while at < length - 3.0:
        places.append(at)
        at += float(rng.uniform(4.0, 11.0))
    return places
