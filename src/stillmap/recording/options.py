"""How a recording's readings are understood."""

from dataclasses import dataclass
from typing import Literal

from stillmap.options import field_with_doc

BEYOND = 1000.0  # m: no laser in the plane sees so far; drivers write 1e10 or FLT_MAX for +inf


@dataclass(frozen=True)
class ReadOptions:
    """Options of `stillmap.recording.read`; None means: found in the recording."""

    min_range: float = field_with_doc(0.0, "m: nearer readings are unusable (the robot itself)")
    max_range: float | None = field_with_doc(
        None, "m: readings at or above it are maximum range; unset: found from the readings"
    )
    zero_means: Literal["auto", "unusable", "max-range"] = field_with_doc(
        "auto", "what a reading of zero stands for: auto, unusable or max-range"
    )
    free_range: float | None = field_with_doc(
        None, "m: how much free space a maximum-range beam shows; unset: what the laser really sees"
    )
    laser_x: float | None = field_with_doc(
        None, "m: first laser ahead of the robot's centre; unset: found in the recording"
    )
    laser_y: float | None = field_with_doc(
        None, "m: first laser left of the robot's centre; unset: found in the recording"
    )
    laser_theta: float | None = field_with_doc(
        None, "rad: first laser turned on the robot; unset: found in the recording"
    )

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_range < BEYOND:
            raise ValueError(f"min_range must lie in 0 to {BEYOND:g} m, got {self.min_range}")
        for name in ("max_range", "free_range"):
            value = getattr(self, name)
            if value is not None and not self.min_range < value <= BEYOND:
                raise ValueError(f"{name} must lie in min_range to {BEYOND:g} m, got {value}")
        for name in ("laser_x", "laser_y", "laser_theta"):
            value = getattr(self, name)
            if value is not None and not abs(value) < 1e3:
                raise ValueError(f"{name} must be a small finite number, got {value}")
