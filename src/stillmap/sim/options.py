"""The parameters of a simulation, each default once.

The parameters of the cameras that look on beside a lidar, or beside a laser that tilts.

The parameters of a 3D lidar and of what a world is like above and below its plan.
"""

import math
from dataclasses import dataclass
from typing import Literal

from stillmap.core.config import option

Shape = Literal["legs", "bodies", "mixed"]


@dataclass(frozen=True)
class CrowdOptions:
    """The people who walk about."""

    people: int = option(15, "how many people walk about")
    # spelled out: ruff takes the default for mutable under an alias
    shape: Literal["legs", "bodies", "mixed"] = option(
        "mixed", "what the laser sees of a person: legs, bodies, or one half of them each"
    )
    min_speed: float = option(0.4, "m/s, the slowest walker")
    max_speed: float = option(1.6, "m/s, the fastest walker")
    stopping_share: float = option(0.33, "share of the people who stop now and then")
    min_stop: float = option(2.0, "s, the shortest stop")
    max_stop: float = option(20.0, "s, the longest stop")

    def __post_init__(self) -> None:
        require(self.people >= 0, "people must not be negative")
        require(0 < self.min_speed <= self.max_speed, "speeds want 0 < min_speed <= max_speed")
        require(0 <= self.stopping_share <= 1, "stopping_share must lie in [0, 1]")
        require(0 <= self.min_stop <= self.max_stop, "stops want 0 <= min_stop <= max_stop")


@dataclass(frozen=True)
class DoorOptions:
    """How long doors stay as they are; durations are spread evenly in their logarithm."""

    min_open: float = option(4.0, "s, the shortest time that a door stays open")
    max_open: float = option(60.0, "s, the longest time that a door stays open")
    min_closed: float = option(5.0, "s, the shortest time that a door stays closed")
    max_closed: float = option(120.0, "s, the longest time that a door stays closed")
    swing: float = option(1.5, "s, from closed to open")

    def __post_init__(self) -> None:
        for low, high in ((self.min_open, self.max_open), (self.min_closed, self.max_closed)):
            require(0 < low <= high, "times of doors want 0 < min <= max")
        require(self.swing > 0, "swing must be positive")


@dataclass(frozen=True)
class TrafficOptions:
    """The vehicles that drive about on a scene's lanes; queues are part of the lanes."""

    vehicles: int = option(10, "how many drive about, spread over the lanes")
    min_speed: float = option(7.0, "m/s, the slowest driver")
    max_speed: float = option(12.0, "m/s, the fastest driver")
    van_share: float = option(0.25, "share of vans among the cars")
    stopping_share: float = option(0.2, "share of the vehicles that stop now and then")
    min_stop: float = option(3.0, "s, the shortest stop")
    max_stop: float = option(12.0, "s, the longest stop")

    def __post_init__(self) -> None:
        require(self.vehicles >= 0, "vehicles must not be negative")
        require(0 < self.min_speed <= self.max_speed, "speeds want 0 < min_speed <= max_speed")
        for share in (self.van_share, self.stopping_share):
            require(0 <= share <= 1, "shares of vehicles must lie in [0, 1]")
        require(0 <= self.min_stop <= self.max_stop, "stops want 0 <= min_stop <= max_stop")


@dataclass(frozen=True)
class LaserOptions:
    """The laser scanner and where it sits on the robot."""

    beams: int = option(180, "beams per scan")
    fov: float = option(math.pi, "rad, field of view, centred on the sensor's x axis")
    max_range: float = option(30.0, "m, what lies farther off gives no return")
    range_noise: float = option(0.02, "m, standard deviation of a range")
    no_return_share: float = option(0.002, "share of beams that get lost anywhere")
    glass_no_return_share: float = option(0.3, "share of beams that get lost on glass")
    sweep_time: float = option(
        0.0, "s, that it takes to look through its field of view; 0: all beams at once"
    )
    x: float = option(0.08, "m, sensor ahead of the base centre")
    y: float = option(0.0, "m, sensor to the left of the base centre")
    yaw: float = option(0.0, "rad, sensor against the base")
    # spelled out: see CrowdOptions.shape
    upside_down: Literal["no", "known", "unknown"] = option(
        "no", "it hangs upside down: no; known to the recorder; or unknown, which mirrors its scans"
    )
    second_laser: bool = option(
        False, "another one like it looks backwards from the other side of the base centre"
    )

    def __post_init__(self) -> None:
        require(self.beams >= 2, "beams must be at least 2")
        require(0 < self.fov <= 2 * math.pi + 1e-9, "fov must lie in (0, 2 pi]")
        require(self.max_range > 0, "max_range must be positive")
        require(self.sweep_time >= 0, "sweep_time must not be negative")
        require(self.range_noise >= 0, "range_noise must not be negative")
        for share in (self.no_return_share, self.glass_no_return_share):
            require(0 <= share <= 1, "shares of lost beams must lie in [0, 1]")

    @property
    def count(self) -> int:
        """How many lasers there are; they scan by turns."""
        return 2 if self.second_laser else 1


@dataclass(frozen=True)
class RobotOptions:
    """How the robot drives and how often it scans."""

    speed: float = option(0.5, "m/s, on a free way")
    acceleration: float | None = option(
        None, "m/s^2, at most, gaining speed, braking, and sideways in curves; not set: no limit"
    )
    turn_rate: float = option(0.8, "rad/s, the fastest turn")
    radius: float = option(0.22, "m, the robot's footprint is a disc")
    patience: float = option(3.0, "s, wait for somebody in the way before creeping on")
    scan_rate: float = option(5.0, "Hz, scans per second of each laser")
    scans: int | None = option(
        None, "scans to take, the route again and again; not set: the route once"
    )
    carried_at: float | None = option(
        None,
        "share of the recording at which the robot is switched off, carried to another place of "
        "its route and put down anyhow; not set: never",
    )
    pause_at: float | None = option(
        None, "s of scanning, after which the robot stands for a while; not set: never"
    )
    pause: float = option(28_800.0, "s, for which it then stands and records nothing: overnight")
    stamp_rounding: float = option(
        0.0, "s, stamps are rounded to multiples of it; 0: to the nanosecond"
    )
    stamps_missing: bool = option(False, "the scans' numbers stand for seconds")

    def __post_init__(self) -> None:
        require(self.speed > 0 and self.turn_rate > 0, "speed and turn_rate must be positive")
        require(self.acceleration is None or self.acceleration > 0, "acceleration must be positive")
        require(self.scan_rate > 0, "scan_rate must be positive")
        require(self.scans is None or self.scans >= 1, "scans must be at least 1")
        at = self.carried_at
        require(at is None or 0 < at < 1, "carried_at must lie between 0 and 1")
        at = self.pause_at
        require(at is None or at > 0, "pause_at must be positive")
        require(self.pause >= 0, "pause must not be negative")
        require(self.stamp_rounding >= 0, "stamp_rounding must not be negative")


@dataclass(frozen=True)
class OdometryOptions:
    """Errors of a differential drive's odometry; 0 everywhere gives perfect odometry."""

    wheel_radius_error: float = option(0.0005, "relative, standard deviation per wheel, drawn once")
    wheel_base_error: float = option(0.01, "relative, standard deviation, drawn once")
    wheel_base: float = option(0.4, "m, distance between the wheels")
    translation_noise: float = option(
        0.01, "m per sqrt(m) driven, standard deviation along the way"
    )
    rotation_noise: float = option(
        0.02, "rad per sqrt(rad) turned, standard deviation of the heading"
    )
    drift_noise: float = option(0.008, "rad per sqrt(m) driven, standard deviation of the heading")
    slip_rate: float = option(0.0, "per metre driven, how often a wheel begins to slip")
    slip: float = option(
        0.3, "relative, a slipping wheel turns farther by half to one and a half times this much"
    )
    slip_length: float = option(0.5, "m, the way on which it goes on slipping")
    stall_rate: float = option(
        0.0, "per minute, how often it begins to miss that the robot moves and turns"
    )
    stall_time: float = option(5.0, "s, for which it misses that")
    resets: int = option(0, "how often it begins again at its origin, at any time")

    def __post_init__(self) -> None:
        require(self.wheel_base > 0, "wheel_base must be positive")
        values: tuple[float, ...]
        values = (self.wheel_radius_error, self.wheel_base_error, self.translation_noise)
        values += (self.rotation_noise, self.drift_noise, self.slip_rate, self.slip)
        require(min(values) >= 0, "errors must be >= 0")
        require(self.slip_length > 0, "slip_length must be positive")
        require(self.stall_rate >= 0, "stall_rate must not be negative")
        require(self.stall_time > 0, "stall_time must be positive")
        require(self.resets >= 0, "resets must not be negative")


def require(condition: bool, message: str) -> None:
    """A ValueError that says what is wrong, unless `condition` holds."""
    if not condition:
        raise ValueError(message)


_WIDEST = math.radians(150.0)


@dataclass(frozen=True)
class CameraOptions:
    """Cameras on the robot, all alike; each takes a whole picture at once."""

    enabled: bool = option(False, "there are cameras")
    count: int = option(1, "how many, spread evenly over the directions; all at once")
    width: int = option(640, "pixels")
    height: int = option(480, "pixels")
    fov: float = option(1.4, "rad, from the left edge of a picture to the right one")
    rate: float = option(2.0, "Hz, pictures per second of each camera")
    x: float = option(0.1, "m, ahead of the base centre; ring: the circle on which they sit")
    y: float = option(0.0, "m, to the left of the base centre; likewise")
    z: float = option(1.2, "m, above the floor on which the robot stands")
    yaw: float = option(0.0, "rad, where the first camera looks, to the left of ahead")
    pitch: float = option(0.05, "rad, nose down")
    k1: float = option(0.0, "distortion of the lens as OpenCV has it (plumb_bob)")
    k2: float = option(0.0, "the same")
    p1: float = option(0.0, "the same")
    p2: float = option(0.0, "the same")
    noise: float = option(2.0, "of 255, standard deviation of each value of a pixel")
    exposure: float = option(
        0.0, "relative, standard deviation of how bright pictures are; 0: all alike"
    )
    antialias: int = option(1, "rays across and down each pixel")

    def __post_init__(self) -> None:
        require(1 <= self.count <= 16, "count must lie in [1, 16]")
        require(min(self.width, self.height) >= 2, "width and height must be at least 2")
        require(max(self.width, self.height) <= 8192, "width and height must be at most 8192")
        require(0 < self.fov <= _WIDEST, "fov must lie above 0, and be 150 degrees at most")
        require(self.rate > 0, "rate must be positive")
        require(self.z > 0, "z must be positive")
        require(abs(self.pitch) < math.pi / 2, "pitch must lie within 90 degrees")
        require(self.noise >= 0 and self.exposure >= 0, "deviations must not be negative")
        require(1 <= self.antialias <= 4, "antialias must lie in [1, 4]")
        # beyond, a lens bends rays back: several would meet one pixel
        require(max(abs(self.k1), abs(self.k2)) <= 0.4, "k1 and k2 must lie in [-0.4, 0.4]")
        require(max(abs(self.p1), abs(self.p2)) <= 0.05, "p1 and p2 must lie in [-0.05, 0.05]")

    @property
    def distortion(self) -> tuple[float, ...]:
        """The parameters of the lens, none where it is ideal."""
        values = (self.k1, self.k2, self.p1, self.p2)
        return (*values, 0.0) if any(values) else ()


# rad, elevations of the lowest and the highest channel of usual sensors, by their channels
_FIELDS = {
    16: (-15.0, 15.0),
    32: (-30.67, 10.67),
    64: (-24.8, 2.0),
    128: (-25.0, 15.0),
}

_STEEPEST = math.radians(85.0)


@dataclass(frozen=True)
class LidarOptions:
    """A spinning lidar and where it sits on the robot; it takes the place of the planar laser."""

    channels: int = option(0, "beams above one another; 0: there is no lidar")
    columns: int = option(1875, "azimuths per turn, at each of which all channels look")
    rate: float = option(10.0, "Hz, turns per second")
    low: float | None = option(
        None, "rad, elevation of the lowest channel; not set: as sensors of so many channels have"
    )
    high: float | None = option(None, "rad, elevation of the highest channel; likewise")
    max_range: float = option(100.0, "m, what lies farther off gives no return")
    range_noise: float = option(0.02, "m, standard deviation of a range")
    no_return_share: float = option(0.002, "share of beams that get lost anywhere")
    glass_no_return_share: float = option(0.3, "share of beams that get lost on glass")
    # spelled out: ruff takes the default for mutable under an alias
    no_returns: Literal["kept", "left out"] = option(
        "kept", "beams without return: kept, at the maximum range, or left out as drivers do"
    )
    sweep: bool = option(
        True, "a turn takes its time, and everything moves meanwhile; false: all beams at once"
    )
    x: float = option(0.0, "m, sensor ahead of the base centre")
    y: float = option(0.0, "m, sensor to the left of the base centre")
    z: float = option(1.8, "m, sensor above the floor on which the robot stands")
    yaw: float = option(0.0, "rad, sensor against the base")
    pitch: float = option(0.0, "rad, the same, nose down")
    vibration_roll: float = option(0.0, "rad, standard deviation of the robot's roll")
    vibration_pitch: float = option(0.0, "rad, the same of its pitch")
    vibration_z: float = option(0.0, "m, the same of its height")
    sees_robot: bool = option(False, "some beams meet the robot's own roof")
    roof_length: float | None = option(None, "m, of that roof; not set: twice the robot's radius")
    roof_width: float | None = option(None, "m; not set: 0.8 of that")
    roof_below: float = option(0.35, "m, from the sensor down to it")

    def __post_init__(self) -> None:
        require(self.channels >= 0, "channels must not be negative")
        require(self.columns >= 4, "columns must be at least 4")
        require(self.rate > 0, "rate must be positive")
        low, high = self.field
        require(
            -_STEEPEST <= low <= high <= _STEEPEST, "low and high: within 85 degrees, low first"
        )
        require(self.max_range > 0, "max_range must be positive")
        require(self.z > 0, "z must be positive")
        sizes = (self.roof_length, self.roof_width, self.roof_below)
        require(all(v is None or v > 0 for v in sizes), "roof_... must be positive")
        deviations = (self.range_noise, self.vibration_roll, self.vibration_pitch)
        require(min(*deviations, self.vibration_z) >= 0, "deviations must not be negative")
        for share in (self.no_return_share, self.glass_no_return_share):
            require(0 <= share <= 1, "shares of lost beams must lie in [0, 1]")

    @property
    def field(self) -> tuple[float, float]:
        """rad, elevations of the lowest and the highest channel."""
        low, high = map(math.radians, _FIELDS.get(self.channels, (-25.0, 15.0)))
        return (low if self.low is None else self.low, high if self.high is None else self.high)


@dataclass(frozen=True)
class RigOptions:
    """Two lasers like `laser`: one lies flat, the other tilts about an axis from left to right."""

    tilts: bool = option(False, "there are two lasers, of which one tilts")
    low_z: float = option(0.35, "m, the laser that lies flat, above the floor")
    pivot_x: float = option(0.1, "m, the axis ahead of the base centre")
    pivot_z: float = option(0.9, "m, the same above the floor")
    middle: float = option(0.1, "rad, nose down, about which the laser tilts")
    amplitude: float = option(0.7, "rad, how far it tilts to either side of that")
    period: float = option(4.0, "s, for once up and down, at an even rate")

    def __post_init__(self) -> None:
        require(self.low_z > 0 and self.pivot_z > 0, "heights must be positive")
        require(self.amplitude >= 0 and self.period > 0, "amplitude >= 0 and period > 0")
        reach = abs(self.middle) + self.amplitude
        require(reach <= _STEEPEST, "the laser must not tilt by more than 85 degrees")


@dataclass(frozen=True)
class GroundOptions:
    """The ground: a plane or a paraboloid, with pavements above it."""

    slope_x: float = option(0.0, "m per m, how much it rises to the east, at the origin")
    slope_y: float = option(0.0, "m per m, the same to the north")
    bend_x: float = option(0.0, "per m, what that slope grows by per metre to the east")
    bend_y: float = option(0.0, "per m, the same to the north")
    kerb: float = option(0.12, "m, pavements above the street")

    def __post_init__(self) -> None:
        steep = max(abs(self.slope_x), abs(self.slope_y))
        require(steep <= 0.3, "slopes must lie in [-0.3, 0.3]")
        require(max(abs(self.bend_x), abs(self.bend_y)) <= 0.01, "bends must lie in [-0.01, 0.01]")
        require(0 <= self.kerb <= 0.5, "kerb must lie in [0, 0.5]")


@dataclass(frozen=True)
class HeightOptions:
    """How high things stand."""

    ceiling: float | None = option(2.8, "m; not set: the open sky")
    walls: float = option(9.0, "m, of walls under the open sky; else up to the ceiling")
    doors: float = option(2.05, "m, above it there is a lintel")
    furniture: float = option(1.0, "m, of whatever stands about")
    panels: float = option(2.0, "m, of furniture less than 0.2 m thick")

    def __post_init__(self) -> None:
        heights = (self.walls, self.doors, self.furniture, self.panels)
        require(min(heights) > 0, "heights must be positive")
        require(self.ceiling is None or self.ceiling > 0, "ceiling must be positive")

    @property
    def top(self) -> float:
        """m, of walls."""
        return self.walls if self.ceiling is None else self.ceiling
