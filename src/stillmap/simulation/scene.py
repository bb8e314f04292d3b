"""What a simulated world consists of: data only, so that a new world is a new value."""

import math
from dataclasses import dataclass, field
from typing import Literal

from stillmap.options import field_with_doc

Point = tuple[float, float]
Segment = tuple[float, float, float, float]
Shape = Literal["legs", "bodies", "mixed"]


@dataclass(frozen=True)
class CrowdOptions:
    """The people who walk about."""

    people: int = field_with_doc(15, "how many people walk about")
    # spelled out: ruff takes the default for mutable under an alias
    shape: Literal["legs", "bodies", "mixed"] = field_with_doc(
        "mixed", "what the laser sees of a person: legs, bodies, or one half of them each"
    )
    min_speed: float = field_with_doc(0.4, "m/s, the slowest walker")
    max_speed: float = field_with_doc(1.6, "m/s, the fastest walker")
    stopping_share: float = field_with_doc(0.33, "share of the people who stop now and then")
    min_stop: float = field_with_doc(2.0, "s, the shortest stop")
    max_stop: float = field_with_doc(20.0, "s, the longest stop")

    def __post_init__(self) -> None:
        _require(self.people >= 0, "people must not be negative")
        _require(0 < self.min_speed <= self.max_speed, "speeds want 0 < min_speed <= max_speed")
        _require(0 <= self.stopping_share <= 1, "stopping_share must lie in [0, 1]")
        _require(0 <= self.min_stop <= self.max_stop, "stops want 0 <= min_stop <= max_stop")


@dataclass(frozen=True)
class LaserOptions:
    """The laser scanner and where it sits on the robot."""

    beams: int = field_with_doc(180, "beams per scan")
    fov: float = field_with_doc(math.pi, "rad, field of view, centred on the sensor's x axis")
    max_range: float = field_with_doc(30.0, "m, what lies farther off gives no return")
    range_noise: float = field_with_doc(0.02, "m, standard deviation of a range")
    no_return_share: float = field_with_doc(0.002, "share of beams that get lost anywhere")
    glass_no_return_share: float = field_with_doc(0.3, "share of beams that get lost on glass")
    x: float = field_with_doc(0.08, "m, sensor ahead of the base centre")
    y: float = field_with_doc(0.0, "m, sensor to the left of the base centre")
    yaw: float = field_with_doc(0.0, "rad, sensor against the base")

    def __post_init__(self) -> None:
        _require(self.beams >= 2, "beams must be at least 2")
        _require(0 < self.fov <= 2 * math.pi + 1e-9, "fov must lie in (0, 2 pi]")
        _require(self.max_range > 0, "max_range must be positive")
        _require(self.range_noise >= 0, "range_noise must not be negative")
        for share in (self.no_return_share, self.glass_no_return_share):
            _require(0 <= share <= 1, "shares of lost beams must lie in [0, 1]")


@dataclass(frozen=True)
class RobotOptions:
    """How the robot drives and how often it scans."""

    speed: float = field_with_doc(0.5, "m/s, on a free way")
    turn_rate: float = field_with_doc(0.8, "rad/s, the fastest turn")
    radius: float = field_with_doc(0.22, "m, the robot's footprint is a disc")
    patience: float = field_with_doc(3.0, "s, wait for somebody in the way before creeping on")
    scan_rate: float = field_with_doc(5.0, "Hz, scans per second")
    scans: int | None = field_with_doc(
        None, "scans to take, the route again and again; not set: the route once"
    )

    def __post_init__(self) -> None:
        _require(self.speed > 0 and self.turn_rate > 0, "speed and turn_rate must be positive")
        _require(self.scan_rate > 0, "scan_rate must be positive")
        _require(self.scans is None or self.scans >= 1, "scans must be at least 1")


@dataclass(frozen=True)
class OdometryOptions:
    """Errors of a differential drive's odometry; 0 everywhere gives perfect odometry."""

    wheel_radius_error: float = field_with_doc(
        0.0005, "relative, standard deviation per wheel, drawn once"
    )
    wheel_base_error: float = field_with_doc(0.01, "relative, standard deviation, drawn once")
    wheel_base: float = field_with_doc(0.4, "m, distance between the wheels")
    translation_noise: float = field_with_doc(
        0.01, "m per sqrt(m) driven, standard deviation along the way"
    )
    rotation_noise: float = field_with_doc(
        0.02, "rad per sqrt(rad) turned, standard deviation of the heading"
    )
    drift_noise: float = field_with_doc(
        0.008, "rad per sqrt(m) driven, standard deviation of the heading"
    )

    def __post_init__(self) -> None:
        _require(self.wheel_base > 0, "wheel_base must be positive")
        values = (self.wheel_radius_error, self.wheel_base_error, self.translation_noise)
        _require(min(*values, self.rotation_noise, self.drift_noise) >= 0, "errors must be >= 0")


@dataclass(frozen=True)
class Scene:
    """A world and what happens in it.

    Attributes:
        name: the world's name.
        walls: segments x0, y0, x1, y1 in metres: everything that stands still and is opaque.
        route: the robot's way, points in metres; the way between them is planned around walls.
        glass: further segments, on which beams get lost more often.
    """

    name: str
    walls: tuple[Segment, ...]
    route: tuple[Point, ...]
    glass: tuple[Segment, ...] = ()
    crowd: CrowdOptions = field(default_factory=CrowdOptions)
    laser: LaserOptions = field(default_factory=LaserOptions)
    robot: RobotOptions = field(default_factory=RobotOptions)
    odometry: OdometryOptions = field(default_factory=OdometryOptions)

    def __post_init__(self) -> None:
        _require(len(self.walls) + len(self.glass) > 0, "a scene needs walls")
        _require(len(self.route) > 0, "a scene needs a route")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)
