"""A street with parked cars and traffic, and its version with lights and a queue."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from stillmap.sim.options import (
    CrowdOptions,
    HeightOptions,
    LaserOptions,
    OdometryOptions,
    RobotOptions,
    TrafficOptions,
)
from stillmap.sim.scene import Lane, Light, Point, Scene, Segment
from stillmap.sim.walls import Opening, Side, box, pillar, wall

INNER, OUTER = 1.75, 5.25  # m from the middle of the road to the middles of the lanes

PARKED = 8.2  # m from there to the middles of parked cars

KERB = 9.4  # m, beyond it are the pavements

FRONT = 13.5  # m, where the houses stand

YARD = FRONT + 10.0  # m, where their yards end

LASER = LaserOptions(beams=181, max_range=80.0, range_noise=0.03, x=0.85)

ROBOT = RobotOptions(speed=5.0, turn_rate=0.9, radius=0.9, scan_rate=10.0)

ODOMETRY = OdometryOptions(wheel_base=1.5)

OPEN_AIR = HeightOptions(ceiling=None)

_LAYOUT_SEED = 35


def street(people: int = 16) -> Scene:
    """A street of 180 m with two lanes each way: the robot drives down one side and up the other.

    The lanes next to it are full of cars that overtake or come towards it, and go on for a
    hundred metres beyond both ends.
    """
    rng = np.random.default_rng(_LAYOUT_SEED)
    west, east = -30.0, 210.0
    walls = make_house_front((west, -FRONT), east - west, "south", rng)
    walls += make_house_front((west, FRONT), east - west, "north", rng)
    for y in (-1.0, 1.0):
        xs = np.arange(west + 4, east - 4, 0.1)
        walls += make_trees_and_lamps(((float(x), y * (KERB + 0.7)) for x in xs[::125]), rng)
        walls += make_parked_cars(
            [(float(x), y * PARKED, 0.0) for x in np.arange(-26, 200, 6.1)], rng
        )
    there = [(6.0, -OUTER), (166.0, -OUTER), (170.5, -4.2), (173.4, 0.0), (170.5, 4.2)]
    caps = ((west, -FRONT, west, FRONT), (east, -FRONT, east, FRONT))
    return Scene(
        name="street",
        walls=tuple(walls),
        route=(*there, (166.0, OUTER), (8.0, OUTER)),
        kerbs=((west, -KERB, east, -KERB), (west, KERB, east, KERB), *caps),
        people_at=((20.0, -11.9), (20.0, 11.9)),
        lanes=(Lane(((-110, -INNER), (290, -INNER))), Lane(((290, INNER), (-110, INNER)))),
        crowd=CrowdOptions(people=people),
        traffic=TrafficOptions(vehicles=14),
        laser=LASER,
        robot=ROBOT,
        odometry=ODOMETRY,
        heights=OPEN_AIR,
        pavements=((west, -YARD, east, -KERB), (west, KERB, east, YARD)),
    )


def make_house_front(
    start: Point, length: float, side: Side, rng: np.random.Generator
) -> list[Segment]:
    """Houses in a row: doorways and shop windows step back, now and then there is a yard."""
    openings, at = [], float(rng.uniform(1.0, 4.0))
    while at < length - 8.0:
        kind = rng.random()
        if kind < 0.15:
            opening = Opening(at, float(rng.uniform(2.5, 4.0)), float(rng.uniform(4.0, 9.0)))
        elif kind < 0.5:
            opening = Opening(at, float(rng.uniform(2.5, 5.5)), float(rng.uniform(0.2, 0.6)))
        else:
            opening = Opening(at, float(rng.uniform(1.0, 1.5)), float(rng.uniform(0.3, 1.2)))
        openings.append(opening)
        at += opening.width + float(rng.uniform(2.0, 7.0))
    return wall(start, length, side, openings)


def make_trees_and_lamps(points: Iterable[Point], rng: np.random.Generator) -> list[Segment]:
    """By turns two trees and a lamp post, each a little off its point."""
    walls: list[Segment] = []
    for k, (x, y) in enumerate(points):
        radius = 0.08 if k % 3 == 2 else float(rng.uniform(0.12, 0.3))
        off = rng.uniform(-0.4, 0.4)
        walls += pillar(x + off, y, radius, 8)
    return walls


def make_parked_cars(
    places: Sequence[tuple[float, float, float]], rng: np.random.Generator
) -> list[Segment]:
    """Cars in two of three places x, y, heading."""
    walls: list[Segment] = []
    for x, y, heading in places:
        if rng.random() < 0.65:
            length, width = rng.uniform((4.0, 1.7), (4.9, 1.9)).tolist()
            dx, dy = rng.uniform(-0.15, 0.15, 2).tolist()
            walls += box(x + dx, y + dy, length, width, heading + rng.normal(0.0, 0.02))
    return walls


_EAST, _WEST = -110.0, 290.0  # m, x where the lanes to the east and to the west begin

_CYCLE = 50.0  # s


def street_jam(people: int = 16) -> Scene:
    """The street with two lights, at which the robot waits beside the cars, and a queue.

    Everybody stops now and then. The lane to the west is a queue, past most of which the robot has
    driven when it begins to move.
    """
    return dataclasses.replace(
        street(people),
        name="street-jam",
        lanes=(
            Lane(((_EAST, -INNER), (_WEST, -INNER)), lights=_lights(-INNER)),
            Lane(((_WEST, INNER), (_EAST, INNER)), waiting=11, stop=_WEST - 45.0, go=(95, -OUTER)),
        ),
        lights=(*_lights(-OUTER), Light((112.0, OUTER), (15.0, 33.0), _CYCLE)),
        traffic=TrafficOptions(
            vehicles=18, min_speed=4.0, max_speed=9.0, stopping_share=1.0, max_stop=15.0
        ),
    )


def _lights(y: float) -> tuple[Light, ...]:
    """Those that a lane to the east has, one after the other."""
    return (Light((48.0, y), (5.0, 25.0), _CYCLE), Light((118.0, y), (30.0, 48.0), _CYCLE))
