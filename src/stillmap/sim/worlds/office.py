"""An office floor: a ring of corridors, rooms on both sides, doors that open and close."""

import dataclasses
import math
from typing import NamedTuple

from stillmap.sim.options import CrowdOptions, HeightOptions
from stillmap.sim.scene import Door, Point, Scene, Segment, Stay, Thing
from stillmap.sim.walls import (
    MovedObject,
    Opening,
    Side,
    add_objects,
    box,
    leaf,
    pillar,
    room,
    wall,
)

_THICK = 0.15  # m, of the walls between corridor and rooms
_DOOR = 1.0  # m, width of a doorway


class _Room(NamedTuple):
    """A room along a wall: where it begins, ends, and where its doorway begins, in metres.

    `desks` as centre x, y, width, height, angle from the room's corner near the wall's start, y
    into the room; a chair stands before each.
    """

    low: float
    high: float
    door: float
    swing: float
    hinged_at_end: bool
    desks: tuple[tuple[float, float, float, float, float], ...]


_SOUTH = (
    _Room(0.3, 5.3, 3.9, 1.75, True, ((1.2, 5.2, 1.6, 0.8, 0.0), (4.2, 4.0, 0.8, 1.6, 0))),
    _Room(5.5, 10.4, 6.1, 1.65, False, ((3.9, 2.0, 0.8, 1.6, 0), (2.0, 5.3, 1.8, 0.8, 0))),
    _Room(10.6, 18.2, 13.4, 1.9, False, ((3.8, 3.4, 3.6, 1.4, 0.05),)),
    _Room(18.4, 23.0, 21.6, 1.6, True, ((1.0, 2.4, 0.8, 1.6, 0), (3.6, 5.0, 1.6, 0.8, 0))),
    _Room(23.2, 28.0, 23.8, 1.75, False, ((2.6, 5.3, 2.4, 0.8, 0), (4.2, 2.6, 0.6, 1.8, 0))),
    _Room(
        28.2,
        34.6,
        32.0,
        1.7,
        True,
        ((1.2, 2.2, 0.8, 1.6, 0), (1.2, 4.6, 0.8, 1.6, 0), (5.4, 4.4, 0.8, 1.6, 0.1)),
    ),
    _Room(34.8, 39.7, 35.4, 1.6, False, ((3.6, 5.2, 1.6, 0.8, 0), (4.3, 2.4, 0.7, 1.6, 0))),
)
_NORTH = (
    _Room(0.3, 6.8, 4.9, 1.7, True, ((1.2, 3.0, 0.8, 1.6, 0), (4.6, 5.2, 1.8, 0.8, 0))),
    _Room(7.0, 11.8, 7.6, 1.6, False, ((3.9, 2.2, 0.8, 1.6, 0), (1.6, 5.3, 1.6, 0.8, 0))),
    _Room(12.0, 16.6, 15.2, 1.8, True, ((1.0, 3.6, 0.8, 1.8, 0.1),)),
    _Room(16.8, 25.0, 20.0, 1.75, False, ((2.4, 3.2, 1.2, 2.6, 0), (6.2, 4.0, 1.6, 1.6, 0.4))),
    _Room(25.2, 29.8, 28.4, 1.6, True, ((1.0, 2.2, 0.8, 1.6, 0), (3.4, 5.2, 1.6, 0.8, 0))),
    _Room(30.0, 34.8, 30.6, 1.7, False, ((3.9, 3.0, 0.8, 1.6, 0), (1.4, 5.3, 1.6, 0.8, 0))),
    _Room(35.0, 39.7, 38.2, 1.65, True, ((1.0, 3.4, 0.8, 1.8, 0), (3.4, 5.4, 1.4, 0.6, 0))),
)
_COURT_SOUTH = (
    _Room(0.6, 6.6, 1.4, 1.7, False, ((4.8, 2.2, 1.6, 0.8, 0),)),
    _Room(6.8, 11.6, 10.2, 1.6, True, ((1.2, 2.4, 0.8, 1.6, 0),)),
    _Room(17.2, 22.4, 18.0, 1.75, False, ((4.0, 2.4, 1.6, 0.8, 0),)),
    _Room(26.0, 34.8, 31.0, 1.8, False, ((1.8, 1.8, 0.8, 2.0, 0), (7.2, 2.2, 1.6, 0.8, 0.2))),
)
_COURT_NORTH = (
    _Room(0.6, 5.0, 3.6, 1.65, True, ((1.2, 2.3, 1.6, 0.8, 0),)),
    _Room(9.4, 15.2, 10.0, 1.7, False, ((4.4, 2.3, 1.6, 0.8, 0),)),
    _Room(15.4, 20.4, 18.8, 1.6, True, ((1.4, 2.2, 1.6, 0.8, 0),)),
    _Room(23.0, 28.2, 23.6, 1.75, False, ((4.0, 2.2, 0.8, 1.6, 0),)),
)

# where a wall begins, its length, the side of its rooms, their depth, the rooms, and where doors
# begin that are never opened
_WINGS: tuple[tuple[Point, float, Side, float, tuple[_Room, ...], tuple[float, ...]], ...] = (
    ((0.0, 6.6), 40.0, "south", 6.2, _SOUTH, ()),
    ((0.0, 18.4), 40.0, "north", 6.2, _NORTH, ()),
    ((2.2, 8.8), 35.6, "north", 3.4, _COURT_SOUTH, (12.8, 23.6)),
    ((2.2, 16.2), 35.6, "south", 3.4, _COURT_NORTH, (6.4, 21.2, 31.4)),
)

# centre x, y, width, height: copiers, cupboards and benches in the corridors
_FURNITURE = (
    (12.0, 8.5, 1.2, 0.5),
    (26.2, 6.85, 0.8, 0.4),
    (22.9, 16.5, 1.4, 0.5),
    (9.3, 18.15, 1.0, 0.4),
    (39.7, 12.5, 0.5, 1.6),
)


def office() -> Scene:
    """An office floor of 40 x 25 m, with 22 rooms whose doors swing, desks, and legs of chairs."""
    walls: list[Segment] = []
    leaves: list[Door] = []
    for start, length, side, depth, rooms, locked in _WINGS:
        doors = [Opening(r.door, _DOOR, _THICK, is_open=True) for r in rooms]
        openings = doors + [Opening(x, 0.95, _THICK) for x in locked]
        walls += wall(start, length, side, sorted(openings, key=lambda o: o.start))
        for r, door in zip(rooms, doors, strict=True):
            walls += room(start, side, (r.low, r.high), depth, door)
            leaves.append(leaf(start, side, door, r.swing, r.hinged_at_end))
            walls += _place_furniture(start, side, r)
    walls += wall((0, 6.6), 11.8, "west", [Opening(5.0, 1.6, 0.3)])
    walls += wall((40, 6.6), 2.8, "east") + wall((40, 15.6), 2.8, "east")
    walls += wall((2.2, 8.8), 7.4, "east", [Opening(3.2, 1.0, _THICK)])
    walls += wall((37.8, 8.8), 7.4, "west", [Opening(2.0, 1.0, _THICK)])
    for furniture in _FURNITURE:
        walls += box(*furniture)
    walls += pillar(0.45, 17.9, 0.25) + pillar(39.6, 7.0, 0.2)
    south: list[Point] = [(1.1, 7.7), (14.5, 7.7), (14.5, 4.6), (14.5, 7.7), (32.5, 7.7)]
    south += [(32.5, 4.2), (32.5, 7.7), (33.7, 7.7), (33.7, 11.2), (33.7, 7.7), (38.9, 7.7)]
    north: list[Point] = [(38.9, 17.3), (20.5, 17.3), (20.5, 20.6), (21.2, 22.8), (20.5, 20.6)]
    north += [(20.5, 17.3), (6.3, 17.3), (6.3, 14.4), (6.3, 17.3), (1.1, 17.3), (1.1, 7.7)]
    return Scene(
        name="office",
        walls=tuple(walls),
        glass=((40.0, 9.4, 40.0, 15.6),),
        route=(*south, *north, (12.0, 7.7)),
        leaves=tuple(leaves),
        crowd=CrowdOptions(people=10),
        heights=HeightOptions(furniture=0.75),
    )


def _place_furniture(start: Point, side: Side, r: _Room) -> list[Segment]:
    """Desks as boxes, and the four thin legs of a chair on the side of each that has room."""
    into = 1.0 if side == "north" else -1.0
    walls: list[Segment] = []
    for x, y, width, height, angle in r.desks:
        centre = (start[0] + r.low + x, start[1] + into * (_THICK + y))
        walls += box(*centre, width, height, angle)
        ahead = math.copysign(width / 2 + 0.45, (r.high - r.low) / 2 - x) if height > width else 0.0
        aside = 0.0 if height > width else -into * (height / 2 + 0.45)
        for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            walls += pillar(centre[0] + ahead + 0.2 * i, centre[1] + aside + 0.2 * j, 0.02, 4)
    return walls


_CHAIR = tuple(
    leg for i in (-0.2, 0.2) for j in (-0.2, 0.2) for leg in pillar(i, j, 0.02, 4)
)  # four thin legs, as the office has them

# the robot comes by twice, the second time some 230 s after the first
_MOVED = (
    MovedObject((14.4, 4.2), (0.6, 0.6), 120.0, (Stay(16.7, 4.9, 0.4, since=120.0),)),  # a chair
    MovedObject((20.25, 21.75), (0.6, 0.6), 250.0, (Stay(22.3, 19.7, 1.0, since=250.0),)),
    MovedObject((12.0, 8.5), (1.4, 0.55), 150.0, (Stay(17.5, 8.5, since=150.0),)),  # a copier
    MovedObject((26.2, 6.85), (1.0, 0.45), 100.0),  # a cupboard
    MovedObject((39.7, 12.5), (0.55, 1.7), 200.0),  # a bench
)
_THINGS = (
    Thing(tuple(box(0, 0, 1.0, 0.4)), (Stay(26.0, 18.15, since=240.0),)),  # a cupboard
    Thing(tuple(box(0, 0, 1.2, 0.7)), (Stay(11.7, 5.3, 0.1, since=200.0),)),  # a table
    Thing(
        tuple(box(0, 0, 0.9, 0.5)),  # a trolley
        (Stay(29.0, 16.5, until=225.0), Stay(15.3, 16.5, 0.05, since=225.0)),
    ),
    Thing(tuple(box(0, 0, 0.7, 0.5)), (Stay(36.0, 8.45, 0.1, since=45.0, until=160.0),)),  # boxes
    Thing(_CHAIR, (Stay(6.0, 8.45, 0.3, since=190.0),)),
)


def office_moved() -> Scene:
    """The office, in which the robot goes round the corridors twice.

    A copier, a trolley and chairs are moved meanwhile, a cupboard and a bench taken away, and
    another cupboard, a table and a chair brought; boxes stand about for a while.
    """
    lap: list[Point] = [(1.1, 7.7), (14.5, 7.7), (14.5, 4.6), (14.5, 7.7), (38.9, 7.7)]
    lap += [(38.9, 17.3), (20.5, 17.3), (20.5, 20.6), (20.5, 17.3), (1.1, 17.3)]
    scene = add_objects(office(), _MOVED, _THINGS)
    return dataclasses.replace(scene, name="office-moved", route=(*lap, *lap, lap[0]))
