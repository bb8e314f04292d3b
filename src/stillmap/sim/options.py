"""Parameters of a scene: sensors, robot, odometry, people, doors, vehicles, ground and heights."""

import math
from typing import Literal, Self

from pydantic import model_validator
from pydantic.dataclasses import dataclass

from stillmap.core.config import STRICT, Count, option

Shape = Literal["legs", "bodies", "mixed"]

_TURN = 2 * math.pi + 1e-9
_MAX_ELEVATION = math.radians(85.0)
_MAX_CAMERA_FOV = math.radians(150.0)

# degrees, elevations of the lowest and highest channel of common sensors, by number of channels
_ELEVATIONS = {
    16: (-15.0, 15.0),
    32: (-30.67, 10.67),
    64: (-24.8, 2.0),
    128: (-25.0, 15.0),
}


def require(condition: bool, message: str) -> None:
    """Raise ValueError(message) unless the condition holds."""
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True, config=STRICT)
class CrowdOptions:
    """The people."""

    people: Count = option(15, "Number of people.", ge=0)
    # spelled out: ruff takes the default for mutable under an alias
    shape: Literal["legs", "bodies", "mixed"] = option(
        "mixed", "Cross section of people at the height of the laser: legs, bodies, or half each."
    )
    min_speed: float = option(0.4, "Minimum walking speed, m/s.", gt=0)
    max_speed: float = option(1.6, "Maximum walking speed, m/s.", gt=0)
    stopping_share: float = option(0.33, "Share of people who stop at times.", ge=0, le=1)
    min_stop: float = option(2.0, "Minimum duration of a stop, s.", ge=0)
    max_stop: float = option(20.0, "Maximum duration of a stop, s.", ge=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Refuses empty ranges."""
        require(self.min_speed <= self.max_speed, "speeds must satisfy min_speed <= max_speed")
        require(self.min_stop <= self.max_stop, "stops must satisfy min_stop <= max_stop")
        return self


@dataclass(frozen=True, config=STRICT)
class DoorOptions:
    """Durations of the states of doors, log-uniformly distributed."""

    min_open: float = option(4.0, "Minimum time a door stays open, s.", gt=0)
    max_open: float = option(60.0, "Maximum time a door stays open, s.", gt=0)
    min_closed: float = option(5.0, "Minimum time a door stays closed, s.", gt=0)
    max_closed: float = option(120.0, "Maximum time a door stays closed, s.", gt=0)
    swing: float = option(1.5, "Time from closed to open, s.", gt=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Refuses empty ranges."""
        for low, high in ((self.min_open, self.max_open), (self.min_closed, self.max_closed)):
            require(low <= high, "times of doors must satisfy min <= max")
        return self


@dataclass(frozen=True, config=STRICT)
class TrafficOptions:
    """The vehicles on the lanes of a scene, besides queues."""

    vehicles: Count = option(10, "Number of vehicles, spread over the lanes.", ge=0)
    min_speed: float = option(7.0, "Minimum desired speed, m/s.", gt=0)
    max_speed: float = option(12.0, "Maximum desired speed, m/s.", gt=0)
    stopping_share: float = option(0.2, "Share of vehicles that stop at times.", ge=0, le=1)
    max_stop: float = option(12.0, "Maximum duration of a stop, s.", ge=3)

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Refuses empty ranges."""
        require(self.min_speed <= self.max_speed, "speeds must satisfy min_speed <= max_speed")
        return self


@dataclass(frozen=True, config=STRICT)
class LaserOptions:
    """The planar laser scanner and its pose on the robot."""

    beams: Count = option(180, "Beams per scan.", ge=2)
    fov: float = option(math.pi, "Field of view about the sensor's x axis, rad.", gt=0, le=_TURN)
    max_range: float = option(30.0, "Maximum range, m; beyond there is no return.", gt=0)
    range_noise: float = option(0.02, "Standard deviation of ranges, m.", ge=0)
    no_return_share: float = option(0.002, "Share of beams lost anywhere.", ge=0, le=1)
    glass_no_return_share: float = option(0.3, "Share of beams lost on glass.", ge=0, le=1)
    mirror_return_share: float = option(
        0.05, "Share of beams that mirrors return instead of reflecting them.", ge=0, le=1
    )
    sweep_time: float = option(0.0, "Duration of a scan, s; 0: all beams at once.", ge=0)
    x: float = option(0.08, "Sensor ahead of the base, m.")
    y: float = option(0.0, "Sensor to the left of the base, m.")
    yaw: float = option(0.0, "Yaw of the sensor on the base, rad.")
    # spelled out: see CrowdOptions.shape
    upside_down: Literal["no", "known", "unknown"] = option(
        "no", "Mounted upside down: no; known to the recorder; or unknown, which mirrors its scans."
    )
    second_laser: bool = option(
        False, "Add a laser that looks backwards from the opposite side of the base."
    )
    recorded_x: float | None = option(None, "x as the recorder has it, m; unset: the true one.")
    recorded_y: float | None = option(None, "y as the recorder has it, m; unset: the true one.")
    recorded_yaw: float | None = option(
        None, "yaw as the recorder has it, rad; unset: the true one."
    )
    height: float = option(0.3, "Height above the floor, m.", gt=0)
    blind_stretches: Count = option(
        0, "Number of stretches without returns, at random times.", ge=0
    )
    blind_at: float | None = option(
        None, "Share of the recording at which one more such stretch begins.", ge=0, lt=1
    )
    blind_time: float = option(30.0, "Duration of a stretch without returns, s.", gt=0)

    @property
    def recorded_mount(self) -> tuple[float, float, float]:
        """x, y, yaw as the recorder has them."""
        told = (self.recorded_x, self.recorded_y, self.recorded_yaw)
        x, y, yaw = (
            true if value is None else value
            for value, true in zip(told, (self.x, self.y, self.yaw), strict=True)
        )
        return x, y, yaw

    @property
    def count(self) -> int:
        """Number of lasers; they scan alternately."""
        return 2 if self.second_laser else 1


@dataclass(frozen=True, config=STRICT)
class RobotOptions:
    """Motion of the robot, scan rate, and mishaps."""

    speed: float = option(0.5, "Speed on a free way, m/s.", gt=0)
    acceleration: float | None = option(
        None, "Maximum acceleration, longitudinal and lateral, m/s^2; unset: unlimited.", gt=0
    )
    turn_rate: float = option(0.8, "Maximum turn rate, rad/s.", gt=0)
    radius: float = option(0.22, "Radius of the circular footprint, m.")
    scan_rate: float = option(5.0, "Scans per second of each laser, Hz.", gt=0)
    scans: Count | None = option(
        None, "Number of scans, repeating the route; unset: the route once.", ge=1
    )
    carried_at: float | None = option(
        None,
        "Share of the recording at which the robot is switched off, carried to another place of "
        "its route and set down with any heading; unset: never.",
        gt=0,
        lt=1,
    )
    carried_by: float | None = option(
        None,
        "Distance along its route by which the robot is then carried, m; negative: back; unset: to "
        "any distant place.",
    )
    carried_turn: float | None = option(
        None, "Heading against the route where it is set down, rad; unset: any."
    )
    carried_time: float = option(20.0, "Time without scans while it is carried, s.", ge=0)
    bump_rate: float = option(0.0, "Bumps per metre driven, which tilt a planar laser.", ge=0)
    bump_pitch: float = option(
        0.05, "Pitch at the peak of a bump, up or down, rad, times 0.5 to 1.5.", ge=0, le=0.5
    )
    bump_roll: float = option(
        0.0, "Standard deviation of the roll at the peak of a bump, rad.", ge=0, le=0.1
    )
    bump_time: float = option(0.6, "Duration of a bump, s, times 0.5 to 1.5.", gt=0)
    pause_at: float | None = option(
        None, "Recording time at which the robot stops for a pause, s; unset: never.", gt=0
    )
    pause: float = option(28_800.0, "Duration of the pause without recording, s.", ge=0)
    stamp_rounding: float = option(
        0.0, "Stamps are rounded to multiples of this, s; 0: to nanoseconds.", ge=0
    )


@dataclass(frozen=True, config=STRICT)
class OdometryOptions:
    """Errors of differential-drive odometry; all 0: perfect odometry."""

    wheel_radius_error: float = option(
        0.0005, "Standard deviation of the relative error of each wheel radius.", ge=0
    )
    wheel_base_error: float = option(
        0.01, "Standard deviation of the relative error of the wheel base.", ge=0
    )
    wheel_base: float = option(0.4, "Distance between the wheels, m.", gt=0)
    translation_noise: float = option(
        0.01, "Standard deviation of the distance, m per sqrt(m) driven.", ge=0
    )
    rotation_noise: float = option(
        0.02, "Standard deviation of the heading, rad per sqrt(rad) turned.", ge=0
    )
    drift_noise: float = option(
        0.008, "Standard deviation of the heading, rad per sqrt(m) driven.", ge=0
    )
    slip_rate: float = option(0.0, "Wheel slips per metre driven.", ge=0)
    slip: float = option(
        0.3, "Relative excess rotation of a slipping wheel, times 0.5 to 1.5.", ge=0
    )
    slip_length: float = option(0.5, "Distance over which a wheel slips, m.", gt=0)
    stall_rate: float = option(0.0, "Odometry stalls per minute: motion is missed.", ge=0)
    stall_time: float = option(5.0, "Duration of a stall, s.", gt=0)
    resets: Count = option(0, "Number of resets to the origin, at random times.", ge=0)
    scale: float = option(1.0, "Factor on all distances.", gt=0)
    rotation_gain: float = option(1.0, "Factor on all rotations.", gt=0)
    latency: float = option(
        0.0, "Age of the odometry at the stamp that it is recorded with, s.", ge=0
    )


@dataclass(frozen=True, config=STRICT)
class CameraOptions:
    """Identical cameras on the robot with a global shutter."""

    enabled: bool = option(False, "Add cameras.")
    count: Count = option(1, "Number of cameras, evenly spread in yaw.", ge=1, le=16)
    width: Count = option(640, "Image width, pixels.", ge=2, le=8192)
    height: Count = option(480, "Image height, pixels.", ge=2, le=8192)
    fov: float = option(1.4, "Horizontal field of view, rad.", gt=0, le=_MAX_CAMERA_FOV)
    rate: float = option(2.0, "Images per second of each camera, Hz.", gt=0)
    x: float = option(0.1, "First camera ahead of the base, m; the others are rotated about it.")
    y: float = option(0.0, "First camera to the left of the base, m.")
    z: float = option(1.2, "Height above the floor, m.", gt=0)
    yaw: float = option(0.0, "Yaw of the first camera, rad.")
    pitch: float = option(0.05, "Pitch, nose down, rad.", gt=-math.pi / 2, lt=math.pi / 2)
    # beyond these limits a lens bends rays back: several would meet one pixel
    k1: float = option(0.0, "Distortion coefficient (plumb_bob).", ge=-0.4, le=0.4)
    k2: float = option(0.0, "Distortion coefficient.", ge=-0.4, le=0.4)
    p1: float = option(0.0, "Distortion coefficient.", ge=-0.05, le=0.05)
    p2: float = option(0.0, "Distortion coefficient.", ge=-0.05, le=0.05)
    noise: float = option(2.0, "Standard deviation of pixel values, of 255.", ge=0)
    exposure: float = option(0.0, "Standard deviation of the relative exposure of images.", ge=0)
    antialias: Count = option(1, "Rays per pixel in each direction.", ge=1, le=4)

    @property
    def distortion(self) -> tuple[float, ...]:
        """Distortion coefficients; empty for an ideal lens."""
        values = (self.k1, self.k2, self.p1, self.p2)
        return (*values, 0.0) if any(values) else ()


@dataclass(frozen=True, config=STRICT)
class LidarOptions:
    """A spinning lidar, which replaces the planar laser, and its pose on the robot."""

    channels: Count = option(0, "Number of channels; 0: no lidar.", ge=0)
    columns: Count = option(1875, "Azimuths per turn.", ge=4)
    rate: float = option(10.0, "Turns per second, Hz.", gt=0)
    low: float | None = option(
        None,
        "Elevation of the lowest channel, rad; unset: as of common sensors.",
        ge=-_MAX_ELEVATION,
        le=_MAX_ELEVATION,
    )
    high: float | None = option(
        None,
        "Elevation of the highest channel, rad; unset: as of common sensors.",
        ge=-_MAX_ELEVATION,
        le=_MAX_ELEVATION,
    )
    max_range: float = option(100.0, "Maximum range, m; beyond there is no return.", gt=0)
    range_noise: float = option(0.02, "Standard deviation of ranges, m.", ge=0)
    no_return_share: float = option(0.002, "Share of beams lost anywhere.", ge=0, le=1)
    glass_no_return_share: float = option(0.3, "Share of beams lost on glass.", ge=0, le=1)
    # spelled out: see CrowdOptions.shape
    no_returns: Literal["kept", "left out"] = option(
        "kept", "Beams without return: kept at the maximum range, or left out as drivers do."
    )
    sweep: bool = option(True, "Beams of a turn are taken one after the other, else at once.")
    x: float = option(0.0, "Sensor ahead of the base, m.")
    y: float = option(0.0, "Sensor to the left of the base, m.")
    z: float = option(1.8, "Sensor above the floor, m.", gt=0)
    yaw: float = option(0.0, "Yaw of the sensor on the base, rad.")
    pitch: float = option(0.0, "Pitch of the sensor on the base, nose down, rad.")
    vibration_roll: float = option(0.0, "Standard deviation of the robot's roll, rad.", ge=0)
    vibration_pitch: float = option(0.0, "Standard deviation of the robot's pitch, rad.", ge=0)
    vibration_z: float = option(0.0, "Standard deviation of the robot's height, m.", ge=0)
    sees_robot: bool = option(False, "Some beams hit the roof of the robot itself.")
    roof_length: float | None = option(
        None, "Length of that roof, m; unset: twice the robot's radius.", gt=0
    )
    roof_width: float | None = option(None, "Width of the roof, m; unset: 0.8 of that.", gt=0)
    roof_below: float = option(0.35, "Height of the sensor above the roof, m.", gt=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Refuses an empty field of view."""
        low, high = self.field
        require(low <= high, "elevations must satisfy low <= high")
        return self

    @property
    def field(self) -> tuple[float, float]:
        """rad, elevations of the lowest and highest channel."""
        low, high = map(math.radians, _ELEVATIONS.get(self.channels, (-25.0, 15.0)))
        return (low if self.low is None else self.low, high if self.high is None else self.high)


@dataclass(frozen=True, config=STRICT)
class RigOptions:
    """Two lasers like `laser`: one horizontal, one tilting about the robot's y axis."""

    tilts: bool = option(False, "There are two lasers, one of which tilts.")
    low_z: float = option(0.35, "Horizontal laser above the floor, m.", gt=0)
    pivot_x: float = option(0.1, "Tilt axis ahead of the base, m.")
    pivot_z: float = option(0.9, "Tilt axis above the floor, m.", gt=0)
    middle: float = option(0.1, "Mean tilt, nose down, rad.")
    amplitude: float = option(0.7, "Tilt to either side of the mean, rad.", ge=0)
    period: float = option(4.0, "Period of the tilting at constant rate, s.", gt=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Refuses too large angles."""
        angle = abs(self.middle) + self.amplitude
        require(angle <= _MAX_ELEVATION, "the laser must not tilt by more than 85 degrees")
        return self


@dataclass(frozen=True, config=STRICT)
class GroundOptions:
    """The ground: a plane or paraboloid, with pavements above it."""

    slope_x: float = option(0.0, "Slope to the east at the origin, m/m.", ge=-0.3, le=0.3)
    slope_y: float = option(0.0, "Slope to the north at the origin, m/m.", ge=-0.3, le=0.3)
    bend_x: float = option(0.0, "Change of the slope to the east, 1/m.", ge=-0.01, le=0.01)
    bend_y: float = option(0.0, "Change of the slope to the north, 1/m.", ge=-0.01, le=0.01)
    kerb: float = option(0.12, "Height of pavements above the street, m.", ge=0, le=0.5)


@dataclass(frozen=True, config=STRICT)
class HeightOptions:
    """Heights of ceiling, walls, doors and furniture."""

    ceiling: float | None = option(2.8, "Height of the ceiling, m; unset: open sky.", gt=0)
    walls: float = option(9.0, "Height of walls under the open sky, m.", gt=0)
    doors: float = option(2.05, "Height of doors, m; above there is a lintel.", gt=0)
    furniture: float = option(1.0, "Height of furniture, m.", gt=0)

    @property
    def top(self) -> float:
        """m, height of walls."""
        return self.walls if self.ceiling is None else self.ceiling
