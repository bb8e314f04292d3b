"""The node's parameters; names and meanings are those of slam_toolbox and nav2."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

from stillmap.core.errors import InputError


def _parameter(default: Any, meaning: str) -> Any:
    return field(default=default, metadata={"meaning": meaning})


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the node.

    Raises:
        InputError: a value is of the wrong type, or out of range.
    """

    scan_topic: tuple[str, ...] = _parameter(("scan",), "LaserScan topics: one name, or several")
    cloud_topic: tuple[str, ...] = _parameter(
        (), "PointCloud2 topics: one name, or several; where there are any, scan_topic is not read"
    )
    odom_topic: str = _parameter("odom", "Odometry topic, used where TF has no odometry")
    map_name: str = _parameter("map", "topic of the map")
    map_frame: str = _parameter("map", "frame of the map")
    odom_frame: str = _parameter("odom", "frame of the odometry; empty: there is none")
    base_frame: str = _parameter("base_footprint", "frame of the robot")
    laser_pose: tuple[float, ...] = _parameter(
        (),
        "x, y, yaw (m, rad) of each laser on the robot; x, y, z, roll, pitch, yaw of each topic of "
        "clouds; empty: from /tf_static",
    )
    resolution: float = _parameter(0.05, "m, edge of a map cell")
    min_laser_range: float = _parameter(0.0, "m, nearer readings are ignored")
    max_laser_range: float = _parameter(
        0.0, "m, farther readings count as free space up to here; 0: the laser's own maximum"
    )
    throttle_scans: int = _parameter(1, "every how many scans of a topic one is used")
    scan_queue_size: int = _parameter(50, "scans that may wait")
    map_update_interval: float = _parameter(5.0, "s between two maps")
    transform_publish_period: float = _parameter(
        0.05, "s at least between two transforms from the map to the odometry; 0: never"
    )
    transform_timeout: float = _parameter(
        0.2, "s that a scan waits for transforms and odometry, and that ours last"
    )
    tf_buffer_duration: float = _parameter(30.0, "s that transforms are kept")

    def __post_init__(self) -> None:
        for one in fields(self):
            object.__setattr__(self, one.name, _convert(one.name, one.default, self._raw(one.name)))
        for name in ("resolution", "map_update_interval", "tf_buffer_duration"):
            _require(self._raw(name) > 0.0, name, "more than 0", self._raw(name))
        for name in (
            "min_laser_range",
            "max_laser_range",
            "transform_publish_period",
            "transform_timeout",
        ):
            _require(self._raw(name) >= 0.0, name, "0 or more", self._raw(name))
        for name in ("throttle_scans", "scan_queue_size"):
            _require(self._raw(name) >= 1, name, "1 or more", self._raw(name))
        for name in ("map_frame", "base_frame", "map_name"):
            _require(bool(self._raw(name)), name, "a name", self._raw(name))
        names = self.scan_topic
        _require(bool(names) and all(names), "scan_topic", "at least one name", names)
        _require(all(self.cloud_topic), "cloud_topic", "names", self.cloud_topic)
        n = len(self.topics) * (3 if self.dimension == 2 else 6)
        _require(len(self.laser_pose) in (0, n), "laser_pose", f"{n} numbers", self.laser_pose)

    @property
    def dimension(self) -> int:
        """2: scans are planar; 3: they are clouds."""
        return 3 if self.cloud_topic else 2

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics of the scans."""
        return self.cloud_topic or self.scan_topic

    def _raw(self, name: str) -> Any:
        return getattr(self, name)


def declare(declare_one: Callable[[str, Any, str], Any], **defaults: Any) -> Parameters:
    """Declare all parameters and read what was set.

    Args:
        declare_one: declares a name with a default and a meaning, and returns the value.
        defaults: other defaults than those of `Parameters`.

    Raises:
        InputError: a value is of the wrong type, or out of range.
    """
    values = {}
    for one in fields(Parameters):
        default = defaults.get(one.name, one.default)
        if isinstance(default, tuple):  # ROS knows lists; one name is plain
            default = default[0] if len(default) == 1 else list(default)
        values[one.name] = declare_one(one.name, default, one.metadata["meaning"])
    return Parameters(**values)


def _convert(name: str, default: Any, value: Any) -> Any:
    """A value of the type of the default; whole numbers do for floats, one value for several."""
    if isinstance(default, tuple):
        kind: Any = str if name.endswith("_topic") else float
        several = [value] if isinstance(value, str | float | int) else list(value or ())
        return tuple(_convert(name, kind(), one) for one in several)
    if isinstance(default, float):
        is_number = isinstance(value, float | int) and not isinstance(value, bool)
        _require(is_number and math.isfinite(value), name, "a number", value)
        return float(value)
    wanted = "a whole number" if isinstance(default, int) else "text"
    _require(type(value) is type(default), name, wanted, value)
    return value


def _require(holds: bool, name: str, expected: str, value: object) -> None:
    if not holds:
        raise InputError(f"parameter {name}: expected {expected}, got {value!r}")
