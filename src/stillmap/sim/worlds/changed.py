"""Worlds with objects that are moved, brought or taken away between two visits of the robot."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from stillmap.sim.options import RobotOptions
from stillmap.sim.scene import Point, Scene, Segment, Stay, Thing
from stillmap.sim.walls import box, pillar
from stillmap.sim.worlds.indoor import BAY, BLOCKS, RACKS, warehouse
from stillmap.sim.worlds.office import office
from stillmap.sim.worlds.street import OUTER, PARKED, street

_HOUR = 3600.0  # s
_SLOT = (6.1, 2.4)  # m, of a parked car and the room around it
_NIGHT = 215.0  # s, when the robot of the warehouse stops for eight hours


@dataclass(frozen=True)
class _MovedObject:
    """An object that stands in another world for good, and here until `until`.

    Attributes:
        at: metres, center of a rectangle that contains it and nothing else.
        size: metres, of the rectangle.
        until: seconds since the beginning of the recording.
        then: stays afterwards; none: it is taken away.
    """

    at: Point
    size: Point
    until: float
    then: tuple[Stay, ...] = ()


_CHAIR = tuple(
    leg for i in (-0.2, 0.2) for j in (-0.2, 0.2) for leg in pillar(i, j, 0.02, 4)
)  # four thin legs, as the office has them
_CAR = tuple(box(0, 0, 4.4, 1.8))

# the robot comes by twice, the second time some 230 s after the first
_OFFICE_MOVED = (
    _MovedObject((14.4, 4.2), (0.6, 0.6), 120.0, (Stay(16.7, 4.9, 0.4, since=120.0),)),  # a chair
    _MovedObject((20.25, 21.75), (0.6, 0.6), 250.0, (Stay(22.3, 19.7, 1.0, since=250.0),)),
    _MovedObject((12.0, 8.5), (1.4, 0.55), 150.0, (Stay(17.5, 8.5, since=150.0),)),  # a copier
    _MovedObject((26.2, 6.85), (1.0, 0.45), 100.0),  # a cupboard
    _MovedObject((39.7, 12.5), (0.55, 1.7), 200.0),  # a bench
)
_OFFICE_THINGS = (
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
    scene = _add_objects(office(), _OFFICE_MOVED, _OFFICE_THINGS)
    return dataclasses.replace(scene, name="office-moved", route=(*lap, *lap, lap[0]))


def street_moved() -> Scene:
    """The street, down and up twice: parked cars drive off, others come, one parks elsewhere."""
    elsewhere = (Stay(144.8, PARKED, 0.02, since=75.0),)
    leaving = ((28.9, -1, 45.0), (96.0, -1, 55.0), (59.4, 1, 85.0), (108.2, 1, 90.0))
    lifted = [_MovedObject((x, side * PARKED), _SLOT, until) for x, side, until in leaving]
    lifted.append(_MovedObject((41.1, -PARKED), _SLOT, 50.0, elsewhere))
    coming = (Stay(114.3, -PARKED, since=60.0), Stay(41.1, PARKED, 0.03, since=80.0))
    east: list[Point] = [(6.0, -OUTER), (166.0, -OUTER), (170.5, -4.2), (173.4, 0.0)]
    west: list[Point] = [(170.5, 4.2), (166.0, OUTER), (8.0, OUTER)]
    turn: list[Point] = [(3.5, 4.2), (0.6, 0.0), (3.5, -4.2)]
    scene = _add_objects(street(), lifted, [Thing(_CAR, (stay,)) for stay in coming])
    # people hold it up: the number of scans is fixed, however far it comes
    robot = dataclasses.replace(scene.robot, scans=1500)
    lap = (*east, *west, *turn)
    return dataclasses.replace(scene, name="street-moved", route=(*lap, *lap), robot=robot)


def warehouse_moved() -> Scene:
    """The warehouse, twice round a rack, and eight hours of a night between.

    Overnight every third bay along the way that was full is emptied, every second one of these
    filled with something else; those that were empty are filled.
    """
    scene = warehouse()
    robot = RobotOptions(pause_at=_NIGHT)
    lifted: list[_MovedObject] = []
    filled: list[Thing] = []
    for number, (x, y) in enumerate(_bays(RACKS[:3])):
        when = _NIGHT + (1.0 + number * 5 % 7) * _HOUR
        goods = tuple(box(0, 0, 1.5 - 0.1 * (number % 5), 0.9 - 0.1 * (number % 3)))
        other = Thing(goods, (Stay(x, y, 0.03 * (number % 4 - 2), since=when + 0.5 * _HOUR),))
        slot = (BAY - 0.14, 1.6)  # between the posts
        is_full = bool(_walls_within(scene.walls, (x, y), slot)[0])
        if is_full and number % 3 == 0:
            lifted.append(_MovedObject((x, y), slot, when))
        if not is_full or number % 6 == 0:
            filled.append(other)
    lap: list[Point] = [(2.4, 4.3), (23.9, 4.3), (47, 4.3), (47, 7.6), (23.9, 7.6), (2.4, 7.6)]
    scene = _add_objects(scene, lifted, filled)
    return dataclasses.replace(
        scene, name="warehouse-moved", route=(*lap, *lap, lap[0]), robot=robot
    )


def _bays(rows: Sequence[float]) -> list[Point]:
    """Centers of the bays of these rows of racks."""
    return [
        (low + (k + 0.5) * BAY, y)
        for y in rows
        for low, high in BLOCKS
        for k in range(round((high - low) / BAY))
    ]


def _add_objects(scene: Scene, lifted: Iterable[_MovedObject], others: Iterable[Thing]) -> Scene:
    """The scene with movable objects, some of them made of its walls."""
    walls, things = scene.walls, []
    for one in lifted:
        faces, walls = _walls_within(walls, one.at, one.size)
        x, y = one.at
        about = tuple((a - x, b - y, c - x, d - y) for a, b, c, d in faces)
        things.append(Thing(about, (Stay(x, y, until=one.until), *one.then)))
    return dataclasses.replace(scene, walls=walls, things=(*things, *others))


def _walls_within(
    walls: Sequence[Segment], at: Point, size: Point
) -> tuple[tuple[Segment, ...], tuple[Segment, ...]]:
    """The walls within a rectangle, and all others."""
    held: list[Segment] = []
    others: list[Segment] = []
    for wall in walls:
        ends = (wall[:2], wall[2:])
        inside = all(abs(x - at[0]) < size[0] / 2 and abs(y - at[1]) < size[1] / 2 for x, y in ends)
        (held if inside else others).append(wall)
    return tuple(held), tuple(others)
