"""A crossing with lights, old trees above road and pavement, a narrow pavement, and a park."""

import numpy as np

from stillmap.simulation.options import CrowdOptions, TrafficOptions
from stillmap.simulation.scene import Lane, Light, Point, Scene, Segment
from stillmap.simulation.walls import box, pillar, polyline
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
)

_LAYOUT_SEED = 38
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
    rng = np.random.default_rng(_LAYOUT_SEED)
    there: list[Point] = [(-80.0, -OUTER), (72.0, -OUTER), (76.5, -4.2), (79.4, 0.0), (76.5, 4.2)]
    walls = _houses(rng) + _trees(rng) + _parked(rng)
    walls += box(24.0, -14.0, 1.6, 0.5) + box(40.0, -22.0, 1.6, 0.5, 0.7)
    return Scene(
        name="crossing",
        walls=tuple(walls),
        route=(*there, (72.0, OUTER), (-78.0, OUTER)),
        kerbs=tuple(_kerbs()),
        people_at=((-30.0, 11.9), (30.0, KERB + 0.8), (-30.0, -KERB - 0.8), (18.0, -12.0)),
        lanes=_lanes(),
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
    walls = front((-_END, FRONT), length, "north", rng) + front(
        (-FRONT, FRONT), length, "west", rng
    )
    walls += front((FRONT, _NARROW), length, "north", rng)
    walls += front((FRONT, _NARROW), _END - _NARROW, "east", rng)
    walls += front((-_END, -_NARROW), length, "south", rng)
    return walls + front((-FRONT, -_END), _END - _NARROW, "west", rng)


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
    return parked(places, rng)


def _kerbs() -> list[Segment]:
    """Around each of the four corners, as far as people walk."""
    lines: list[list[Point]] = [[(_PARK, -KERB), (_PARK, -YARD), (KERB, -YARD), (KERB, -KERB)]]
    lines.append([(KERB, -KERB), (_PARK, -KERB)])
    for i, j in ((-1, 1), (1, 1), (-1, -1)):
        street: list[Point] = [(i * _END, j * YARD), (i * _END, j * KERB), (i * KERB, j * KERB)]
        lines.append([*street, (i * KERB, j * YARD), (i * YARD, j * YARD)])
    return [segment for line in lines for segment in polyline(line)]


def _lanes() -> tuple[Lane, ...]:
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
