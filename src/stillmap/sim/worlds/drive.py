"""A drive of a kilometre through a town: a car with a laser at a hundred frames a second or ten."""

import math

import numpy as np

from stillmap.sim.options import (
    CrowdOptions,
    LaserOptions,
    OdometryOptions,
    RobotOptions,
    TrafficOptions,
)
from stillmap.sim.scene import Lane, Light, Point, Scene, Segment
from stillmap.sim.walls import Side, polyline
from stillmap.sim.worlds.street import (
    FRONT,
    INNER,
    KERB,
    OPEN_AIR,
    OUTER,
    PARKED,
    make_house_front,
    make_parked_cars,
    make_trees_and_lamps,
)

_LAYOUT_SEED = 37
_WEST, _SOUTH, _NORTH = -60.0, -530.0, 80.0  # m, where the streets end
_CORNER = 520.0  # m, x of the middle of the street from south to north
_SIDE_STREET = 262.0  # m, the same of the street that crosses at the light
_NARROW = 8.0  # m, from there to its houses
_FAR = 90.0  # m, how far one sees into it
_BEYOND = 250.0  # m, how far lanes go on where the laser does not see them
_RED = (6.0, 36.0)  # s, when the light is red for the robot
_GREEN = (33.0, 97.0)  # s, when it is red for those who cross
_CYCLE = 80.0  # s


def drive(people: int = 12) -> Scene:
    """A kilometre of streets with one corner, driven once by a car at up to 15.6 m/s (35 mph).

    After Haehnel, Triebel, Burgard, Thrun, Map building with mobile robots in dynamic
    environments, ICRA 2003, Sect. 4.3: a laser on a car, about 1 km around one street corner,
    with cars that wait to turn, and no odometry to speak of; what stands where is made up. The
    robot comes from the west, waits at a red light where a side street crosses, turns right at the
    end of the street and leaves to the south. The queue at the corner stands still as long as it
    is seen; cars at the light stop, wait and drive on beside the robot. Houses have alleys between
    them. A robot that shall take more scans turns back at the end.
    """
    lane_south = _CORNER - OUTER
    corner = _arc((_CORNER - OUTER - 9.0, -OUTER - 9.0), 9.0, math.pi / 2, 0.0)
    stop: Point = (_SIDE_STREET - 14.0, -OUTER)
    caps = [
        [(_WEST, -FRONT), (_WEST, FRONT)],
        [(_CORNER - FRONT, _SOUTH), (_CORNER + FRONT, _SOUTH)],
        [(_CORNER - FRONT, _NORTH), (_CORNER + FRONT, _NORTH)],
    ]
    kerbs = [segment for line in (*_kerbs(), *caps) for segment in polyline(line)]
    return Scene(
        name="drive",
        walls=tuple(_walls()),
        route=((0.0, -OUTER), *corner, (lane_south, -470.0)),
        kerbs=tuple(kerbs),
        people_at=((20.0, -11.9), (20.0, 11.9), (_CORNER + 11.9, 0.0)),
        lanes=_lanes(),
        lights=(Light(stop, _RED, _CYCLE),),
        crowd=CrowdOptions(people=people),
        traffic=TrafficOptions(vehicles=60, min_speed=8.0, max_speed=14.0, stopping_share=0.1),
        laser=LaserOptions(beams=181, max_range=80.0, range_noise=0.03, x=1.9),
        robot=RobotOptions(speed=15.6, acceleration=2.5, turn_rate=0.9, radius=0.9, scan_rate=75.0),
        odometry=OdometryOptions(wheel_base=1.5),
        heights=OPEN_AIR,
    )


def _arc(middle: Point, radius: float, start: float, end: float) -> list[Point]:
    """Points a metre apart on a piece of a circle, from the angle `start` to `end`."""
    count = round(abs(end - start) * radius) + 1
    turns = np.linspace(start, end, count).tolist()
    return [(middle[0] + radius * math.cos(a), middle[1] + radius * math.sin(a)) for a in turns]


def _sections() -> list[tuple[Point, float, Side]]:
    """Start, length and position of the house fronts."""
    west, east = _SIDE_STREET - _NARROW, _SIDE_STREET + _NARROW
    near, far = _CORNER - FRONT, _CORNER + FRONT
    sections: list[tuple[Point, float, Side]] = []
    houses: tuple[tuple[float, Side], ...] = ((-FRONT, "south"), (FRONT, "north"))
    for y, side in houses:
        sections.append(((_WEST, y), west - _WEST, side))
        sections.append(((east, y), near - east, side))
    for y in (-FRONT - _FAR, FRONT):
        sections.append(((west, y), _FAR, "west"))
        sections.append(((east, y), _FAR, "east"))
    sections.append(((near, _SOUTH), -FRONT - _SOUTH, "west"))
    sections.append(((near, FRONT), _NORTH - FRONT, "west"))
    sections.append(((far, _SOUTH), _NORTH - _SOUTH, "east"))
    return sections


def _kerbs() -> list[list[Point]]:
    """The lines between pavements and streets; nobody walks across the side street."""
    lines: list[list[Point]] = []
    west, east = _SIDE_STREET - _NARROW + 2.0, _SIDE_STREET + _NARROW - 2.0
    near, far = _CORNER - KERB, _CORNER + KERB
    for side in (-1.0, 1.0):
        end = FRONT + _FAR
        lines.append([(_WEST, side * KERB), (west, side * KERB), (west, side * end)])
        corner = [(near, side * KERB), (near, _SOUTH if side < 0 else _NORTH)]
        lines.append([(east, side * end), (east, side * KERB), *corner])
        lines.append([(west - 2.0, side * end), (east + 2.0, side * end)])
    return [*lines, [(far, _SOUTH), (far, _NORTH)]]


def _walls() -> list[Segment]:
    rng = np.random.default_rng(_LAYOUT_SEED)
    walls: list[Segment] = []
    for start, length, houses in _sections():
        walls += _houses(start, length, houses, rng)
    beside, upright = KERB + 0.7, math.pi / 2
    for side in (-1.0, 1.0):
        xs = [x for x in np.arange(_WEST + 5, _CORNER - 16, 12.5) if abs(x - _SIDE_STREET) > 12]
        walls += make_trees_and_lamps([(float(x), side * beside) for x in xs], rng)
        ys = [y for y in np.arange(_SOUTH + 6, _NORTH - 4, 12.0) if abs(y) > 16 or side > 0]
        walls += make_trees_and_lamps([(_CORNER + side * beside, float(y)) for y in ys], rng)
        xs = [x for x in np.arange(_WEST + 4, _CORNER - 26, 6.1) if abs(x - _SIDE_STREET) > 24]
        walls += make_parked_cars([(float(x), side * PARKED, 0.0) for x in xs], rng)
        ys = [y for y in np.arange(_SOUTH + 5, _NORTH - 4, 7.0) if abs(y) > 26]
        walls += make_parked_cars([(_CORNER + side * PARKED, float(y), upright) for y in ys], rng)
    return walls


def _houses(start: Point, length: float, side: Side, rng: np.random.Generator) -> list[Segment]:
    """House fronts with alleys between them; all but the first and the last stand back a little."""
    outwards = 1.0 if side in ("north", "east") else -1.0

    def at(along: float, back: float) -> Point:
        if side in ("north", "south"):
            return (start[0] + along, start[1] + outwards * back)
        return (start[0] + outwards * back, start[1] + along)

    walls: list[Segment] = []
    begin, back, is_last = 0.0, 0.0, False
    while not is_last:
        house, alley, depth, next_back = rng.uniform((14, 1.5, 8, 0), (36, 6, 25, 1.2)).tolist()
        end = begin + house
        is_last = length - end - alley < 40.0
        if is_last:
            next_back = 0.0
        walls += make_house_front(at(begin, back), house, side, rng)
        corners = [(end, back), (end, depth), (end + alley, depth), (end + alley, next_back)]
        walls += polyline([at(*corner) for corner in corners])
        begin, back = end + alley, next_back
    return walls + make_house_front(at(begin, back), length - begin, side, rng)


def _lanes() -> tuple[Lane, ...]:
    """Lanes with and against the robot, across its way at the light, and a queue at the corner."""
    inner, outer = _CORNER + INNER, _CORNER + OUTER
    west, south, north = _WEST - _BEYOND, _SOUTH - _BEYOND, _NORTH + _BEYOND
    turn = 14.0  # m before the corner, where lanes begin to turn
    beside = _arc((_CORNER - turn, -turn), turn - INNER, math.pi / 2, 0.0)
    left = _arc((_CORNER - turn, -turn), turn + INNER, 0.0, math.pi / 2)
    right = _arc((_CORNER - turn, turn), turn - OUTER, 0.0, -math.pi / 2)
    stop = _SIDE_STREET - 14.0
    ahead = Light((stop + 2.5, -INNER), _RED, _CYCLE)
    back = Light((_SIDE_STREET + 14.0, OUTER), _RED, _CYCLE)
    across = []
    for side in (1.0, -1.0):
        x, end = _SIDE_STREET + side * INNER, side * (FRONT + _FAR + _BEYOND)
        light = Light((x, -side * 15.0), _GREEN, _CYCLE)
        across.append(Lane(((x, -end), (x, end)), lights=(light,)))
    queue = (*((inner, south), *left), (west, INNER))
    return (
        Lane(((west, -INNER), *beside, (_CORNER - INNER, south)), lights=(ahead,)),
        Lane(((_CORNER - OUTER, north), *right, (west, OUTER)), lights=(back,)),
        Lane(((outer, south), (outer, north))),
        *across,
        Lane(queue, waiting=5, stop=-turn - 2.0 - south, go=(_CORNER - OUTER, -120.0)),
    )
