"""Between PointCloud2 messages and our arrays."""

import array
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.io.ros.clouds import parse_cloud
from stillmap.io.ros.messages import stamp_ns
from stillmap.live.ros.conversions import fill_header, shape_of
from stillmap.live.scan import Scan, ScanBeams, to_beams

Float = NDArray[np.float64]

_FLOAT32 = 7  # of PointField
_NAMES = ("x", "y", "z", "p_static")


def to_cloud_beams(
    message: Any, topic: str, T_base_sensor: Float, min_range: float = 0.0, max_range: float = 0.0
) -> ScanBeams:
    """The beams of a PointCloud2, in its order.

    Args:
        message: a PointCloud2 with a layout, with x, y, z, and perhaps times of the points.
        topic: where it came from: each is a sensor of its own.
        T_base_sensor: (4, 4) of the lidar on the robot.
        min_range: m, nearer points are unusable.
        max_range: m, farther points count as free space up to here; 0: none do.
    """
    cloud = parse_cloud(message)
    if isinstance(cloud, str):
        raise TypeError(cloud)  # `find_layout` told
    points, hit = cloud.points, np.ones(len(cloud.points), np.bool_)
    if max_range > 0.0:
        length = np.linalg.norm(points, axis=1)
        hit = ~(length > max_range)  # what is no number stays what it is
        points = points.copy()
        with np.errstate(invalid="ignore"):  # infinite ones become NaN: unusable
            points[~hit] *= (max_range / length[~hit])[:, None]
    times = None
    if cloud.times is not None:
        times = np.where(np.isfinite(cloud.times), cloud.times, 0.0)  # of unusable points
    return to_beams(
        Scan(
            stamp_ns(message.header),
            points=points,
            hit=hit,
            sensor=topic,
            sensor_pose=T_base_sensor,
            beam_times=times,
            min_range=min_range,
        )
    )


def end_points(message: Any, beams: ScanBeams, chosen: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(n, 3) end points of the chosen beams (N,) of a scan in the frame of its message."""
    if beams.dimension == 3:
        return beams.points[chosen]
    ranges, angles = np.asarray(message.ranges, np.float64)[chosen], shape_of(message).angles()
    angles = angles[chosen]
    flat = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    return np.asarray(ranges[:, None] * flat, np.float32)


def fill_cloud(
    message: Any,
    source: Any,
    points: NDArray[np.float32],
    p_static: NDArray[np.float32],
    make_field: Callable[[], Any],
) -> None:
    """Set a PointCloud2 to points (N, 3) with P(static) (N,), with the header of another message;
    `make_field` makes a PointField."""
    fill_header(message.header, source.header.frame_id, stamp_ns(source.header))
    message.fields = []
    for k, name in enumerate(_NAMES):
        field = make_field()
        field.name, field.offset, field.datatype, field.count = name, 4 * k, _FLOAT32, 1
        message.fields.append(field)
    message.height, message.width = 1, len(points)
    message.is_bigendian, message.is_dense = False, True
    message.point_step, message.row_step = 16, 16 * len(points)
    rows = np.column_stack([points, p_static]).astype("<f4")
    message.data = array.array("B", rows.tobytes())
