"""The parameters of a 3D lidar and of what a world is like above and below its plan."""

import math
from dataclasses import dataclass
from typing import Literal

from stillmap.options import field_with_doc
from stillmap.simulation.options import require

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

    channels: int = field_with_doc(0, "beams above one another; 0: there is no lidar")
    columns: int = field_with_doc(1875, "azimuths per turn, at each of which all channels look")
    rate: float = field_with_doc(10.0, "Hz, turns per second")
    low: float | None = field_with_doc(
        None, "rad, elevation of the lowest channel; not set: as sensors of so many channels have"
    )
    high: float | None = field_with_doc(None, "rad, elevation of the highest channel; likewise")
    max_range: float = field_with_doc(100.0, "m, what lies farther off gives no return")
    range_noise: float = field_with_doc(0.02, "m, standard deviation of a range")
    no_return_share: float = field_with_doc(0.002, "share of beams that get lost anywhere")
    glass_no_return_share: float = field_with_doc(0.3, "share of beams that get lost on glass")
    # spelled out: ruff takes the default for mutable under an alias
    no_returns: Literal["kept", "left out"] = field_with_doc(
        "kept", "beams without return: kept, at the maximum range, or left out as drivers do"
    )
    sweep: bool = field_with_doc(
        True, "a turn takes its time, and everything moves meanwhile; false: all beams at once"
    )
    x: float = field_with_doc(0.0, "m, sensor ahead of the base centre")
    y: float = field_with_doc(0.0, "m, sensor to the left of the base centre")
    z: float = field_with_doc(1.8, "m, sensor above the floor on which the robot stands")
    yaw: float = field_with_doc(0.0, "rad, sensor against the base")
    pitch: float = field_with_doc(0.0, "rad, the same, nose down")
    vibration_roll: float = field_with_doc(0.0, "rad, standard deviation of the robot's roll")
    vibration_pitch: float = field_with_doc(0.0, "rad, the same of its pitch")
    vibration_z: float = field_with_doc(0.0, "m, the same of its height")
    sees_robot: bool = field_with_doc(False, "some beams meet the robot's own roof")
    roof_length: float | None = field_with_doc(
        None, "m, of that roof; not set: twice the robot's radius"
    )
    roof_width: float | None = field_with_doc(None, "m; not set: 0.8 of that")
    roof_below: float = field_with_doc(0.35, "m, from the sensor down to it")

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

    tilts: bool = field_with_doc(False, "there are two lasers, of which one tilts")
    low_z: float = field_with_doc(0.35, "m, the laser that lies flat, above the floor")
    pivot_x: float = field_with_doc(0.1, "m, the axis ahead of the base centre")
    pivot_z: float = field_with_doc(0.9, "m, the same above the floor")
    middle: float = field_with_doc(0.1, "rad, nose down, about which the laser tilts")
    amplitude: float = field_with_doc(0.7, "rad, how far it tilts to either side of that")
    period: float = field_with_doc(4.0, "s, for once up and down, at an even rate")

    def __post_init__(self) -> None:
        require(self.low_z > 0 and self.pivot_z > 0, "heights must be positive")
        require(self.amplitude >= 0 and self.period > 0, "amplitude >= 0 and period > 0")
        reach = abs(self.middle) + self.amplitude
        require(reach <= _STEEPEST, "the laser must not tilt by more than 85 degrees")


@dataclass(frozen=True)
class GroundOptions:
    """The ground: a plane or a paraboloid, with pavements above it."""

    slope_x: float = field_with_doc(0.0, "m per m, how much it rises to the east, at the origin")
    slope_y: float = field_with_doc(0.0, "m per m, the same to the north")
    bend_x: float = field_with_doc(0.0, "per m, what that slope grows by per metre to the east")
    bend_y: float = field_with_doc(0.0, "per m, the same to the north")
    kerb: float = field_with_doc(0.12, "m, pavements above the street")

    def __post_init__(self) -> None:
        steep = max(abs(self.slope_x), abs(self.slope_y))
        require(steep <= 0.3, "slopes must lie in [-0.3, 0.3]")
        require(max(abs(self.bend_x), abs(self.bend_y)) <= 0.01, "bends must lie in [-0.01, 0.01]")
        require(0 <= self.kerb <= 0.5, "kerb must lie in [0, 0.5]")


@dataclass(frozen=True)
class HeightOptions:
    """How high things stand."""

    ceiling: float | None = field_with_doc(2.8, "m; not set: the open sky")
    walls: float = field_with_doc(9.0, "m, of walls under the open sky; else up to the ceiling")
    doors: float = field_with_doc(2.05, "m, above it there is a lintel")
    furniture: float = field_with_doc(1.0, "m, of whatever stands about")
    panels: float = field_with_doc(2.0, "m, of furniture less than 0.2 m thick")

    def __post_init__(self) -> None:
        heights = (self.walls, self.doors, self.furniture, self.panels)
        require(min(heights) > 0, "heights must be positive")
        require(self.ceiling is None or self.ceiling > 0, "ceiling must be positive")

    @property
    def top(self) -> float:
        """m, of walls."""
        return self.walls if self.ceiling is None else self.ceiling
