"""A street that ends in another: a corner where cars wait to turn, and a drive of a kilometre."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from stillmap.sim.options import (
    CrowdOptions,
    LaserOptions,
    OdometryOptions,
    RobotOptions,
    TrafficOptions,
)
from stillmap.sim.scene import Lane, Light, Point, Scene, Segment
from stillmap.sim.walls import Side, locate, polyline
from stillmap.sim.worlds.street import (
    FRONT,
    INNER,
    KERB,
    OPEN_AIR,
    OUTER,
    PARKED,
    YARD,
    make_house_front,
    make_parked_cars,
    make_street_scene,
    make_trees_and_lamps,
)

Front = tuple[Point, float, Side]  # start, length and position of houses in a row


class _Corner(NamedTuple):
    """A street from the west, in the middle of which y is 0, that ends in one to the north.

    Attributes:
        x: metres, of the middle of the latter.
        west, south, north: metres, where the streets end.
    """

    x: float
    west: float
    south: float
    north: float

    def caps(self) -> list[Segment]:
        """Lines across the ends of the streets."""
        caps: list[Segment] = [(self.west, -FRONT, self.west, FRONT)]
        return caps + [(self.x - FRONT, y, self.x + FRONT, y) for y in (self.south, self.north)]

    def fronts(self) -> list[Front]:
        """The houses along the street to the north."""
        return [
            ((self.x - FRONT, self.south), -FRONT - self.south, "west"),
            ((self.x - FRONT, FRONT), self.north - FRONT, "west"),
            ((self.x + FRONT, self.south), self.north - self.south, "east"),
        ]

    def line_streets(
        self,
        side: float,
        trees: Iterable[float],
        cars: Iterable[float],
        gap: float,
        rng: np.random.Generator,
    ) -> list[Segment]:
        """Trees, lamps and parked cars on one side of both streets.

        Args:
            side: -1: in the south and west, 1: in the north and east.
            trees, cars: metres, x of those along the street from the west.
            gap: metres from the corner without cars.
            rng: of sizes and places.
        """
        beside, parked = side * (KERB + 0.7), side * PARKED
        ys = np.arange(self.south + 6, self.north - 4, 12.0)
        walls = make_trees_and_lamps(trees, beside, rng)
        walls += make_trees_and_lamps(
            [y for y in ys if abs(y) > 16 or side > 0], self.x + beside, rng, northward=True
        )
        walls += make_parked_cars(cars, parked, rng)
        ys = np.arange(self.south + 5, self.north - 4, 7.0)
        return walls + make_parked_cars(
            [y for y in ys if abs(y) > gap], self.x + parked, rng, northward=True
        )


_TURN = _Corner(100.0, -30.0, -110.0, 70.0)


def street_turn() -> Scene:
    """A street from the west that ends in one from south to north.

    The robot comes from the west, turns right, and leaves to the south. It passes two queues of
    cars that wait to turn left. The first drives on when a house hides it from the robot, the
    second shortly before the robot gets to its end, when a laser that looks ahead has long lost
    sight of it. So nothing that a recording in one pass over the route holds says that they move:
    Haehnel, Triebel, Burgard, Thrun, Map building with mobile robots in dynamic environments,
    ICRA 2003, Sect. 4.3, on the cars that were not found dynamic. A robot that shall take more
    scans turns back at the end.
    """
    x, start, south, north = _TURN
    lane_south = x - OUTER
    corner: list[Point] = [(89.5, -OUTER), (93.2, -6.4), (lane_south, -10.0)]
    west, east = x - KERB, x + KERB
    kerbs = [
        *polyline([(start, -KERB), (west, -KERB), (west, south)]),
        *polyline([(start, KERB), (west, KERB), (west, north)]),
        (east, south, east, north),
    ]
    return make_street_scene(
        name="street-turn",
        walls=tuple(_turn_walls()),
        route=((2.0, -OUTER), *corner, (lane_south, -100.0)),
        kerbs=(*kerbs, *_TURN.caps()),
        people_at=((0.0, -11.9), (0.0, 11.9), (x + 11.9, 0.0)),
        lanes=_turn_lanes(lane_south),
        crowd=CrowdOptions(people=12),
        traffic=TrafficOptions(vehicles=8),
        pavements=(
            (start, -YARD, west, -KERB),
            (start, KERB, west, YARD),
            (x - YARD, south, west, -YARD),
            (x - YARD, YARD, west, north),
            (east, south, x + YARD, north),
        ),
    )


def _turn_walls() -> list[Segment]:
    rng = np.random.default_rng(36)
    start, length = _TURN.west, _TURN.x - FRONT - _TURN.west
    walls = make_house_front((start, -FRONT), length, "south", rng)
    walls += make_house_front((start, FRONT), length, "north", rng)
    for front in _TURN.fronts():
        walls += make_house_front(*front, rng)
    for side in (-1.0, 1.0):
        cars = np.arange(-26, 66, 6.1)
        walls += _TURN.line_streets(side, range(int(start) + 5, 85, 13), cars, 22, rng)
    return walls


def _turn_lanes(lane_south: float) -> tuple[Lane, ...]:
    """Two queues that wait to turn left, and two lanes on which cars drive by."""
    inner, outer = _TURN.x + INNER, _TURN.x + OUTER
    from_west: list[Point] = [(-120, -INNER), (93, -INNER), (98, -0.6), (101, 3), (inner, 9)]
    from_south: list[Point] = [(inner, -210), (inner, -8), (100.8, -3), (98, 0.6), (92, INNER)]
    from_north: list[Point] = [(lane_south, 160), (lane_south, 11), (94, 7.6), (91.5, 5.9)]
    return (
        Lane((*from_west, (inner, 160)), waiting=4, stop=76.0 + 120.0, go=(lane_south, -30.0)),
        Lane((*from_south, (-120, INNER)), waiting=4, stop=210.0 - 15.0, go=(lane_south, -78.0)),
        Lane(((outer, -210), (outer, 160))),
        Lane((*from_north, (88, OUTER), (-120, OUTER))),
    )


_DRIVE = _Corner(520.0, -60.0, -530.0, 80.0)
_SIDE_STREET = 262.0  # m, x of the middle of the street that crosses at the light
_NARROW = 8.0  # m, from there to its houses
_FAR = 90.0  # m, how far one sees into it
_RED = (6.0, 36.0)  # s, when the light is red for the robot
_GREEN = (33.0, 97.0)  # s, when it is red for those who cross
_CYCLE = 80.0  # s


def drive() -> Scene:
    """A kilometre of streets with one corner, driven once by a car at up to 15.6 m/s (35 mph).

    After Haehnel, Triebel, Burgard, Thrun, Map building with mobile robots in dynamic
    environments, ICRA 2003, Sect. 4.3: a laser on a car, about 1 km around one street corner,
    with cars that wait to turn, and no odometry to speak of; what stands where is made up. The
    robot comes from the west, waits at a red light where a side street crosses, turns right at the
    end of the street and leaves to the south. The queue at the corner stands still as long as it
    is seen; cars at the light stop, wait and drive on beside the robot. Houses have alleys between
    them. A robot that shall take more scans turns back at the end.
    """
    lane_south = _DRIVE.x - OUTER
    corner = _arc((lane_south - 9.0, -OUTER - 9.0), 9.0, math.pi / 2, 0.0)
    kerbs = [segment for line in _drive_kerbs() for segment in polyline(line)]
    return Scene(
        name="drive",
        walls=tuple(_drive_walls()),
        route=((0.0, -OUTER), *corner, (lane_south, -470.0)),
        kerbs=(*kerbs, *_DRIVE.caps()),
        people_at=((20.0, -11.9), (20.0, 11.9), (_DRIVE.x + 11.9, 0.0)),
        lanes=_drive_lanes(),
        lights=(Light((_SIDE_STREET - 14.0, -OUTER), _RED, _CYCLE),),
        crowd=CrowdOptions(people=12),
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


def _drive_kerbs() -> list[list[Point]]:
    """The lines between pavements and streets; nobody walks across the side street."""
    lines: list[list[Point]] = []
    start, south, north = _DRIVE[1:]
    west, east = _SIDE_STREET - _NARROW + 2.0, _SIDE_STREET + _NARROW - 2.0
    near, far = _DRIVE.x - KERB, _DRIVE.x + KERB
    for side in (-1.0, 1.0):
        end = FRONT + _FAR
        lines.append([(start, side * KERB), (west, side * KERB), (west, side * end)])
        corner = [(near, side * KERB), (near, south if side < 0 else north)]
        lines.append([(east, side * end), (east, side * KERB), *corner])
        lines.append([(west - 2.0, side * end), (east + 2.0, side * end)])
    return [*lines, [(far, south), (far, north)]]


def _drive_walls() -> list[Segment]:
    rng = np.random.default_rng(37)
    west, east = _SIDE_STREET - _NARROW, _SIDE_STREET + _NARROW
    fronts: list[Front] = []
    sides: tuple[tuple[float, Side], ...] = ((-FRONT, "south"), (FRONT, "north"))
    for y, side in sides:
        fronts.append(((_DRIVE.west, y), west - _DRIVE.west, side))
        fronts.append(((east, y), _DRIVE.x - FRONT - east, side))
    for y in (-FRONT - _FAR, FRONT):
        fronts += [((west, y), _FAR, "west"), ((east, y), _FAR, "east")]
    walls: list[Segment] = []
    for front in (*fronts, *_DRIVE.fronts()):
        walls += _houses(*front, rng)
    trees = np.arange(_DRIVE.west + 5, _DRIVE.x - 16, 12.5)
    cars = np.arange(_DRIVE.west + 4, _DRIVE.x - 26, 6.1)
    trees, cars = (xs[abs(xs - _SIDE_STREET) > gap] for xs, gap in ((trees, 12), (cars, 24)))
    for off in (-1.0, 1.0):
        walls += _DRIVE.line_streets(off, trees, cars, 26, rng)
    return walls


def _houses(start: Point, length: float, side: Side, rng: np.random.Generator) -> list[Segment]:
    """House fronts with alleys between them; all but the first and the last stand back a little."""
    walls: list[Segment] = []
    begin, back, is_last = 0.0, 0.0, False
    while not is_last:
        house, alley, depth, next_back = rng.uniform((14, 1.5, 8, 0), (36, 6, 25, 1.2)).tolist()
        end = begin + house
        is_last = length - end - alley < 40.0
        if is_last:
            next_back = 0.0
        walls += make_house_front(locate(start, side, begin, back), house, side, rng)
        corners = [(end, back), (end, depth), (end + alley, depth), (end + alley, next_back)]
        walls += polyline([locate(start, side, *corner) for corner in corners])
        begin, back = end + alley, next_back
    return walls + make_house_front(locate(start, side, begin, back), length - begin, side, rng)


def _drive_lanes() -> tuple[Lane, ...]:
    """Lanes with and against the robot, across its way at the light, and a queue at the corner."""
    x, beyond = _DRIVE.x, 250.0  # m, how far lanes go on where the laser does not see them
    inner, outer = x + INNER, x + OUTER
    west, south, north = _DRIVE.west - beyond, _DRIVE.south - beyond, _DRIVE.north + beyond
    turn = 14.0  # m before the corner, where lanes begin to turn
    beside = _arc((x - turn, -turn), turn - INNER, math.pi / 2, 0.0)
    left = _arc((x - turn, -turn), turn + INNER, 0.0, math.pi / 2)
    right = _arc((x - turn, turn), turn - OUTER, 0.0, -math.pi / 2)
    stop = _SIDE_STREET - 14.0
    ahead = Light((stop + 2.5, -INNER), _RED, _CYCLE)
    back = Light((_SIDE_STREET + 14.0, OUTER), _RED, _CYCLE)
    across = []
    for side in (1.0, -1.0):
        middle, end = _SIDE_STREET + side * INNER, side * (FRONT + _FAR + beyond)
        light = Light((middle, -side * 15.0), _GREEN, _CYCLE)
        across.append(Lane(((middle, -end), (middle, end)), lights=(light,)))
    queue = (*((inner, south), *left), (west, INNER))
    return (
        Lane(((west, -INNER), *beside, (x - INNER, south)), lights=(ahead,)),
        Lane(((x - OUTER, north), *right, (west, OUTER)), lights=(back,)),
        Lane(((outer, south), (outer, north))),
        *across,
        Lane(queue, waiting=5, stop=-turn - 2.0 - south, go=(x - OUTER, -120.0)),
    )
