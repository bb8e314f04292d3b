"""Wings of buildings that look alike, and two wings that share a door."""

import numpy as np

from stillmap.sim.options import CrowdOptions
from stillmap.sim.scene import Point, Scene, Segment
from stillmap.sim.walls import Opening, Side, box_along, leaf, polyline, room, wall

_LENGTH, _WIDTH = 40.0, 2.2  # m, of the corridor
_FIRST, _SPACING = 2.0, 4.0  # m, from the corridor's begin to the first door, and to the next
_DOORS = 9  # on each side
_DOOR = (0.95, 0.18)  # m, width and depth of a closed one
_OPEN = (1.0, 0.15)  # m, of an open one
_ROOMS = 3  # open ones on each side
_SHARED = Opening(0.6, 1.0, 0.15, is_open=True)  # along the wall between two wings


def lookalike(number: int) -> Scene:
    """A corridor with closed doors at the same places in every building, but other rooms.

    Args:
        number: of the building; it decides which rooms are open, how large they are and what
            stands in them, and how far the corridor goes on around its corner.
    """
    rng = np.random.default_rng([71, number])
    walls, route = _wing(rng)
    walls += [(0.0, 0.0, 0.0, _WIDTH)]
    return Scene(
        name=f"lookalike-{number}",
        walls=tuple(walls),
        route=tuple(route),
        crowd=CrowdOptions(people=4),
    )


def two_wings() -> Scene:
    """Two wings of a building, whose corridors meet at a door."""
    rng = np.random.default_rng(72)
    east, way_east = _wing(rng)
    other, way = _wing(rng)
    _, thick = _OPEN
    walls = [*east, *((-thick - x0, y0, -thick - x1, y1) for x0, y0, x1, y1 in other)]
    walls += wall((0.0, 0.0), _WIDTH, "west", [_SHARED])
    low, high = _SHARED.start, _SHARED.start + _SHARED.width
    walls += [(-thick, 0.0, -thick, low), (-thick, high, -thick, _WIDTH)]
    way_west = [(-thick - x, y) for x, y in way]
    return Scene(
        name="two-wings",
        walls=tuple(walls),
        route=(*way_east, (1.5, 1.1), (-1.5, 1.1), *way_west, (-1.5, 1.1), (1.5, 1.1)),
        leaves=(leaf((0.0, 0.0), "west", _SHARED, 1.6),),
        crowd=CrowdOptions(people=6),
    )


def _wing(rng: np.random.Generator) -> tuple[list[Segment], list[Point]]:
    """A corridor to the east, without a wall at its begin, and a way through it.

    It turns to the north at its end, and has closed doors and open rooms on both sides.
    """
    walls: list[Segment] = []
    way: list[Point] = [(1.5, _WIDTH / 2)]
    ahead = float(rng.uniform(8.0, 20.0))  # m, behind the corner
    looks: list[tuple[float, Point]] = []
    rows: list[tuple[float, Side, float]] = [(0.0, "south", _LENGTH + _WIDTH)]
    rows.append((_WIDTH, "north", _LENGTH))
    for y, side, length in rows:
        more, inside = _row((0.0, y), side, length, rng)
        walls += more
        looks += inside
    for along, at in sorted(looks):
        way += [(along, _WIDTH / 2), at, (along, _WIDTH / 2)]
    end = (_LENGTH + _WIDTH / 2, _WIDTH / 2)
    way += [end, (end[0], ahead - 1.0), end, way[0]]
    niche = Opening(float(rng.uniform(3.0, ahead - 2.0)), *_DOOR)
    walls += wall((_LENGTH + _WIDTH, 0.0), ahead, "east", [niche])
    walls += polyline([(_LENGTH, _WIDTH), (_LENGTH, ahead), (_LENGTH + _WIDTH, ahead)])
    return walls, way


def _row(
    start: Point, side: Side, length: float, rng: np.random.Generator
) -> tuple[list[Segment], list[tuple[float, Point]]]:
    """One side of the corridor; of each open room, where its door is and a point inside."""
    is_open = np.isin(np.arange(_DOORS), rng.choice(_DOORS, _ROOMS, replace=False))
    openings = [
        Opening(_FIRST + k * _SPACING, *(_OPEN if free else _DOOR), is_open=bool(free))
        for k, free in enumerate(is_open.tolist())
    ]
    walls, looks = wall(start, length, side, openings), []
    out = 1.0 if side == "north" else -1.0
    for door in openings:
        if not door.is_open:
            continue
        before, behind, depth = rng.uniform((0.2, 0.2, 2.6), (1.4, 1.4, 5.5)).tolist()
        ends = (door.start - before, door.start + door.width + behind)
        walls += room(start, side, ends, depth, door)
        width, deep = rng.uniform((0.6, 0.4), (1.2, 0.8)).tolist()
        far = door.depth + depth - deep / 2 - 0.05
        walls += box_along(start, side, (ends[0] + width / 2 + 0.1, far), width, deep)
        middle = door.start + door.width / 2
        looks.append((middle, (middle, start[1] + out * (door.depth + 0.9))))
    return walls, looks
