"""ROS parameters and messages as types of stillmap, and arrays for messages; imports no ROS.

Names and meanings of parameters are those of slam_toolbox and nav2.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.config import CheckedOptions, declared_options, option, override
from stillmap.io.ros.clouds import parse_cloud
from stillmap.io.ros.lasers import ScanShape
from stillmap.io.ros.messages import stamp_ns
from stillmap.live.scan import Scan, ScanBeams, to_beams
from stillmap.pipeline.options import MapMode
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE
from stillmap.results.map_server import raw_pixels
from stillmap.results.reader import FREE_THRESH, OCCUPIED_THRESH

_MAX_SCAN_TIME = 1.0  # s: time increments that make scans longer are none


def _to_tuple(values: Any) -> tuple[Any, ...]:
    """ROS gives lists; one name is plain."""
    return (values,) if isinstance(values, str | float | int) else tuple(values or ())


_Name = Annotated[str, Meta(min_length=1)]
_Number = Annotated[float, Meta(ge=-1e9, le=1e9)]


@dataclass(frozen=True)
class Parameters(CheckedOptions):
    """ROS parameters of the node."""

    scan_topic: tuple[_Name, ...] = option(
        ("scan",), "LaserScan topics: one name, or several", min_length=1
    )
    cloud_topic: tuple[_Name, ...] = option(
        (), "PointCloud2 topics: one name, or several; where there are any, scan_topic is not read"
    )
    odom_topic: str = option("odom", "Odometry topic, used where TF has no odometry")
    map_name: _Name = option("map", "topic of the map")
    map_frame: _Name = option("map", "frame of the map")
    odom_frame: str = option("odom", "frame of the odometry; empty: there is none")
    base_frame: _Name = option("base_footprint", "frame of the robot")
    laser_pose: tuple[_Number, ...] = option(
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

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.topics) * (3 if self.dimension == 2 else 6)
        if len(self.laser_pose) not in (0, n):
            raise ValueError(f"'laser_pose' must be {n} numbers, got {self.laser_pose}")

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
    values = {}
    for name, declared in declared_options(Parameters).items():
        default = defaults.get(name, declared.default)
        if isinstance(default, tuple):  # ROS knows lists; one name is plain
            default = default[0] if len(default) == 1 else list(default)
        value = declare_one(name, default, declared.doc)
        is_tuple = isinstance(declared.default, tuple)
        values[name] = _to_tuple(value) if is_tuple else value
    return override(Parameters(), values, "parameters")


class Mount(NamedTuple):
    """A laser or a lidar on the robot.

    Attributes:
        T_base_sensor: (3, 3), of a lidar (4, 4).
        is_upside_down: its angles change their sign.
    """

    T_base_sensor: Float
    is_upside_down: bool = False


def to_scan_beams(message: Any, topic: str, mount: Mount, parameters: Parameters) -> ScanBeams:
    """The beams of a LaserScan or PointCloud2 without fault, in its order.

    Args:
        message: a PointCloud2 may have times of the points.
        topic: where it came from: each is a sensor of its own.
        mount: of the sensor.
        parameters: limits of the ranges.
    """
    fields = _cloud_fields(message) if parameters.dimension == 3 else _laser_fields(message, mount)
    fields["min_range"] = max(fields.get("min_range", 0.0), parameters.min_laser_range)
    limits = fields.get("max_range"), parameters.max_laser_range
    fields["max_range"] = min((limit for limit in limits if limit), default=None)
    pose = mount.T_base_sensor
    return to_beams(Scan(stamp_ns(message.header), sensor=topic, sensor_pose=pose, **fields))


def _laser_fields(message: Any, mount: Mount) -> dict[str, Any]:
    """Fields of a `Scan` from a LaserScan."""
    shape = ScanShape.of(message, len(message.ranges))
    angles, times = shape.angles(), shape.time_increment * np.arange(shape.n)
    has_times = 0.0 < shape.time_increment * shape.n <= _MAX_SCAN_TIME
    limits = {"min_range": shape.range_min, "max_range": shape.range_max}
    return {
        "ranges": np.asarray(message.ranges, np.float64),
        "angles": -angles if mount.is_upside_down else angles,
        "beam_times": times if has_times else None,
        **{name: m for name, m in limits.items() if 0.0 < m < MAX_PLAUSIBLE_RANGE},
    }


def _cloud_fields(message: Any) -> dict[str, Any]:
    """Fields of a `Scan` from a PointCloud2."""
    cloud = parse_cloud(message)
    if isinstance(cloud, str):
        raise TypeError(cloud)  # `find_layout` has said so
    times = cloud.times
    if times is not None:
        times = np.where(np.isfinite(times), times, 0.0)  # of unusable points
    return {"points": cloud.points, "beam_times": times}


def spread_covariance(covariance: Float) -> Float:
    """(36,) of a covariance (3, 3) of x, y and yaw, or (6, 6)."""
    out = np.zeros((6, 6))
    rows = [0, 1, 5] if len(covariance) == 3 else list(range(6))
    out[np.ix_(rows, rows)] = covariance
    return out.ravel()


def to_cells(p_occupied: Float32, mode: MapMode) -> NDArray[np.int8]:
    """(H, W) cells of an OccupancyGrid: 0 free, 100 occupied, -1 unknown; in mode raw per cent.

    nav2 takes all between 0 and 100 for free unless it is told otherwise, hence the modes.
    """
    if mode == "trinary":
        cells = np.full(p_occupied.shape, -1, np.int8)
        cells[p_occupied > OCCUPIED_THRESH] = 100
        cells[p_occupied < FREE_THRESH] = 0
        return cells
    return raw_pixels(p_occupied).view(np.int8)  # 255 is -1


def split_ranges(ranges: Float32, hit: Bool, p_static: Float32) -> tuple[Float32, Float32]:
    """The ranges (N,) of what is static and of what is dynamic.

    Dynamic beams are +inf among the static ones, where readings that met nothing stay as they are.
    Only beams that ended on movers are finite among the dynamic ones.
    """
    is_dynamic = hit & (p_static < 0.5)
    none = np.float32(math.inf)
    return np.where(is_dynamic, none, ranges), np.where(is_dynamic, ranges, none)


def end_points(message: Any, beams: ScanBeams, chosen: Bool) -> Float32:
    """(n, 3) end points of the chosen beams (N,) of a scan in the frame of its message."""
    if beams.dimension == 3:
        return beams.points[chosen]
    ranges = np.asarray(message.ranges, np.float64)[chosen]
    angles = ScanShape.of(message, len(message.ranges)).angles()[chosen]
    flat = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    return np.asarray(ranges[:, None] * flat, np.float32)
