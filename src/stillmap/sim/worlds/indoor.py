"""An exhibition hall, a loop of corridors, and a warehouse with racks and forklifts."""

import dataclasses
import math

import numpy as np

from stillmap.sim.options import CrowdOptions, HeightOptions, RobotOptions, TrafficOptions
from stillmap.sim.scene import Lane, Point, Scene, Segment, Stay, Thing
from stillmap.sim.walls import (
    MovedObject,
    Opening,
    Side,
    add_objects,
    box,
    pillar,
    polyline,
    room,
    split_walls,
    wall,
)


def hall() -> Scene:
    """An exhibition hall of 45 x 30 m with columns, show cases and panels.

    Size and number of people are those of Haehnel, Triebel, Burgard, Thrun, Map building with
    mobile robots in dynamic environments, ICRA 2003, Sect. 4.1; what stands in it is made up.
    """
    niche = [Opening(5.0, 1.6, 0.35), Opening(13.5, 1.2, 0.25), Opening(21.0, 3.2, 0.6)]
    bay = Opening(28.0, 7.0, 0.3, is_open=True)
    walls = [
        *wall((0, 0), 45, "south", [*niche, Opening(33.5, 1.2, 0.25), Opening(40.0, 1.6, 0.35)]),
        *wall((0, 30), 45, "north", [Opening(7.0, 1.2), Opening(17.0, 2.4, 0.4), bay]),
        *room((0, 30), "north", (27.0, 36.5), 3.5, bay),
        *wall((0, 0), 30, "west", [Opening(6.0, 2.0, 0.4), Opening(19.0, 1.2, 0.3)]),
        *wall((45, 0), 13, "east", [Opening(3.0, 1.2, 0.3)]),
        *wall((45, 18), 12, "east", [Opening(6.5, 1.2, 0.3)]),
    ]
    for x in (7.5, 15.0, 22.5, 30.0, 37.5):
        walls += pillar(x, 9.5, 0.4, 12) + pillar(x, 20.5, 0.4, 12)
    for case in (
        (4.5, 14.6, 1.2, 2.4, 0.0),
        (10.9, 5.2, 2.0, 0.8, 0.1),
        (11.2, 24.8, 1.0, 1.0, 0.4),
        (19.2, 15.0, 2.4, 1.2, 0.0),
        (26.4, 5.8, 1.6, 0.8, -0.2),
        (34.2, 14.6, 1.2, 1.2, 0.6),
        (39.8, 24.2, 2.0, 1.0, 0.15),
        (40.6, 6.2, 1.0, 1.0, 0.0),
        (18.6, 2.4, 2.2, 0.7, 0.0),
    ):
        walls += box(*case)
    for panel in ((18.4, 24.8, 4.0), (27.0, 14.9, 5.0), (11.0, 15.1, 3.0)):
        walls += box(*panel, 0.15)
    walls += box(33.4, 6.6, 0.15, 4.0) + box(35.4, 4.675, 4.0, 0.15)
    west: list[Point] = [(23, 4), (14.5, 2.5), (5, 3.8), (2.4, 10), (2.4, 19), (5, 26.4)]
    north: list[Point] = [(13, 27.5), (15.3, 23.4), (22.5, 27), (31, 27.5), (31.5, 31.8), (31, 27)]
    east: list[Point] = [(38, 27), (43, 25), (42.4, 16), (43, 8), (38.5, 2.8), (30, 3.4)]
    middle: list[Point] = [(28, 9.5), (22.5, 12.4), (12, 12.2), (8, 17.6), (16, 18)]
    home: list[Point] = [(24, 18.6), (35, 18), (37, 11.5), (29.6, 11.2), (23, 4)]
    return Scene(
        name="hall",
        walls=tuple(walls),
        glass=((45.0, 13.0, 45.0, 18.0),),
        route=(*west, *north, *east, *middle, *home),
        crowd=CrowdOptions(people=15),
        heights=HeightOptions(ceiling=6.0, furniture=1.2),
    )


def corridor() -> Scene:
    """A loop of corridors 2.4 m wide around a block, with offices, closed doors and a lobby."""
    walls: list[Segment] = []
    for start, length, side, niches, rooms in _CORRIDOR_SIDES:
        doors = [Opening(x, is_open=True) for x, *_ in rooms]
        openings = [Opening(x, 0.95, 0.18) for x in niches] + doors
        if side == "north" and start == (0, 22):
            openings.append(_LOBBY)
        walls += wall(start, length, side, sorted(openings, key=lambda o: o.start))
        for door, (_, low, high, depth) in zip(doors, rooms, strict=True):
            walls += room(start, side, (low, high), depth, door)
    for furniture in _CORRIDOR_FURNITURE:
        walls += box(*furniture)
    walls += pillar(21.5, 22.9, 0.2)
    walls += polyline([(18.5, 25.0), (20.0, 25.0)]) + polyline([(23.0, 25.0), (24.5, 25.0)])
    lap_east: list[Point] = [(34.8, 1.2), (34.8, 20.8), (22.5, 21.2)]
    lap_west: list[Point] = [(1.2, 20.8), (1.2, 10.5), (1.2, 1.2)]
    first: list[Point] = [(18, 1.2), (24, 1.2), (24, -1.4), (24, 1.2), *lap_east]
    first += [(9.5, 20.8), (9.5, 23.6), (9.5, 20.8), *lap_west, (7.5, 1.2), (7.5, -1.8)]
    second: list[Point] = [(7.5, 1.2), *lap_east, *lap_west, (14.9, 1.2), (14.9, 4.0)]
    return Scene(
        name="corridor",
        walls=tuple(walls),
        glass=((20.0, 25.0, 23.0, 25.0),),
        route=(*first, *second, (14.9, 1.2), (18, 1.2)),
        crowd=CrowdOptions(people=20),
    )


_LOBBY = Opening(18.5, 6.0, 3.0, is_open=True)

# where a wall begins, its length, the side that its doors step back to, where closed doors begin,
# and open offices: where the door begins, where the office begins and ends, its depth
_CORRIDOR_SIDES: tuple[
    tuple[Point, float, Side, tuple[float, ...], tuple[tuple[float, float, float, float], ...]], ...
] = (
    ((0, 0), 36, "south", (2.8, 12, 17.2, 29.5, 33), ((7, 4, 10.5, 4.5), (23.5, 20.5, 27.5, 4))),
    ((0, 22), 36, "north", (3.6, 15, 27), ((9, 6, 13, 4), (31, 28.5, 35, 4.2))),
    ((0, 0), 22, "west", (5, 16.5), ((10, 8.5, 13.5, 4),)),
    ((36, 0), 22, "east", (4.2, 9, 18), ()),
    ((2.4, 2.4), 31.2, "north", (1.5, 6.2, 19, 24.4, 28.4), ((12, 9.5, 16, 5),)),
    ((2.4, 19.6), 31.2, "south", (3.2, 8.8, 18), ((25, 21, 28.5, 4.6),)),
    ((2.4, 2.4), 17.2, "east", (4, 10.6), ()),
    ((33.6, 2.4), 17.2, "west", (3, 14.5), ((8.5, 5, 11, 4.2),)),
)

# centre x, y, width, height, in corridors and offices
_CORRIDOR_FURNITURE = (
    (20.2, 2.2, 1.6, 0.4),
    (35.75, 13.5, 0.5, 1.8),
    (14.0, 21.8, 0.8, 0.4),
    (5.2, -3.9, 1.6, 0.8),
    (9.7, -2.6, 0.8, 1.6),
    (24.2, -2.8, 2.4, 1.0),
    (7.0, 25.5, 1.6, 0.8),
    (12.2, 24.2, 0.8, 1.6),
    (33.6, 25.4, 1.6, 0.8),
    (-3.2, 12.7, 1.6, 0.8),
    (12.9, 6.4, 0.8, 1.6),
    (17.4, 6.9, 1.6, 0.8),
    (25.0, 16.0, 2.0, 1.0),
    (29.8, 9.4, 0.8, 1.6),
)

_RACKS = (2.6, 6.0, 9.2, 12.6, 15.8)  # m, y of the middles of the rows
_BLOCKS = ((5.0, 22.6), (25.4, 43.0))  # m, x from where to where racks stand
_BAY = 2.2  # m between two posts of a rack
_DEPTH = 1.1  # m, of a rack


def warehouse() -> Scene:
    """A warehouse of 50 x 30 m; forklifts drive round in a lane along the north wall."""
    rng = np.random.default_rng(12)  # what stands where is part of the world, not of the recording
    docks = [Opening(x, 3.0, 0.6) for x in (6.0, 16.0, 26.0, 36.0)]
    walls = [
        *wall((0, 0), 50, "south", [Opening(9.0, 1.2), Opening(31.0, 4.0, 0.4)]),
        *wall((0, 30), 50, "north", docks),
        *wall((0, 0), 30, "west", [Opening(12.0, 1.2), Opening(20.0, 2.0, 0.5)]),
        *wall((50, 0), 30, "east", [Opening(5.0, 1.2), Opening(18.5, 1.2)]),
    ]
    for y in _RACKS:
        for low, high in _BLOCKS:
            walls += _rack(low, high, y, rng)
    walls += _stacks(rng)
    for x in (12.5, 24.0, 36.0):
        walls += box(x, 24.2, 0.4, 0.4)
    aisles: list[Point] = [(2.4, 4.3), (23.9, 4.3), (47, 4.3), (47, 7.6), (23.9, 7.6), (2.4, 7.6)]
    more: list[Point] = [(2.4, 10.9), (23.9, 10.9), (47, 10.9), (47, 14.2), (23.9, 14.2)]
    home: list[Point] = [(2.4, 14.2), (2.4, 22.5), (24.2, 22.8), (46.5, 23.4), (47, 17.6)]
    return Scene(
        name="warehouse",
        walls=tuple(walls),
        route=(*aisles, *more, *home, (23.9, 17.5), (23.9, 11.0)),
        kerbs=((0.0, 25.0, 50.0, 25.0),),
        lanes=(Lane(_circuit(3.0, 47.0, 26.3, 28.5), "forklift"),),
        crowd=CrowdOptions(people=12),
        heights=HeightOptions(ceiling=7.0),
        traffic=TrafficOptions(
            vehicles=2, min_speed=1.6, max_speed=2.4, stopping_share=1.0, max_stop=20.0
        ),
    )


def _rack(low: float, high: float, y: float, rng: np.random.Generator) -> list[Segment]:
    """Posts of 2 to 5 cm radius along both sides, and what the lowest shelf holds between them."""
    walls: list[Segment] = []
    bays = round((high - low) / _BAY)
    for k in range(bays + 1):
        x = low + k * _BAY
        for side in (-1, 1):
            walls += pillar(x, y + side * _DEPTH / 2, rng.uniform(0.02, 0.05), 6)
        if k == bays or rng.random() < 0.15:
            continue
        middle = x + _BAY / 2
        if rng.random() < 0.55:
            width, height = rng.uniform((1.0, 0.7), (1.8, 1.0)).tolist()
            shift, angle = rng.uniform(-0.05, 0.05, 2).tolist()
            walls += box(middle, y + shift, width, height, angle)
            continue
        for half in (-0.5, 0.5):
            width, height = rng.uniform(0.3, 0.75, 2).tolist()
            dx, dy, angle = rng.uniform((-0.12, -0.12, -0.4), (0.12, 0.12, 0.4)).tolist()
            walls += box(middle + half + dx, y + dy, width, height, angle)
    return walls


def _stacks(rng: np.random.Generator) -> list[Segment]:
    """Pallets set down anyhow between the racks and the forklifts' lane, and rolls on end."""
    walls: list[Segment] = []
    taken: list[tuple[float, float]] = []
    for _ in range(400):
        x, y = float(rng.uniform(4.0, 45.0)), float(rng.uniform(18.9, 21.4))
        if abs(x - 23.9) < 1.6 or any(math.hypot(x - u, y - v) < 2.0 for u, v in taken):
            continue
        taken.append((x, y))
        if rng.random() < 0.25:
            walls += pillar(x, y, rng.uniform(0.1, 0.45), 10)
        else:
            width, height = rng.uniform(0.4, 1.3, 2).tolist()
            walls += box(x, y, width, height, rng.uniform(-math.pi, math.pi))
    return walls


def _circuit(west: float, east: float, south: float, north: float) -> tuple[Point, ...]:
    """Round and round, with half circles at the ends."""
    radius, middle = (north - south) / 2, (north + south) / 2
    turns = [math.pi * k / 12 for k in range(13)]
    right = [(east + radius * math.sin(a), middle - radius * math.cos(a)) for a in turns]
    left = [(west - radius * math.sin(a), middle + radius * math.cos(a)) for a in turns]
    return (*right, *left, right[0])


def warehouse_moved() -> Scene:
    """The warehouse, twice round a rack, and eight hours of a night between.

    Overnight every third bay along the way that was full is emptied, every second one of these
    filled with something else; those that were empty are filled.
    """
    scene, night = warehouse(), 215.0  # s, when the robot stops for eight hours
    lifted: list[MovedObject] = []
    filled: list[Thing] = []
    bays: list[Point] = [
        (low + (k + 0.5) * _BAY, y)
        for y in _RACKS[:3]
        for low, high in _BLOCKS
        for k in range(round((high - low) / _BAY))
    ]
    for number, (x, y) in enumerate(bays):
        when = night + (1.0 + number * 5 % 7) * 3600.0
        goods = tuple(box(0, 0, 1.5 - 0.1 * (number % 5), 0.9 - 0.1 * (number % 3)))
        other = Thing(goods, (Stay(x, y, 0.03 * (number % 4 - 2), since=when + 1800.0),))
        slot = (_BAY - 0.14, 1.6)  # between the posts
        is_full = bool(split_walls(scene.walls, (x, y), slot)[0])
        if is_full and number % 3 == 0:
            lifted.append(MovedObject((x, y), slot, when))
        if not is_full or number % 6 == 0:
            filled.append(other)
    lap: list[Point] = [(2.4, 4.3), (23.9, 4.3), (47, 4.3), (47, 7.6), (23.9, 7.6), (2.4, 7.6)]
    return dataclasses.replace(
        add_objects(scene, lifted, filled),
        name="warehouse-moved",
        route=(*lap, *lap, lap[0]),
        robot=RobotOptions(pause_at=night),
    )
