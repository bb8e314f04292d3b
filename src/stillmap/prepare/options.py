"""Options of reading: the meaning of ranges, laser poses, cameras, and topics of a bag."""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from stillmap.core.config import CheckedOptions, option
from stillmap.core.errors import InputError

# m: beyond the reach of any 2D laser; drivers write 1e10 or FLT_MAX for +inf
MAX_PLAUSIBLE_RANGE = 1000.0

MAX_POINT_DISTANCE = 1e5  # m: beyond the reach of any sensor; damaged files hold such numbers

MAX_TIME = 9e9  # s: int64 holds 9.22e9 s in nanoseconds

_RANGE: dict[str, float] = {"gt": 0.0, "le": MAX_PLAUSIBLE_RANGE}
_FOV: dict[str, float] = {"gt": 0.0, "lt": 2.0 * math.pi + 1e-6}
_TIME: dict[str, float] = {"ge": 0.0, "le": MAX_TIME}
_UNSET, _FOUND = "unset: taken from the recording.", "unset: found in the transforms."


def _coordinate(doc: str) -> Any:
    """An option of a laser's pose, in m or rad."""
    return option(None, f"{doc}; {_UNSET}", gt=-1e3, lt=1e3)


class LaserOptions(NamedTuple):
    """Pose (m, rad), orientation and field of view (rad) of one laser; None: from the recording."""

    x: float | None = None
    y: float | None = None
    theta: float | None = None
    upside_down: bool | None = None
    fov: float | None = None

    @property
    def pose(self) -> tuple[float | None, float | None, float | None]:
        """x, y and theta on the robot."""
        return self.x, self.y, self.theta


@dataclass(frozen=True)
class ReadOptions(CheckedOptions):
    """Options of `stillmap.read`."""

    min_range: float = option(
        0.0, "Ignore shorter ranges, in metres (returns from the robot itself).", ge=0.0, lt=1e3
    )
    max_range: float | None = option(
        None,
        "Treat ranges from this on, in metres, as maximum-range beams; unset: detected (5 m for "
        "depth images).",
        **_RANGE,
    )
    zero_means: Literal["auto", "unusable", "max-range"] = option(
        "auto", "Meaning of a zero range: detected, an unusable beam, or a maximum-range beam."
    )
    free_range: float | None = option(
        None,
        "Free space that a maximum-range beam clears, in metres; unset: as far as the laser sees.",
        **_RANGE,
    )
    self_filter: bool = option(
        True, "Remove returns from the robot itself: those at one place wherever the robot is."
    )
    spin: Literal["auto", "none", "clockwise", "counter-clockwise"] = option(
        "auto",
        "Direction, seen from above, in which a spinning lidar without per-point times turns; "
        "none: all points share the stamp; auto: clockwise for raw KITTI drives, else estimated "
        "from the sweeps while mapping.",
    )
    laser_x: float | None = _coordinate("First laser ahead of the robot's centre, in metres")
    laser_y: float | None = _coordinate("First laser left of the robot's centre, in metres")
    laser_theta: float | None = _coordinate("Yaw of the first laser on the robot, in radians")
    laser_upside_down: bool | None = option(None, f"The first laser hangs upside down; {_UNSET}")
    laser_fov: float | None = option(
        None,
        "Field of view of the first laser, rad, for CARMEN lines without angles; unset: pi.",
        **_FOV,
    )
    laser2_x: float | None = _coordinate("Second laser ahead of the robot's centre, in metres")
    laser2_y: float | None = _coordinate("Second laser left of the robot's centre, in metres")
    laser2_theta: float | None = _coordinate("Yaw of the second laser on the robot, in radians")
    laser2_upside_down: bool | None = option(None, f"The second laser hangs upside down; {_UNSET}")
    laser2_fov: float | None = option(None, "Field of view of the second laser, rad.", **_FOV)
    start: float | None = option(
        None,
        "Leave out scans before this time, in seconds from the first scan; from 1e8 on a stamp in "
        "seconds; unset: none.",
        **_TIME,
    )
    end: float | None = option(None, "Leave out scans after this time, likewise.", **_TIME)
    cameras: str | None = option(
        None, "TOML file with camera calibrations that the recording lacks, and further images."
    )
    depth_step: int = option(2, "Use every n-th row and column of depth images.", ge=1, le=64)
    depth_scale: float | None = option(
        None, "Depth image units per metre; unset: 1000, or 5000 for TUM RGB-D.", ge=1e-3, le=1e6
    )
    topic: str | None = option(
        None, "Scan topics of a bag, separated by commas; unset: chosen by type and rate."
    )
    tilting_topic: str | None = option(
        None, "Scan topic of a tilting laser in a bag, used for the 3D cloud only."
    )
    base_frame: str | None = option(None, f"Base frame of the robot in a bag; {_FOUND}")
    odom_frame: str | None = option(None, f"Odometry frame in a bag; {_FOUND}")

    def __post_init__(self) -> None:
        """Checks that ranges lie above `min_range` and that names are not blank."""
        super().__post_init__()
        for name in ("max_range", "free_range"):
            value = getattr(self, name)
            if value is not None and not value > self.min_range:
                raise ValueError(
                    f"'read.{name}' must be more than read.min_range = {self.min_range:g}, "
                    f"got {value!r}"
                )
        for name in ("topic", "tilting_topic", "base_frame", "odom_frame", "cameras"):
            value = getattr(self, name)
            if value is not None and (not value.strip() or "\0" in value):
                raise ValueError(f"'read.{name}' must not be blank, and hold no NUL")

    def laser(self, number: int) -> LaserOptions:
        """Options of a laser, counted from 0; all unset from the third one on."""
        if number > 1:
            return LaserOptions()
        prefix = ("laser", "laser2")[number]
        return LaserOptions(*(getattr(self, f"{prefix}_{name}") for name in LaserOptions._fields))

    def check_laser_count(self, count: int) -> None:
        """Reject options of a second laser where the recording has fewer than two.

        Raises:
            InputError: `count` is below 2 and a `laser2_...` option is set.
        """
        if count < 2 and self.laser(1) != LaserOptions():
            raise InputError("laser2_... options are set, but the recording has one laser")
