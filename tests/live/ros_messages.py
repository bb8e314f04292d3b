"""Objects with the fields of ROS messages, for tests without ROS."""

import array
import math
from types import SimpleNamespace as Fields

import numpy as np


def header(stamp_ns, frame=""):
    sec, nanosec = divmod(stamp_ns, 10**9)
    return Fields(stamp=Fields(sec=sec, nanosec=nanosec), frame_id=frame)


def laser_scan(stamp_ns, ranges, *, frame="laser", **fields):
    n = len(ranges)
    known = {
        "angle_min": -1.0,
        "angle_max": -1.0 + 0.1 * (n - 1),
        "angle_increment": 0.1,
        "time_increment": 0.0,
        "scan_time": 0.0,
        "range_min": 0.1,
        "range_max": 20.0,
        "intensities": array.array("f"),
    }
    return Fields(header=header(stamp_ns, frame), ranges=array.array("f", ranges), **known | fields)


def rotation(yaw=0.0, roll=0.0):
    c, s = math.cos(yaw / 2), math.sin(yaw / 2)
    a, b = math.cos(roll / 2), math.sin(roll / 2)
    return Fields(x=c * b, y=s * b, z=s * a, w=c * a)


def transform(parent, child, stamp_ns, x=0.0, y=0.0, yaw=0.0, roll=0.0):
    values = Fields(translation=Fields(x=x, y=y, z=0.0), rotation=rotation(yaw, roll))
    return Fields(header=header(stamp_ns, parent), child_frame_id=child, transform=values)


def odometry(stamp_ns, x=0.0, y=0.0, yaw=0.0, child="base_footprint"):
    pose = Fields(position=Fields(x=x, y=y, z=0.0), orientation=rotation(yaw))
    return Fields(header=header(stamp_ns, "odom"), child_frame_id=child, pose=Fields(pose=pose))


def point_cloud(stamp_ns, points, *, frame="lidar", times=None):
    """A PointCloud2 with fields x y z, and t (s after the stamp) where there are times."""
    names = ["x", "y", "z", *(["t"] if times is not None else [])]
    rows = np.asarray(points, np.float32)
    if times is not None:
        rows = np.column_stack([rows, np.asarray(times, np.float32)])
    data = rows.astype("<f4").tobytes()
    fields = [Fields(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate(names)]
    return Fields(
        header=header(stamp_ns, frame),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=4 * len(names),
        row_step=len(data),
        data=np.frombuffer(data, np.uint8),
    )
