"""The content of ROS messages, as fields by name: what is left out is zero."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float, Float32, Int64
from stillmap.core.recording import Recording
from stillmap.io import laser_scan
from stillmap.io.trajectory import pose_rows

Fields = dict[str, Any]  # of a message: missing ones are zero, those it does not have left out

BASE, ODOM, MAP = "base_link", "odom", "map"

_FLOAT32 = 7  # of sensor_msgs/PointField


def make_header(stamp_ns: int, frame: str) -> Fields:
    """The header of a message."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def make_point_cloud(stamp_ns: int, frame: str, vertices: NDArray[np.void]) -> Fields:
    """A PointCloud2 of vertices (n,), whose fields are 4 bytes each; x, y and z in metres.

    All are called FLOAT32, as PCL does with the packed colour of `rgb`, 0x00RRGGBB.
    """
    names = vertices.dtype.names or ()
    step = vertices.dtype.itemsize
    if step != 4 * len(names):
        raise ValueError(f"vertices: {vertices.dtype} has other fields than of 4 bytes")
    return {
        "header": make_header(stamp_ns, frame),
        "height": 1,
        "width": len(vertices),
        "fields": [
            {"name": name, "offset": 4 * k, "datatype": _FLOAT32, "count": 1}
            for k, name in enumerate(names)
        ],
        "point_step": step,
        "row_step": step * len(vertices),
        "data": np.ascontiguousarray(vertices).view(np.uint8).ravel(),
        "is_dense": all(bool(np.isfinite(vertices[axis]).all()) for axis in "xyz"),
    }


def make_transforms(stamp_ns: int, poses: list[tuple[str, str, Float]]) -> Fields:
    """A TFMessage of transforms (parent, child, T_parent_child (D+1, D+1))."""
    transforms = [
        {
            "header": make_header(stamp_ns, parent),
            "child_frame_id": child,
            "transform": make_pose(T, "translation", "rotation"),
        }
        for parent, child, T in poses
    ]
    return {"transforms": transforms}


def make_odometry(stamp_ns: int, T_odom_base: Float) -> Fields:
    """An Odometry message with the pose alone: velocities and covariances are 0."""
    header, pose = make_header(stamp_ns, ODOM), {"pose": make_pose(T_odom_base)}
    return {"header": header, "child_frame_id": BASE, "pose": pose}


def make_path(stamp_ns: Int64, poses: Float) -> Fields:
    """A Path in the map frame along T_map_base (T, D+1, D+1)."""
    stamped = [
        {"header": make_header(stamp, MAP), "pose": make_pose(T)}
        for stamp, T in zip(stamp_ns.tolist(), poses, strict=True)
    ]
    return {"header": stamped[0]["header"], "poses": stamped}


def make_occupancy_grid(
    stamp_ns: int, p_occupied: NDArray[np.floating[Any]], T_map_corner: Float, resolution: float
) -> Fields:
    """An OccupancyGrid in percent, -1 where p_occupied (H, W) is NaN; row 0 is the lowest y.

    T_map_corner (3, 3) is the pose of its lower-left corner, resolution in metres.
    """
    header, (height, width) = make_header(stamp_ns, MAP), p_occupied.shape
    info = {
        "map_load_time": header["stamp"],
        "resolution": resolution,
        "width": width,
        "height": height,
        "origin": make_pose(T_map_corner),
    }
    percent = np.nan_to_num(np.rint(100.0 * p_occupied), nan=-1.0)
    return {"header": header, "info": info, "data": percent.astype(np.int8).ravel()}


def make_pose(T: Float, position: str = "position", orientation: str = "orientation") -> Fields:
    """A Pose of T (D+1, D+1), or what names its two parts otherwise; its quaternion has w >= 0."""
    row = pose_rows(T[None])[0].tolist()
    return {
        position: dict(zip("xyz", row[:3], strict=True)),
        orientation: dict(zip("xyzw", row[3:], strict=True)),
    }


class LaserScanEncoder:
    """Encodes the scans of a 2D recording as LaserScan messages.

    Raises:
        InputError: the beam directions of a scan are not evenly spaced.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._angles = laser_scan.beam_angles(recording)
        self._range_max = [limits.max_range() for limits in laser_scan.range_limits(recording)]
        self._time_increments, self._n_uneven = laser_scan.time_increments(recording)

    def ranges(self, t: int) -> Float32:
        """(n,) metres of a scan, +inf at maximum range, NaN where unusable."""
        return laser_scan.beam_ranges(self._recording, t, np.inf).astype(np.float32)

    def make_message(self, t: int, frame: str, ranges: Float32) -> Fields:
        """The message of scan t with ranges (n,)."""
        start, step = self._angles[t].tolist()
        return {
            "header": make_header(int(self._recording.stamp_ns[t]), frame),
            "angle_min": start,
            "angle_max": start + step * max(len(ranges) - 1, 0),
            "angle_increment": step,
            "time_increment": float(self._time_increments[t]),
            "range_max": self._range_max[self._recording.sensor[t]],
            "ranges": ranges,
        }

    def describe_losses(self) -> list[str]:
        """Lists the parts of a recording that ROS messages cannot hold, one sentence each."""
        what = f"beam times of {self._n_uneven} scans are left out: LaserScan holds times that "
        return [f"{what}begin at the stamp and rise evenly"] if self._n_uneven else []


def make_cloud(recording: Recording, t: int, frame: str) -> Fields:
    """A PointCloud2 with field `t`, in seconds after the stamp, where beams have times."""
    beams, times = recording.beams_of(t), recording.beam_time
    names = "xyz" if times is None else "xyzt"
    vertices = np.empty(beams.stop - beams.start, [(name, "<f4") for name in names])
    # readers would take a point at maximum range for a return
    points = np.where(recording.hit[beams, None], recording.points[beams], np.float32(np.nan))
    vertices["x"], vertices["y"], vertices["z"] = points.T
    if times is not None:
        vertices["t"] = times[beams]
    return make_point_cloud(int(recording.stamp_ns[t]), frame, vertices)
