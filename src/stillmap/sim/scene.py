"""What a simulated world consists of: data only, so that a new world is a new value."""

import itertools
import math
from dataclasses import dataclass, field
from typing import Literal

from stillmap.sim.options import (
    CameraOptions,
    CrowdOptions,
    DoorOptions,
    GroundOptions,
    HeightOptions,
    LaserOptions,
    LidarOptions,
    OdometryOptions,
    RigOptions,
    RobotOptions,
    TrafficOptions,
    require,
)

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
        """The leaf that points to `angle`."""
        x, y = self.hinge
        return (x, y, x + self.width * math.cos(angle), y + self.width * math.sin(angle))


@dataclass(frozen=True)
class Light:
    """A traffic light.

    Attributes:
        at: metres, where the first one stops: a point of the robot's route or of a lane.
        red: seconds from when to when it is red, for the first time.
        cycle: seconds until it is red again.
    """

    at: Point
    red: tuple[float, float]
    cycle: float

    def is_red(self, seconds: float) -> bool:
        """Whether it is red so many seconds after the recording began."""
        return (seconds - self.red[0]) % self.cycle < self.red[1] - self.red[0]


@dataclass(frozen=True)
class Lane:
    """Where vehicles drive: from the first point to the last, then from the first again.

    Attributes:
        path: points in metres. If it comes back to where it began the lane is a circuit; else its
            ends lie where the laser does not see a vehicle vanish and appear.
        kind: what drives there.
        waiting: vehicles that stand in a queue. A lane with a queue has no others.
        stop: metres along the path, where the first of the queue stands.
        go: metres, the queue drives on when the robot comes by here.
        lights: where vehicles stop while it is red.
    """

    path: tuple[Point, ...]
    kind: VehicleKind = "car"
    waiting: int = 0
    stop: float = 0.0
    go: Point = (0.0, 0.0)
    lights: tuple[Light, ...] = ()


@dataclass(frozen=True)
class Stay:
    """Where a thing stands, and from when to when.

    Attributes:
        x, y: metres, of its middle.
        yaw: rad.
        since: seconds after the recording began.
        until: the same; None: for good.
    """

    x: float
    y: float
    yaw: float = 0.0
    since: float = 0.0
    until: float | None = None

    def __post_init__(self) -> None:
        require(self.until is None or self.until > self.since, "a stay must end after it began")


@dataclass(frozen=True)
class Thing:
    """What stands still, but not for good: moved, brought or taken away while nobody looks.

    Attributes:
        faces: segments in metres, about its middle.
        stays: one after the other. Between them it is nowhere.
    """

    faces: tuple[Segment, ...]
    stays: tuple[Stay, ...]

    def __post_init__(self) -> None:
        require(len(self.faces) > 0 and len(self.stays) > 0, "a thing needs faces and stays")
        for one, other in itertools.pairwise(self.stays):
            require(
                one.until is not None and one.until <= other.since,
                "stays of a thing must come one after the other",
            )


@dataclass(frozen=True)
class Scene:
    """A world and what happens in it.

    Attributes:
        name: the world's name.
        walls: segments x0, y0, x1, y1 in metres: everything that stands still and is opaque.
        route: the robot's way, points in metres; the way between them is planned around walls.
        glass: further segments, on which beams get lost more often.
        kerbs: segments that neither people nor the robot cross and that no laser sees.
        people_at: a point in each part of the world where people walk about, if kerbs or walls
            part it; not given: where the robot starts.
        leaves: doors that swing.
        lanes: where vehicles drive.
        things: what is moved, brought or taken away. People and the robot keep clear of every
            place at which one ever stands.
        lights: where the robot stops while it is red.
        pavements: rectangles that only a lidar sees, a kerb higher than the street: their least
            and their greatest x and y, x0, y0, x1, y1.
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
    crowd: CrowdOptions = field(default_factory=CrowdOptions)
    doors: DoorOptions = field(default_factory=DoorOptions)
    traffic: TrafficOptions = field(default_factory=TrafficOptions)
    laser: LaserOptions = field(default_factory=LaserOptions)
    robot: RobotOptions = field(default_factory=RobotOptions)
    odometry: OdometryOptions = field(default_factory=OdometryOptions)
    lidar: LidarOptions = field(default_factory=LidarOptions)
    ground: GroundOptions = field(default_factory=GroundOptions)
    heights: HeightOptions = field(default_factory=HeightOptions)
    rig: RigOptions = field(default_factory=RigOptions)
    camera: CameraOptions = field(default_factory=CameraOptions)
    pavements: tuple[Segment, ...] = ()

    def __post_init__(self) -> None:
        require(len(self.walls) + len(self.glass) > 0, "a scene needs walls")
        require(len(self.route) > 0, "a scene needs a route")
        sweep_share = self.laser.sweep_time * self.robot.scan_rate
        require(sweep_share <= 1 + 1e-9, "sweep_time must not be longer than from scan to scan")
        if self.rig.tilts:
            require(not self.lidar.channels, "a rig of two lasers has no lidar")
            usual = not self.laser.second_laser and self.laser.upside_down == "no"
            require(usual, "a rig has one laser that lies flat, and upright")
        require(
            self.in_3d or not self.camera.enabled,
            "cameras want a world in 3D: a lidar, or a laser that tilts",
        )

    @property
    def in_3d(self) -> bool:
        """Whether a lidar takes the place of the laser, or another laser tilts."""
        return self.lidar.channels > 0 or self.rig.tilts

    @property
    def scan_rate(self) -> float:
        """Hz, scans per second of all sensors."""
        return self.lidar.rate if self.lidar.channels else self.robot.scan_rate * self.laser.count
