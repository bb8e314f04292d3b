"""The node's parameters; names and meanings are those of slam_toolbox and nav2."""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from stillmap.core.config import STRICT, declared_fields, option, override


def _to_tuple(values: Any) -> tuple[Any, ...]:
    """ROS gives lists; one name is plain."""
    return (values,) if isinstance(values, str | float | int) else tuple(values or ())


_Name = Annotated[str, Field(min_length=1)]
_Names = Annotated[tuple[_Name, ...], BeforeValidator(_to_tuple)]
_Numbers = Annotated[tuple[float, ...], BeforeValidator(_to_tuple)]


@dataclass(frozen=True, config=STRICT)
class Parameters:
    """ROS parameters of the node."""

    scan_topic: _Names = option(
        ("scan",), "LaserScan topics: one name, or several", min_length=1, validate_default=True
    )
    cloud_topic: _Names = option(
        (), "PointCloud2 topics: one name, or several; where there are any, scan_topic is not read"
    )
    odom_topic: str = option("odom", "Odometry topic, used where TF has no odometry")
    map_name: _Name = option("map", "topic of the map")
    map_frame: _Name = option("map", "frame of the map")
    odom_frame: str = option("odom", "frame of the odometry; empty: there is none")
    base_frame: _Name = option("base_footprint", "frame of the robot")
    laser_pose: _Numbers = option(
        (),
        "x, y, yaw (m, rad) of each laser on the robot; x, y, z, roll, pitch, yaw of each topic of "
        "clouds; empty: from /tf_static",
    )
    resolution: float = option(0.05, "m, edge of a map cell", gt=0)
    min_laser_range: float = option(0.0, "m, nearer readings are ignored", ge=0)
    max_laser_range: float = option(
        0.0, "m, farther readings count as free space up to here; 0: the laser's own maximum", ge=0
    )
    throttle_scans: int = option(1, "every how many scans of a topic one is used", ge=1)
    scan_queue_size: int = option(50, "scans that may wait", ge=1)
    map_update_interval: float = option(5.0, "s between two maps", gt=0)
    transform_publish_period: float = option(
        0.05, "s at least between two transforms from the map to the odometry; 0: never", ge=0
    )
    transform_timeout: float = option(
        0.2, "s that a scan waits for transforms and odometry, and that ours last", ge=0
    )
    tf_buffer_duration: float = option(30.0, "s that transforms are kept", gt=0)

    @model_validator(mode="after")
    def _check_laser_pose(self) -> "Parameters":
        n = len(self.topics) * (3 if self.dimension == 2 else 6)
        if len(self.laser_pose) not in (0, n):
            raise ValueError(f"'laser_pose' must be {n} numbers, got {self.laser_pose}")
        return self

    @property
    def dimension(self) -> int:
        """2: scans are planar; 3: they are clouds."""
        return 3 if self.cloud_topic else 2

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics of the scans."""
        return self.cloud_topic or self.scan_topic


def declare(declare_one: Callable[[str, Any, str], Any], **defaults: Any) -> Parameters:
    """Declare all parameters and read what was set.

    Args:
        declare_one: declares a name with a default and a meaning, and returns the value.
        defaults: other defaults than those of `Parameters`.

    Raises:
        InputError: a value is of the wrong type, or out of range.
    """
    fields, values = declared_fields(Parameters), {}
    for field in dataclasses.fields(Parameters):
        default = defaults.get(field.name, getattr(Parameters(), field.name))
        if isinstance(default, tuple):  # ROS knows lists; one name is plain
            default = default[0] if len(default) == 1 else list(default)
        meaning = fields[field.name].description
        values[field.name] = declare_one(field.name, default, meaning or "")
    return override(Parameters(), values, "parameters")
