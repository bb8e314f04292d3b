"""Streets with parked cars and traffic: a straight one, and two that cross beside a park."""

import dataclasses
import math
from collections.abc import Iterable
from functools import partial

import numpy as np

from stillmap.sim.options import (
    CrowdOptions,
    HeightOptions,
    LaserOptions,
    OdometryOptions,
    RobotOptions,
    TrafficOptions,
)
from stillmap.sim.scene import Lane, Light, Point, Scene, Segment, Stay, Thing
from stillmap.sim.walls import MovedObject, Opening, Side, add_objects, box, pillar, polyline, wall

INNER, OUTER = 1.75, 5.25  # m from the middle of the road to the middles of the lanes
PARKED = 8.2  # m from there to the middles of parked cars
KERB = 9.4  # m, beyond it are the pavements
FRONT = 13.5  # m, where the houses stand
YARD = FRONT + 10.0  # m, where their yards end
OPEN_AIR = HeightOptions(ceiling=None)

make_street_scene = partial(  # the robot is a car
    Scene,
    laser=LaserOptions(beams=181, max_range=80.0, range_noise=0.03, x=0.85),
    robot=RobotOptions(speed=5.0, turn_rate=0.9, radius=0.9, scan_rate=10.0),
    odometry=OdometryOptions(wheel_base=1.5),
    heights=OPEN_AIR,
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


def make_trees_and_lamps(
    along: Iterable[float], off: float, rng: np.random.Generator, northward: bool = False
) -> list[Segment]:
    """By turns two trees and a lamp post in a row to the east or north, `off` m from its axis."""
    walls: list[Segment] = []
    for k, at in enumerate(along):
        x, y = (off, float(at)) if northward else (float(at), off)
        radius = 0.08 if k % 3 == 2 else float(rng.uniform(0.12, 0.3))
        walls += pillar(x + rng.uniform(-0.4, 0.4), y, radius, 8)
    return walls


def make_parked_cars(
    along: Iterable[float], off: float, rng: np.random.Generator, northward: bool = False
) -> list[Segment]:
    """Cars in two of three places of such a row."""
    walls: list[Segment] = []
    for at in along:
        if rng.random() < 0.65:
            x, y, heading = (off, float(at), math.pi / 2) if northward else (float(at), off, 0.0)
            length, width = rng.uniform((4.0, 1.7), (4.9, 1.9)).tolist()
            dx, dy = rng.uniform(-0.15, 0.15, 2).tolist()
            walls += box(x + dx, y + dy, length, width, heading + rng.normal(0.0, 0.02))
    return walls


def street() -> Scene:
    """A street of 180 m with two lanes each way: the robot drives down one side and up the other.

    The lanes next to it are full of cars that overtake or come towards it, and go on for a
    hundred metres beyond both ends.
    """
    rng = np.random.default_rng(35)
    west, east = -30.0, 210.0
    walls = make_house_front((west, -FRONT), east - west, "south", rng)
    walls += make_house_front((west, FRONT), east - west, "north", rng)
    for y in (-1.0, 1.0):
        xs = np.arange(west + 4, east - 4, 0.1)[::125]
        walls += make_trees_and_lamps(xs, y * (KERB + 0.7), rng)
        walls += make_parked_cars(np.arange(-26, 200, 6.1), y * PARKED, rng)
    there = [(6.0, -OUTER), (166.0, -OUTER), (170.5, -4.2), (173.4, 0.0), (170.5, 4.2)]
    caps = ((west, -FRONT, west, FRONT), (east, -FRONT, east, FRONT))
    return make_street_scene(
        name="street",
        walls=tuple(walls),
        route=(*there, (166.0, OUTER), (8.0, OUTER)),
        kerbs=((west, -KERB, east, -KERB), (west, KERB, east, KERB), *caps),
        people_at=((20.0, -11.9), (20.0, 11.9)),
        lanes=(Lane(((-110, -INNER), (290, -INNER))), Lane(((290, INNER), (-110, INNER)))),
        crowd=CrowdOptions(people=16),
        traffic=TrafficOptions(vehicles=14),
        pavements=((west, -YARD, east, -KERB), (west, KERB, east, YARD)),
    )


def street_moved() -> Scene:
    """The street, down and up twice: parked cars drive off, others come, one parks elsewhere."""
    slot = (6.1, 2.4)  # m, of a parked car and the room around it
    elsewhere = (Stay(144.8, PARKED, 0.02, since=75.0),)
    leaving = ((28.9, -1, 45.0), (96.0, -1, 55.0), (59.4, 1, 85.0), (108.2, 1, 90.0))
    lifted = [MovedObject((x, side * PARKED), slot, until) for x, side, until in leaving]
    lifted.append(MovedObject((41.1, -PARKED), slot, 50.0, elsewhere))
    coming = (Stay(114.3, -PARKED, since=60.0), Stay(41.1, PARKED, 0.03, since=80.0))
    east: list[Point] = [(6.0, -OUTER), (166.0, -OUTER), (170.5, -4.2), (173.4, 0.0)]
    west: list[Point] = [(170.5, 4.2), (166.0, OUTER), (8.0, OUTER)]
    lap = (*east, *west, (3.5, 4.2), (0.6, 0.0), (3.5, -4.2))
    car = tuple(box(0, 0, 4.4, 1.8))
    scene = add_objects(street(), lifted, [Thing(car, (stay,)) for stay in coming])
    # people hold it up: the number of scans is fixed, however far it comes
    robot = dataclasses.replace(scene.robot, scans=1500)
    return dataclasses.replace(scene, name="street-moved", route=(*lap, *lap), robot=robot)


def street_jam() -> Scene:
    """The street with two lights, at which the robot waits beside the cars, and a queue.

    Everybody stops now and then. The lane to the west is a queue, past most of which the robot has
    driven when it begins to move.
    """
    east, west = -110.0, 290.0  # m, x where the lanes to the east and to the west begin
    cycle = 50.0  # s

    def lights(y: float) -> tuple[Light, ...]:
        """Those that a lane to the east has, one after the other."""
        return (Light((48.0, y), (5.0, 25.0), cycle), Light((118.0, y), (30.0, 48.0), cycle))

    return dataclasses.replace(
        street(),
        name="street-jam",
        lanes=(
            Lane(((east, -INNER), (west, -INNER)), lights=lights(-INNER)),
            Lane(((west, INNER), (east, INNER)), waiting=11, stop=west - 45.0, go=(95, -OUTER)),
        ),
        lights=(*lights(-OUTER), Light((112.0, OUTER), (15.0, 33.0), cycle)),
        traffic=TrafficOptions(
            vehicles=18, min_speed=4.0, max_speed=9.0, stopping_share=1.0, max_stop=15.0
        ),
    )


_END = 90.0  # m, from the middle of the crossing to where the streets end
_NARROW = KERB + 1.6  # m, where the houses of the narrow pavements stand
_STOP = 17.0  # m, from the middle to where one waits
_RED_EAST = (26.0, 60.0)  # s, when who drives to the east or west waits
_RED_NORTH = (56.0, 92.0)  # s, the same of those who cross
_CYCLE = 60.0  # s


def crossing() -> Scene:
    """Two streets of 180 m that cross; the robot drives east and comes back.

    In the south-east there is a park without houses: nothing stands behind who walks or drives
    before it. Two pavements are 1.6 m wide, and who walks there walks along the wall. The crowns of
    the trees reach above the road; everything passes under them.
    """
    rng = np.random.default_rng(38)
    there: list[Point] = [(-80.0, -OUTER), (72.0, -OUTER), (76.5, -4.2), (79.4, 0.0), (76.5, 4.2)]
    walls = _houses(rng) + _trees(rng)
    walls += make_parked_cars((*range(-84, -24, 7), *range(26, 84, 7)), PARKED, rng)
    walls += make_parked_cars(range(-84, -24, 7), -PARKED, rng)
    walls += box(24.0, -14.0, 1.6, 0.5) + box(40.0, -22.0, 1.6, 0.5, 0.7)
    stops: list[Point] = [(-_STOP, -OUTER), (_STOP, OUTER)]
    return make_street_scene(
        name="crossing",
        walls=tuple(walls),
        route=(*there, (72.0, OUTER), (-78.0, OUTER)),
        kerbs=tuple(_kerbs()),
        people_at=((-30.0, 11.9), (30.0, KERB + 0.8), (-30.0, -KERB - 0.8), (18.0, -12.0)),
        lanes=_lanes(),
        lights=tuple(Light(stop, _RED_EAST, _CYCLE) for stop in stops),
        crowd=CrowdOptions(people=30),
        traffic=TrafficOptions(vehicles=16, min_speed=6.0, max_speed=10.0),
        pavements=(
            (-_END, KERB, -KERB, _END),
            (KERB, KERB, _END, _END),
            (-_END, -_END, -KERB, -KERB),
            (KERB, -_END, _END, -KERB),
        ),
    )


def _houses(rng: np.random.Generator) -> list[Segment]:
    wide, narrow = _END - FRONT, _END - _NARROW
    fronts: tuple[tuple[Point, float, Side], ...] = (
        ((-_END, FRONT), wide, "north"),
        ((-FRONT, FRONT), wide, "west"),
        ((FRONT, _NARROW), wide, "north"),
        ((FRONT, _NARROW), narrow, "east"),
        ((-_END, -_NARROW), wide, "south"),
        ((-FRONT, -_END), narrow, "west"),
    )
    return [segment for front in fronts for segment in make_house_front(*front, rng)]


def _trees(rng: np.random.Generator) -> list[Segment]:
    """Old ones along the streets and about the park."""
    beside = KERB + 0.9
    places = [(x, beside) for x in (-78.0, -63.0, -48.0, -33.0, -19.0)]
    places += [(x, -beside) for x in (22.0, 36.0, 50.0, 64.0, 78.0)]
    places += [(side * beside, -side * y) for side in (-1, 1) for y in (28.0, 43.0, 58.0, 73.0)]
    places += [(30.0, -25.0), (46.0, -30.0), (60.0, -25.0), (24.0, -44.0), (56.0, -52.0)]
    walls: list[Segment] = []
    for x, y in places:
        walls += pillar(x + rng.uniform(-0.3, 0.3), y, rng.uniform(0.66, 0.78), 10)
    return walls


def _kerbs() -> list[Segment]:
    """Around each of the four corners, as far as people walk."""
    park = 55.0  # m, how far people walk in the park
    lines: list[list[Point]] = [[(park, -KERB), (park, -YARD), (KERB, -YARD), (KERB, -KERB)]]
    lines.append([(KERB, -KERB), (park, -KERB)])
    for i, j in ((-1, 1), (1, 1), (-1, -1)):
        street: list[Point] = [(i * _END, j * YARD), (i * _END, j * KERB), (i * KERB, j * KERB)]
        lines.append([*street, (i * KERB, j * YARD), (i * YARD, j * YARD)])
    return [segment for line in lines for segment in polyline(line)]


def _lanes() -> tuple[Lane, ...]:
    """One each way on both streets; those from south to north drive under the trees."""
    lanes = []
    for side in (-1.0, 1.0):
        y, stop, end = side * INNER, side * _STOP, side * 200.0  # m, end: where it begins
        lights = (Light((stop, y), _RED_EAST, _CYCLE),)
        lanes.append(Lane(((end, y), (-end, y)), lights=lights))
        x = -side * OUTER
        lights = (Light((x, stop), _RED_NORTH, _CYCLE),)
        lanes.append(Lane(((x, end), (x, -end)), lights=lights))
    return tuple(lanes)
