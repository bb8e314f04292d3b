"""Parameters of a scene: sensors, robot, odometry, people, doors, vehicles, ground and heights."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from stillmap.core.config import CheckedOptions, Count, option

Shape = Literal["legs", "bodies", "mixed"]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]

_TURN = 2 * math.pi + 1e-9
MAX_ELEVATION = math.radians(85.0)
Elevation = Annotated[float, Meta(ge=-MAX_ELEVATION, le=MAX_ELEVATION)]
_MAX_CAMERA_FOV = math.radians(150.0)

# degrees, elevations of the lowest and highest channel of common sensors, by number of channels
_ELEVATIONS = {16: (-15.0, 15.0), 32: (-30.67, 10.67), 64: (-24.8, 2.0), 128: (-25.0, 15.0)}


def require(condition: bool, message: str) -> None:
    """Raise ValueError(message) unless the condition holds."""
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True)
class CrowdOptions(CheckedOptions):
    """The people."""

    people: Count = option(15, "Number of people.", ge=0)
    shape: Shape = option("mixed", "Cross section at the laser: legs, bodies, or half each.")
    min_speed: Positive = option(0.4, "Minimum walking speed, m/s.")
    max_speed: Positive = option(1.6, "Maximum walking speed, m/s.")
    stopping_share: Share = option(0.33, "Share of people who stop at times.")
    min_stop: NotNegative = option(2.0, "Minimum duration of a stop, s.")
    max_stop: NotNegative = option(20.0, "Maximum duration of a stop, s.")


@dataclass(frozen=True)
class DoorOptions(CheckedOptions):
    """Durations of the states of doors, log-uniformly distributed."""

    min_open: Positive = option(4.0, "Minimum time a door stays open, s.")
    max_open: Positive = option(60.0, "Maximum time a door stays open, s.")
    min_closed: Positive = option(5.0, "Minimum time a door stays closed, s.")
    max_closed: Positive = option(120.0, "Maximum time a door stays closed, s.")
    swing: Positive = option(1.5, "Time from closed to open, s.")


@dataclass(frozen=True)
class TrafficOptions(CheckedOptions):
    """The vehicles on the lanes of a scene, besides queues."""

    vehicles: Count = option(10, "Number of vehicles, spread over the lanes.", ge=0)
    min_speed: Positive = option(7.0, "Minimum desired speed, m/s.")
    max_speed: Positive = option(12.0, "Maximum desired speed, m/s.")
    stopping_share: Share = option(0.2, "Share of vehicles that stop at times.")
    max_stop: float = option(12.0, "Maximum duration of a stop, s.", ge=3)


@dataclass(frozen=True)
class LaserOptions(CheckedOptions):
    """The planar laser scanner and its pose on the robot."""

    beams: Count = option(180, "Beams per scan.", ge=2)
    fov: float = option(math.pi, "Field of view about the sensor's x axis, rad.", gt=0, le=_TURN)
    max_range: Positive = option(30.0, "Maximum range, m; beyond there is no return.")
    range_noise: NotNegative = option(0.02, "Standard deviation of ranges, m.")
    no_return_share: Share = option(0.002, "Share of beams lost anywhere.")
    glass_no_return_share: Share = option(0.3, "Share of beams lost on glass.")
    mirror_return_share: Share = option(0.05, "Share of beams that mirrors return.")
    sweep_time: NotNegative = option(0.0, "Duration of a scan, s; 0: all beams at once.")
    x: float = option(0.08, "Sensor ahead of the base, m.")
    y: float = option(0.0, "Sensor to the left of the base, m.")
    yaw: float = option(0.0, "Yaw of the sensor on the base, rad.")
    upside_down: Literal["no", "known", "unknown"] = option(
        "no", "Mounted upside down; unknown: scans are mirrored."
    )
    second_laser: bool = option(False, "Add a laser that looks backwards.")
    recorded_x: float | None = option(None, "x as recorded, m; unset: the true one.")
    recorded_y: float | None = option(None, "y as recorded, m; unset: the true one.")
    recorded_yaw: float | None = option(None, "yaw as recorded, rad; unset: the true one.")
    height: Positive = option(0.3, "Height above the floor, m.")
    blind_stretches: Count = option(0, "Number of stretches without returns.", ge=0)
    blind_at: float | None = option(
        None, "Share of the recording when one more begins.", ge=0, lt=1
    )
    blind_time: Positive = option(30.0, "Duration of a stretch without returns, s.")

    @property
    def recorded_mount(self) -> tuple[float, ...]:
        """x, y, yaw as the recorder has them."""
        recorded = (self.recorded_x, self.recorded_y, self.recorded_yaw)
        true = (self.x, self.y, self.yaw)
        return tuple(b if a is None else a for a, b in zip(recorded, true, strict=True))

    @property
    def count(self) -> int:
        """Number of lasers; they scan alternately."""
        return 2 if self.second_laser else 1


@dataclass(frozen=True)
class RobotOptions(CheckedOptions):
    """Motion of the robot, scan rate, and mishaps."""

    speed: Positive = option(0.5, "Speed on a free way, m/s.")
    acceleration: Positive | None = option(None, "Of driving and turning, m/s^2; unset: any.")
    turn_rate: Positive = option(0.8, "Maximum turn rate, rad/s.")
    radius: float = option(0.22, "Radius of the circular footprint, m.")
    scan_rate: Positive = option(5.0, "Scans per second of each laser, Hz.")
    scans: Count | None = option(None, "Number of scans; unset: the route once.", ge=1)
    carried_at: float | None = option(
        None, "Share of the recording when it is carried elsewhere.", gt=0, lt=1
    )
    carried_by: float | None = option(None, "Distance along its route, m; unset: any far place.")
    carried_turn: float | None = option(None, "Heading against the route then, rad; unset: any.")
    carried_time: NotNegative = option(20.0, "Time without scans while it is carried, s.")
    bump_rate: NotNegative = option(0.0, "Bumps per metre driven, which tilt a planar laser.")
    bump_pitch: float = option(0.05, "Pitch of bumps, rad, times 0.5 to 1.5.", ge=0, le=0.5)
    bump_roll: float = option(0.0, "Standard deviation of their roll, rad.", ge=0, le=0.1)
    bump_time: Positive = option(0.6, "Duration of a bump, s, times 0.5 to 1.5.")
    pause_at: Positive | None = option(None, "Time of a pause, s; unset: never.")
    pause: NotNegative = option(28_800.0, "Duration of the pause without recording, s.")
    stamp_rounding: NotNegative = option(0.0, "Resolution of stamps, s; 0: nanoseconds.")


@dataclass(frozen=True)
class OdometryOptions(CheckedOptions):
    """Errors of differential-drive odometry; all 0: perfect odometry."""

    wheel_radius_error: NotNegative = option(0.0005, "Relative error of each wheel radius (sigma).")
    wheel_base_error: NotNegative = option(0.01, "Relative error of the wheel base (sigma).")
    wheel_base: Positive = option(0.4, "Distance between the wheels, m.")
    translation_noise: NotNegative = option(0.01, "Sigma of the distance, m per sqrt(m) driven.")
    rotation_noise: NotNegative = option(0.02, "Sigma of the heading, rad per sqrt(rad) turned.")
    drift_noise: NotNegative = option(0.008, "Sigma of the heading, rad per sqrt(m) driven.")
    slip_rate: NotNegative = option(0.0, "Wheel slips per metre driven.")
    slip: NotNegative = option(0.3, "Excess rotation of a slipping wheel, times 0.5 to 1.5.")
    slip_length: Positive = option(0.5, "Distance over which a wheel slips, m.")
    stall_rate: NotNegative = option(0.0, "Odometry stalls per minute: motion is missed.")
    stall_time: Positive = option(5.0, "Duration of a stall, s.")
    resets: Count = option(0, "Number of resets to the origin, at random times.", ge=0)
    scale: Positive = option(1.0, "Factor on all distances.")
    rotation_gain: Positive = option(1.0, "Factor on all rotations.")
    latency: NotNegative = option(0.0, "Age of odometry at its stamp, s.")


@dataclass(frozen=True)
class CameraOptions(CheckedOptions):
    """Identical cameras on the robot with a global shutter."""

    enabled: bool = option(False, "Add cameras.")
    count: Count = option(1, "Number of cameras, evenly spread in yaw.", ge=1, le=16)
    width: Count = option(640, "Image width, pixels.", ge=2, le=8192)
    height: Count = option(480, "Image height, pixels.", ge=2, le=8192)
    fov: float = option(1.4, "Horizontal field of view, rad.", gt=0, le=_MAX_CAMERA_FOV)
    rate: Positive = option(2.0, "Images per second of each camera, Hz.")
    x: float = option(0.1, "First camera ahead of the base, m; the others are rotated about it.")
    y: float = option(0.0, "First camera to the left of the base, m.")
    z: Positive = option(1.2, "Height above the floor, m.")
    yaw: float = option(0.0, "Yaw of the first camera, rad.")
    pitch: float = option(0.05, "Pitch, nose down, rad.", gt=-math.pi / 2, lt=math.pi / 2)
    noise: NotNegative = option(2.0, "Standard deviation of pixel values, of 255.")
    exposure: NotNegative = option(0.0, "Standard deviation of the relative exposure of images.")


@dataclass(frozen=True)
class LidarOptions(CheckedOptions):
    """A spinning lidar, which replaces the planar laser, and its pose on the robot."""

    channels: Count = option(0, "Number of channels; 0: no lidar.", ge=0)
    columns: Count = option(1875, "Azimuths per turn.", ge=4)
    rate: Positive = option(10.0, "Turns per second, Hz.")
    low: Elevation | None = option(None, "Elevation of the lowest channel, rad; unset: usual.")
    high: Elevation | None = option(None, "Elevation of the highest channel, rad; unset: usual.")
    max_range: Positive = option(100.0, "Maximum range, m; beyond there is no return.")
    range_noise: NotNegative = option(0.02, "Standard deviation of ranges, m.")
    no_return_share: Share = option(0.002, "Share of beams lost anywhere.")
    glass_no_return_share: Share = option(0.3, "Share of beams lost on glass.")
    no_returns: Literal["kept", "left out"] = option("kept", "Beams without return.")
    sweep: bool = option(True, "Beams of a turn are taken one after the other, else at once.")
    x: float = option(0.0, "Sensor ahead of the base, m.")
    y: float = option(0.0, "Sensor to the left of the base, m.")
    z: Positive = option(1.8, "Sensor above the floor, m.")
    yaw: float = option(0.0, "Yaw of the sensor on the base, rad.")
    pitch: float = option(0.0, "Pitch of the sensor on the base, nose down, rad.")
    vibration_roll: NotNegative = option(0.0, "Standard deviation of the robot's roll, rad.")
    vibration_pitch: NotNegative = option(0.0, "Standard deviation of the robot's pitch, rad.")
    vibration_z: NotNegative = option(0.0, "Standard deviation of the robot's height, m.")
    sees_robot: bool = option(False, "Some beams hit the roof of the robot itself.")
    roof_length: Positive | None = option(None, "Its length, m; unset: twice the robot's radius.")
    roof_width: Positive | None = option(None, "Width of the roof, m; unset: 0.8 of that.")
    roof_below: Positive = option(0.35, "Height of the sensor above the roof, m.")

    @property
    def field(self) -> tuple[float, float]:
        """rad, elevations of the lowest and highest channel."""
        low, high = map(math.radians, _ELEVATIONS.get(self.channels, (-25.0, 15.0)))
        return (low if self.low is None else self.low, high if self.high is None else self.high)


@dataclass(frozen=True)
class RigOptions(CheckedOptions):
    """Two lasers like `laser`: one horizontal, one tilting about the robot's y axis."""

    tilts: bool = option(False, "There are two lasers, one of which tilts.")
    low_z: Positive = option(0.35, "Horizontal laser above the floor, m.")
    pivot_x: float = option(0.1, "Tilt axis ahead of the base, m.")
    pivot_z: Positive = option(0.9, "Tilt axis above the floor, m.")
    middle: float = option(0.1, "Mean tilt, nose down, rad.")
    amplitude: NotNegative = option(0.7, "Tilt to either side of the mean, rad.")
    period: Positive = option(4.0, "Period of the tilting at constant rate, s.")


@dataclass(frozen=True)
class GroundOptions(CheckedOptions):
    """The ground: a plane, with pavements above it."""

    slope_x: float = option(0.0, "Slope to the east at the origin, m/m.", ge=-0.3, le=0.3)
    slope_y: float = option(0.0, "Slope to the north at the origin, m/m.", ge=-0.3, le=0.3)
    kerb: float = option(0.12, "Height of pavements above the street, m.", ge=0, le=0.5)


@dataclass(frozen=True)
class HeightOptions(CheckedOptions):
    """Heights of ceiling, walls, doors and furniture."""

    ceiling: Positive | None = option(2.8, "Height of the ceiling, m; unset: open sky.")
    walls: Positive = option(9.0, "Height of walls under the open sky, m.")
    doors: Positive = option(2.05, "Height of doors, m; above there is a lintel.")
    furniture: Positive = option(1.0, "Height of furniture, m.")

    @property
    def top(self) -> float:
        """m, height of walls."""
        return self.walls if self.ceiling is None else self.ceiling
