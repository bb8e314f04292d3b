"""The data of a simulated world."""

import itertools
import math
from dataclasses import dataclass, field
from typing import Literal

from stillmap.sim import options

Point = tuple[float, float]
Segment = tuple[float, float, float, float]
VehicleKind = Literal["car", "forklift"]


@dataclass(frozen=True)
class Door:
    """A door leaf that swings about its hinge.

    Attributes:
        hinge: metres.
        width: metres, of the leaf.
        closed: rad, direction from the hinge along the closed leaf.
        opened: rad, the same of the open leaf.
    """

    hinge: Point
    width: float
    closed: float
    opened: float

    def leaf(self, angle: float) -> Segment:
        """The leaf in direction `angle`."""
        x, y = self.hinge
        return (x, y, x + self.width * math.cos(angle), y + self.width * math.sin(angle))


@dataclass(frozen=True)
class Light:
    """A traffic light.

    Attributes:
        at: metres, stop line: a point of the robot's route or of a lane.
        red: s, begin and end of the first red phase.
        cycle: s, period.
    """

    at: Point
    red: tuple[float, float]
    cycle: float

    def is_red(self, seconds: float) -> bool:
        """True if it is red, in seconds since the beginning of the recording."""
        return (seconds - self.red[0]) % self.cycle < self.red[1] - self.red[0]


@dataclass(frozen=True)
class Lane:
    """A lane of vehicles, which restart at its begin when they reach its end.

    Attributes:
        path: points in metres: a circuit, or a line whose ends lie out of the laser's sight.
        kind: kind of its vehicles.
        waiting: number of vehicles in a queue; a lane with a queue has no others.
        stop: metres along the path, position of the first one of the queue.
        go: metres, point that releases the queue when the robot passes it.
        lights: where vehicles stop while they are red.
    """

    path: tuple[Point, ...]
    kind: VehicleKind = "car"
    waiting: int = 0
    stop: float = 0.0
    go: Point = (0.0, 0.0)
    lights: tuple[Light, ...] = ()


@dataclass(frozen=True)
class Stay:
    """A pose of a movable object during a time span.

    Attributes:
        x, y: metres, of its center.
        yaw: rad.
        since: seconds since the beginning of the recording.
        until: the same; None: unlimited.
    """

    x: float
    y: float
    yaw: float = 0.0
    since: float = 0.0
    until: float | None = None

    def __post_init__(self) -> None:
        lasts = self.until is None or self.until > self.since
        options.require(lasts, "a stay must end after it began")


@dataclass(frozen=True)
class Thing:
    """A movable object: moved, brought or taken away while the robot does not observe it.

    Attributes:
        faces: segments in metres, about its center.
        stays: one after the other; between them it is absent.
    """

    faces: tuple[Segment, ...]
    stays: tuple[Stay, ...]

    def __post_init__(self) -> None:
        is_whole = len(self.faces) > 0 and len(self.stays) > 0
        options.require(is_whole, "a thing needs faces and stays")
        for stay, later in itertools.pairwise(self.stays):
            in_order = stay.until is not None and stay.until <= later.since
            options.require(in_order, "stays of a thing must come one after the other")


@dataclass(frozen=True)
class Scene:
    """A world and what happens in it.

    Attributes:
        name: the world's name.
        walls: segments x0, y0, x1, y1 in metres of all static opaque surfaces.
        route: via points of the robot in metres; paths between them avoid walls.
        glass: further segments, on which beams get lost more often.
        kerbs: segments that neither people nor the robot cross, invisible to lasers.
        people_at: a point in each unconnected part of the world with people; default: the start of
            the route.
        leaves: doors.
        lanes: lanes of vehicles.
        things: movable objects. People and the robot keep clear of all their places.
        lights: where the robot stops while they are red.
        pavements: rectangles x0, y0, x1, y1, a kerb higher than the street, visible to lidars only.
        mirrors: further segments, which reflect most beams of a planar laser; walls in 3D.
    """

    name: str
    walls: tuple[Segment, ...]
    route: tuple[Point, ...]
    glass: tuple[Segment, ...] = ()
    kerbs: tuple[Segment, ...] = ()
    people_at: tuple[Point, ...] = ()
    leaves: tuple[Door, ...] = ()
    lanes: tuple[Lane, ...] = ()
    lights: tuple[Light, ...] = ()
    things: tuple[Thing, ...] = ()
    crowd: options.CrowdOptions = field(default_factory=options.CrowdOptions)
    doors: options.DoorOptions = field(default_factory=options.DoorOptions)
    traffic: options.TrafficOptions = field(default_factory=options.TrafficOptions)
    laser: options.LaserOptions = field(default_factory=options.LaserOptions)
    robot: options.RobotOptions = field(default_factory=options.RobotOptions)
    odometry: options.OdometryOptions = field(default_factory=options.OdometryOptions)
    lidar: options.LidarOptions = field(default_factory=options.LidarOptions)
    ground: options.GroundOptions = field(default_factory=options.GroundOptions)
    heights: options.HeightOptions = field(default_factory=options.HeightOptions)
    rig: options.RigOptions = field(default_factory=options.RigOptions)
    camera: options.CameraOptions = field(default_factory=options.CameraOptions)
    pavements: tuple[Segment, ...] = ()
    mirrors: tuple[Segment, ...] = ()

    def __post_init__(self) -> None:
        sweep_share = self.laser.sweep_time * self.robot.scan_rate
        is_usual = not self.laser.second_laser and self.laser.upside_down == "no"
        angle = abs(self.rig.middle) + self.rig.amplitude
        lowest, highest = self.lidar.field
        can_see = self.in_3d or not self.camera.enabled
        rules = {
            "a scene needs walls": len(self.walls) + len(self.glass) > 0,
            "a scene needs a route": len(self.route) > 0,
            "sweep_time must not exceed the scan period": sweep_share <= 1 + 1e-9,
            "a rig of two lasers has no lidar": not (self.rig.tilts and self.lidar.channels),
            "a rig has one upright horizontal laser": is_usual or not self.rig.tilts,
            "the laser must not tilt by more than 85 degrees": angle <= options.MAX_ELEVATION,
            "elevations must satisfy low <= high": lowest <= highest,
            "cameras need a 3D world: a lidar, or a tilting laser": can_see,
        }
        for section in (self.crowd, self.doors, self.traffic):
            for low in [name for name in vars(section) if name.startswith("min_")]:
                high = low.replace("min_", "max_")
                is_ordered = getattr(section, low) <= getattr(section, high)
                rules[f"{low} must not exceed {high}"] = is_ordered
        for rule, holds in rules.items():
            options.require(holds, rule)

    @property
    def in_3d(self) -> bool:
        """True if there is a lidar or a tilting laser."""
        return self.lidar.channels > 0 or self.rig.tilts

    @property
    def scan_rate(self) -> float:
        """Hz, scans per second of all sensors."""
        return self.lidar.rate if self.lidar.channels else self.robot.scan_rate * self.laser.count
