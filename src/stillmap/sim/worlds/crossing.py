"""A crossing with lights and a park, and a street corner with cars that wait to turn."""

import math

import numpy as np

from stillmap.sim.options import CrowdOptions, TrafficOptions
from stillmap.sim.scene import Lane, Light, Point, Scene, Segment
from stillmap.sim.walls import box, pillar, polyline
from stillmap.sim.worlds.street import (
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
    make_house_front,
    make_parked_cars,
    make_trees_and_lamps,
)

_CROSSING_SEED = 38

_END = 90.0  # m, from the middle to where the streets end

_NARROW = KERB + 1.6  # m, where the houses of the narrow pavements stand

_PARK = 55.0  # m, how far people walk in the park

_LANE = 200.0  # m, from the middle to where lanes begin and end

_STOP = 17.0  # m, the same to where one waits

_CYCLE = 60.0  # s

_RED_EAST = (26.0, 60.0)  # s, when who drives to the east or west waits

_RED_NORTH = (56.0, 92.0)  # s, the same of those who cross


def crossing(people: int = 30) -> Scene:
    """Two streets of 180 m that cross; the robot drives east and comes back.

    In the south-east there is a park without houses: nothing stands behind who walks or drives
    before it. Two pavements are 1.6 m wide, and who walks there walks along the wall. The crowns of
    the trees reach above the road; everything passes under them.
    """
    rng = np.random.default_rng(_CROSSING_SEED)
    there: list[Point] = [(-80.0, -OUTER), (72.0, -OUTER), (76.5, -4.2), (79.4, 0.0), (76.5, 4.2)]
    walls = _houses(rng) + _trees(rng) + _parked(rng)
    walls += box(24.0, -14.0, 1.6, 0.5) + box(40.0, -22.0, 1.6, 0.5, 0.7)
    return Scene(
        name="crossing",
        walls=tuple(walls),
        route=(*there, (72.0, OUTER), (-78.0, OUTER)),
        kerbs=tuple(_kerbs()),
        people_at=((-30.0, 11.9), (30.0, KERB + 0.8), (-30.0, -KERB - 0.8), (18.0, -12.0)),
        lanes=_crossing_lanes(),
        lights=(
            Light((-_STOP, -OUTER), _RED_EAST, _CYCLE),
            Light((_STOP, OUTER), _RED_EAST, _CYCLE),
        ),
        crowd=CrowdOptions(people=people),
        traffic=TrafficOptions(vehicles=16, min_speed=6.0, max_speed=10.0),
        laser=LASER,
        robot=ROBOT,
        odometry=ODOMETRY,
        heights=OPEN_AIR,
        pavements=(
            (-_END, KERB, -KERB, _END),
            (KERB, KERB, _END, _END),
            (-_END, -_END, -KERB, -KERB),
            (KERB, -_END, _END, -KERB),
        ),
    )


def _houses(rng: np.random.Generator) -> list[Segment]:
    length = _END - FRONT
    walls = make_house_front((-_END, FRONT), length, "north", rng) + make_house_front(
        (-FRONT, FRONT), length, "west", rng
    )
    walls += make_house_front((FRONT, _NARROW), length, "north", rng)
    walls += make_house_front((FRONT, _NARROW), _END - _NARROW, "east", rng)
    walls += make_house_front((-_END, -_NARROW), length, "south", rng)
    return walls + make_house_front((-FRONT, -_END), _END - _NARROW, "west", rng)


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


def _parked(rng: np.random.Generator) -> list[Segment]:
    places = [(float(x), PARKED, 0.0) for x in (*range(-84, -24, 7), *range(26, 84, 7))]
    places += [(float(x), -PARKED, 0.0) for x in range(-84, -24, 7)]
    return make_parked_cars(places, rng)


def _kerbs() -> list[Segment]:
    """Around each of the four corners, as far as people walk."""
    lines: list[list[Point]] = [[(_PARK, -KERB), (_PARK, -YARD), (KERB, -YARD), (KERB, -KERB)]]
    lines.append([(KERB, -KERB), (_PARK, -KERB)])
    for i, j in ((-1, 1), (1, 1), (-1, -1)):
        street: list[Point] = [(i * _END, j * YARD), (i * _END, j * KERB), (i * KERB, j * KERB)]
        lines.append([*street, (i * KERB, j * YARD), (i * YARD, j * YARD)])
    return [segment for line in lines for segment in polyline(line)]


def _crossing_lanes() -> tuple[Lane, ...]:
    """One each way on both streets; those from south to north drive under the trees."""
    lanes = []
    for side in (-1.0, 1.0):
        y, stop, end = side * INNER, side * _STOP, side * _LANE
        lights = (Light((stop, y), _RED_EAST, _CYCLE),)
        lanes.append(Lane(((end, y), (-end, y)), lights=lights))
        x = -side * OUTER
        lights = (Light((x, stop), _RED_NORTH, _CYCLE),)
        lanes.append(Lane(((x, end), (x, -end)), lights=lights))
    return tuple(lanes)


_TURN_SEED = 36

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
        lanes=_turn_lanes(lane_south),
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
    rng = np.random.default_rng(_TURN_SEED)
    west, east = _CROSSING - FRONT, _CROSSING + FRONT
    walls = make_house_front((_WEST, -FRONT), west - _WEST, "south", rng)
    walls += make_house_front((_WEST, FRONT), west - _WEST, "north", rng)
    walls += make_house_front((west, _SOUTH), -FRONT - _SOUTH, "west", rng)
    walls += make_house_front((west, FRONT), _NORTH - FRONT, "west", rng)
    walls += make_house_front((east, _SOUTH), _NORTH - _SOUTH, "east", rng)
    beside = KERB + 0.7
    for side in (-1.0, 1.0):
        xs = range(int(_WEST) + 5, 85, 13)
        walls += make_trees_and_lamps([(float(x), side * beside) for x in xs], rng)
        ys = [y for y in range(int(_SOUTH) + 6, int(_NORTH) - 4, 12) if abs(y) > 16 or side > 0]
        walls += make_trees_and_lamps([(_CROSSING + side * beside, float(y)) for y in ys], rng)
        walls += make_parked_cars(
            [(float(x), side * PARKED, 0.0) for x in np.arange(-26, 66, 6.1)], rng
        )
        ys = [y for y in range(int(_SOUTH) + 5, int(_NORTH) - 4, 7) if abs(y) > 22]
        upright = math.pi / 2
        walls += make_parked_cars([(_CROSSING + side * PARKED, float(y), upright) for y in ys], rng)
    return walls


def _turn_lanes(lane_south: float) -> tuple[Lane, ...]:
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
