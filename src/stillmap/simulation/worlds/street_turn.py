"""A street corner where cars wait to turn: the robot passes them once, and they never stir."""

import math

import numpy as np

from stillmap.simulation.options import CrowdOptions, TrafficOptions
from stillmap.simulation.scene import Lane, Point, Scene, Segment
from stillmap.simulation.walls import polyline
from stillmap.simulation.worlds.street import (
    FRONT,
    INNER,
    KERB,
    LASER,
    ODOMETRY,
    OPEN_AIR,
    OUTER,
    PARKED,
    ROBOT,
    YARD,
    front,
    parked,
    trees_and_lamps,
)

_LAYOUT_SEED = 36
_WEST, _SOUTH, _NORTH = -30.0, -110.0, 70.0  # m, where the streets end
_CROSSING = 100.0  # m, x of the middle of the street from south to north


def street_turn(people: int = 12) -> Scene:
    """A street from the west that ends in one from south to north.

    The robot comes from the west, turns right, and leaves to the south. It passes two queues of
    cars that wait to turn left. The first drives on when a house hides it from the robot, the
    second shortly before the robot gets to its end, when a laser that looks ahead has long lost
    sight of it. So nothing that a recording in one pass over the route holds says that they move:
    Haehnel, Triebel, Burgard, Thrun, Map building with mobile robots in dynamic environments,
    ICRA 2003, Sect. 4.3, on the cars that were not found dynamic. A robot that shall take more
    scans turns back at the end.
    """
    lane_south = _CROSSING - OUTER
    corner: list[Point] = [(89.5, -OUTER), (93.2, -6.4), (lane_south, -10.0)]
    kerbs = _outline(KERB)
    for cap in (
        [(_WEST, -FRONT), (_WEST, FRONT)],
        [(_CROSSING - FRONT, _SOUTH), (_CROSSING + FRONT, _SOUTH)],
        [(_CROSSING - FRONT, _NORTH), (_CROSSING + FRONT, _NORTH)],
    ):
        kerbs += polyline(cap)
    return Scene(
        name="street-turn",
        walls=tuple(_walls()),
        route=((2.0, -OUTER), *corner, (lane_south, -100.0)),
        kerbs=tuple(kerbs),
        people_at=((0.0, -11.9), (0.0, 11.9), (_CROSSING + 11.9, 0.0)),
        lanes=_lanes(lane_south),
        crowd=CrowdOptions(people=people),
        traffic=TrafficOptions(vehicles=8),
        laser=LASER,
        robot=ROBOT,
        odometry=ODOMETRY,
        heights=OPEN_AIR,
        pavements=_pavements(),
    )


def _outline(off: float) -> list[Segment]:
    """The three lines that run beside the streets at a distance from their middles."""
    west, east = _CROSSING - off, _CROSSING + off
    return [
        *polyline([(_WEST, -off), (west, -off), (west, _SOUTH)]),
        *polyline([(_WEST, off), (west, off), (west, _NORTH)]),
        *polyline([(east, _SOUTH), (east, _NORTH)]),
    ]


def _pavements() -> tuple[Segment, ...]:
    west, east = _CROSSING - KERB, _CROSSING + KERB
    return (
        (_WEST, -YARD, west, -KERB),
        (_WEST, KERB, west, YARD),
        (_CROSSING - YARD, _SOUTH, west, -YARD),
        (_CROSSING - YARD, YARD, west, _NORTH),
        (east, _SOUTH, _CROSSING + YARD, _NORTH),
    )


def _walls() -> list[Segment]:
    rng = np.random.default_rng(_LAYOUT_SEED)
    west, east = _CROSSING - FRONT, _CROSSING + FRONT
    walls = front((_WEST, -FRONT), west - _WEST, "south", rng)
    walls += front((_WEST, FRONT), west - _WEST, "north", rng)
    walls += front((west, _SOUTH), -FRONT - _SOUTH, "west", rng)
    walls += front((west, FRONT), _NORTH - FRONT, "west", rng)
    walls += front((east, _SOUTH), _NORTH - _SOUTH, "east", rng)
    beside = KERB + 0.7
    for side in (-1.0, 1.0):
        xs = range(int(_WEST) + 5, 85, 13)
        walls += trees_and_lamps([(float(x), side * beside) for x in xs], rng)
        ys = [y for y in range(int(_SOUTH) + 6, int(_NORTH) - 4, 12) if abs(y) > 16 or side > 0]
        walls += trees_and_lamps([(_CROSSING + side * beside, float(y)) for y in ys], rng)
        walls += parked([(float(x), side * PARKED, 0.0) for x in np.arange(-26, 66, 6.1)], rng)
        ys = [y for y in range(int(_SOUTH) + 5, int(_NORTH) - 4, 7) if abs(y) > 22]
        upright = math.pi / 2
        walls += parked([(_CROSSING + side * PARKED, float(y), upright) for y in ys], rng)
    return walls


def _lanes(lane_south: float) -> tuple[Lane, ...]:
    """Two queues that wait to turn left, and two lanes on which cars drive by."""
    inner, outer = _CROSSING + INNER, _CROSSING + OUTER
    from_west: list[Point] = [(-120, -INNER), (93, -INNER), (98, -0.6), (101, 3), (inner, 9)]
    from_south: list[Point] = [(inner, -210), (inner, -8), (100.8, -3), (98, 0.6), (92, INNER)]
    from_north: list[Point] = [(lane_south, 160), (lane_south, 11), (94, 7.6), (91.5, 5.9)]
    return (
        Lane((*from_west, (inner, 160)), waiting=4, stop=76.0 + 120.0, go=(lane_south, -30.0)),
        Lane((*from_south, (-120, INNER)), waiting=4, stop=210.0 - 15.0, go=(lane_south, -78.0)),
        Lane(((outer, -210), (outer, 160))),
        Lane((*from_north, (88, OUTER), (-120, OUTER))),
    )
