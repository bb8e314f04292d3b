"""Between ROS messages and our arrays. Messages are any objects with their fields."""

import array
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.core.grid_map import GridMap
from stillmap.io.ros.lasers import ScanShape
from stillmap.io.ros.messages import frame_name, stamp_ns
from stillmap.live.scan import Scan as PushedScan
from stillmap.live.scan import ScanBeams, to_beams
from stillmap.pipeline.options import MapMode
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE
from stillmap.results.map_server import raw_pixels
from stillmap.results.reader import FREE_THRESH, OCCUPIED_THRESH

Float = NDArray[np.float64]

_MAX_SCAN_TIME = 1.0  # s: time increments that make scans longer are none
_NS = 10**9


class Mount(NamedTuple):
    """A laser or a lidar on the robot.

    Attributes:
        T_base_sensor: (3, 3), of a lidar (4, 4).
        is_upside_down: its angles change their sign.
    """

    T_base_sensor: Float
    is_upside_down: bool = False


def shape_of(message: Any) -> ScanShape:
    """The beams of a LaserScan; `find_fault` tells why they cannot be used."""
    return ScanShape(
        message.angle_min,
        message.angle_increment,
        len(message.ranges),
        message.range_min,
        message.range_max,
        message.time_increment,
    )


def to_scan_beams(
    message: Any, topic: str, mount: Mount, min_range: float = 0.0, max_range: float = 0.0
) -> ScanBeams:
    """The beams of a LaserScan, in its order.

    Args:
        message: a LaserScan without fault.
        topic: where it came from: each is a sensor of its own.
        mount: of the laser.
        min_range: m, nearer readings are unusable.
        max_range: m, farther readings count as free space up to here; 0: the laser's own maximum.
    """
    shape = shape_of(message)
    angles = shape.angles()
    times, duration = None, shape.time_increment * shape.n
    if 0.0 < duration <= _MAX_SCAN_TIME:
        times = shape.time_increment * np.arange(shape.n)
    nearest = shape.range_min if 0.0 < shape.range_min < MAX_PLAUSIBLE_RANGE else 0.0
    reach = [r for r in (shape.range_max, max_range) if 0.0 < r < MAX_PLAUSIBLE_RANGE]
    return to_beams(
        PushedScan(
            stamp_ns(message.header),
            np.asarray(message.ranges, np.float64),
            -angles if mount.is_upside_down else angles,
            sensor=topic,
            sensor_pose=mount.T_base_sensor,
            beam_times=times,
            min_range=max(nearest, min_range),
            max_range=min(reach, default=None),
        )
    )


def pose_values(pose: Any) -> tuple[float, ...]:
    """x y z and quaternion x y z w of a Pose."""
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def transform_values(transform: Any) -> tuple[float, ...]:
    """x y z and quaternion x y z w of a Transform."""
    t, q = transform.translation, transform.rotation
    return t.x, t.y, t.z, q.x, q.y, q.z, q.w


def fill_header(header: Any, frame: str, stamp: int) -> None:
    """Set frame and stamp (nanoseconds)."""
    header.frame_id = frame
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, _NS)


def fill_transform(message: Any, parent: str, child: str, stamp: int, T: Float) -> None:
    """Set a TransformStamped to a pose (D+1, D+1) T_parent_child."""
    fill_header(message.header, parent, stamp)
    message.child_frame_id = child
    _fill_position(message.transform.translation, T)
    _fill_rotation(message.transform.rotation, T)


def fill_pose(message: Any, frame: str, stamp: int, T: Float, covariance: Float) -> None:
    """Set a PoseWithCovarianceStamped to a pose (D+1, D+1), covariance (3, 3) or in 3D (6, 6)."""
    fill_header(message.header, frame, stamp)
    _fill_position(message.pose.pose.position, T)
    _fill_rotation(message.pose.pose.orientation, T)
    every = np.zeros((6, 6))
    rows = [0, 1, 5] if len(T) == 3 else list(range(6))  # x, y, yaw
    every[np.ix_(rows, rows)] = covariance
    message.pose.covariance = every.ravel()


def fill_grid(message: Any, frame: str, stamp: int, grid: GridMap, mode: MapMode) -> None:
    """Set an OccupancyGrid: 0 free, 100 occupied, -1 unknown; in mode raw per cent."""
    fill_header(message.header, frame, stamp)
    message.info.map_load_time.sec = message.header.stamp.sec
    message.info.map_load_time.nanosec = message.header.stamp.nanosec
    message.info.resolution = float(grid.resolution)
    message.info.height, message.info.width = grid.p_occupied.shape
    x, y, yaw = grid.origin
    p = message.info.origin.position
    p.x, p.y, p.z = float(x), float(y), 0.0
    _fill_rotation(message.info.origin.orientation, se2.matrix(x, y, yaw))
    # rclpy takes an array of this kind without a look at each element
    message.data = array.array("b", to_cells(grid.p_occupied, mode).tobytes())


def to_cells(p_occupied: NDArray[np.float32], mode: MapMode) -> NDArray[np.int8]:
    """(H, W) cells of an OccupancyGrid.

    nav2 takes all between 0 and 100 for free unless it is told otherwise, hence the modes.
    """
    if mode == "trinary":
        cells = np.full(p_occupied.shape, -1, np.int8)
        cells[p_occupied > OCCUPIED_THRESH] = 100
        cells[p_occupied < FREE_THRESH] = 0
        return cells
    return raw_pixels(p_occupied).view(np.int8)  # 255 is -1


def split_ranges(
    ranges: NDArray[np.float32], hit: NDArray[np.bool_], p_static: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The ranges (N,) of what stands and of what moves.

    What moves is +inf among what stands, where readings that met nothing stay as they are. Only
    beams that ended on movers are finite among what moves.
    """
    is_dynamic = hit & (p_static < 0.5)
    none = np.float32(math.inf)
    return np.where(is_dynamic, none, ranges), np.where(is_dynamic, ranges, none)


def copy_scan(message: Any, source: Any, ranges: NDArray[np.float32]) -> None:
    """Set a LaserScan to another one, with other ranges."""
    fill_header(message.header, source.header.frame_id, stamp_ns(source.header))
    for name in (
        "angle_min",
        "angle_max",
        "angle_increment",
        "time_increment",
        "scan_time",
        "range_min",
        "range_max",
        "intensities",
    ):
        setattr(message, name, getattr(source, name))
    message.ranges = array.array("f", ranges.astype(np.float32).tobytes())


def fill_status(
    status: Any, name: str, level: bytes, text: str, values: dict[str, str], key_value: Any
) -> None:
    """Set a DiagnosticStatus; `key_value` makes one of its entries."""
    status.name, status.level, status.message, status.hardware_id = name, level, text, ""
    entries = []
    for key, value in values.items():
        entry = key_value()
        entry.key, entry.value = key, value
        entries.append(entry)
    status.values = entries


def scan_frame(message: Any) -> str:
    """The frame of a message."""
    return frame_name(message.header.frame_id)


def _fill_position(p: Any, T: Float) -> None:
    p.x, p.y, p.z = float(T[0, -1]), float(T[1, -1]), float(T[2, 3]) if len(T) == 4 else 0.0


def _fill_rotation(q: Any, T: Float) -> None:
    if len(T) == 4:
        q.x, q.y, q.z, q.w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        return
    half = 0.5 * math.atan2(T[1, 0], T[0, 0])
    q.x, q.y, q.z, q.w = 0.0, 0.0, math.sin(half), math.cos(half)
