"""Writes recordings as ROS bags."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.io.ros import message_writer
from stillmap.io.ros.bag_types import BagKind
from stillmap.io.ros.bag_writer import BagWriter, new_bag, require_stamps
from stillmap.io.ros.message_writer import BASE, ODOM
from stillmap.io.ros.messages import (
    LASER_SCAN,
    ODOMETRY,
    POINT_CLOUD,
    TF,
)
from stillmap.prepare import laser_scan


def write_recording(
    recording: Recording, path: Path, kind: BagKind, *, overwrite: bool = False
) -> list[str]:
    """Write a recording as a ROS bag: scans, odometry, and the sensors' extrinsics.

    2D scans become LaserScan on `/scan`, `/scan2`, ..., with +inf for no return (REP 117), 3D
    scans PointCloud2 on `/points`, ...; odometry becomes Odometry on `/odom` and transforms from
    odom to base_link at every scan. All stamps are the recording's.

    Returns:
        What could not be written, a sentence each.

    Raises:
        InputError: the bag cannot be written or cannot hold such a recording.
    """
    stamps = recording.stamp_ns
    if recording.n_scans:
        require_stamps(int(stamps[0]), int(stamps[-1]), kind)
    lasers = LaserScanEncoder(recording) if recording.dimension == 2 else None
    with new_bag(path, kind, overwrite=overwrite) as bag:
        frames = write_sensor_frames(bag, recording)
        topic, type = ("scan", LASER_SCAN) if lasers is not None else ("points", POINT_CLOUD)
        sends = [bag.add_topic(f"/{name}", type) for name in number_names(topic, len(frames))]
        send_odometry = _odometry_sender(bag, recording)
        for t in recording.iter_scans(range(recording.n_scans)):
            send_odometry(t)
            sensor = int(recording.sensor[t])
            if lasers is None:
                message = _make_cloud(bag, recording, t, frames[sensor])
            else:
                message = lasers.make_message(bag, t, frames[sensor], lasers.ranges(t))
            sends[sensor](int(stamps[t]), message)
    return lasers.describe_losses() if lasers is not None else _describe_cloud_losses(recording)


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

    def ranges(self, t: int) -> NDArray[np.float32]:
        """(n,) metres of a scan, +inf at maximum range, NaN where unusable."""
        return laser_scan.beam_ranges(self._recording, t, np.inf).astype(np.float32)

    def make_message(self, bag: BagWriter, t: int, frame: str, ranges: NDArray[np.float32]) -> Any:
        """The message of scan t with ranges (n,)."""
        start, step = self._angles[t].tolist()
        return bag.make(
            LASER_SCAN,
            header=bag.header(int(self._recording.stamp_ns[t]), frame),
            angle_min=start,
            angle_max=start + step * max(len(ranges) - 1, 0),
            angle_increment=step,
            time_increment=float(self._time_increments[t]),
            scan_time=0.0,
            range_min=0.0,
            range_max=self._range_max[self._recording.sensor[t]],
            ranges=ranges,
            intensities=np.empty(0, np.float32),
        )

    def describe_losses(self) -> list[str]:
        """Lists the parts of a recording that ROS messages cannot hold, one sentence each."""
        if not self._n_uneven:
            return []
        return [
            f"beam times of {self._n_uneven} scans are left out: LaserScan holds times that begin "
            "at the stamp and rise evenly"
        ]


def write_sensor_frames(
    bag: BagWriter,
    recording: Recording,
    more: Sequence[tuple[str, str, NDArray[np.float64]]] = (),
) -> list[str]:
    """Write the sensors' extrinsics to /tf_static, and more transforms (parent, child, T); returns
    their S frames."""
    S = len(recording.T_base_sensor)
    frames = number_names("laser" if recording.dimension == 2 else "lidar", S)
    send = bag.add_topic("/tf_static", TF, latched=True)
    if recording.n_scans:
        first = int(recording.stamp_ns[0])
        poses = [(BASE, f, T) for f, T in zip(frames, recording.T_base_sensor, strict=True)]
        send(first, message_writer.make_transforms(bag, first, [*poses, *more]))
    return frames


def number_names(name: str, count: int) -> list[str]:
    """`name`, `name2`, `name3`, ..."""
    return [name, *(f"{name}{k}" for k in range(2, count + 1))][:count]


def _odometry_sender(bag: BagWriter, recording: Recording) -> Callable[[int], None]:
    """A function that writes the odometry of a scan."""
    T_odom_base = recording.T_odom_base
    if T_odom_base is None:
        return lambda t: None  # noqa: ARG005
    send_tf = bag.add_topic("/tf", TF)
    send_odometry = bag.add_topic("/odom", ODOMETRY)

    def send(t: int) -> None:
        stamp, T = int(recording.stamp_ns[t]), T_odom_base[t]
        if t and stamp == recording.stamp_ns[t - 1] and np.array_equal(T, T_odom_base[t - 1]):
            return  # two sensors at the same time
        send_tf(stamp, message_writer.make_transforms(bag, stamp, [(ODOM, BASE, T)]))
        send_odometry(stamp, message_writer.make_odometry(bag, stamp, T))

    return send


def _make_cloud(bag: BagWriter, recording: Recording, t: int, frame: str) -> Any:
    """A PointCloud2 with field `t`, in seconds after the stamp, where beams have times."""
    beams, times = recording.beams_of(t), recording.beam_time
    vertices = np.empty(
        beams.stop - beams.start, [(name, "<f4") for name in ("xyz" if times is None else "xyzt")]
    )
    # readers would take a point at maximum range for a return
    points = np.where(recording.hit[beams, None], recording.points[beams], np.float32(np.nan))
    vertices["x"], vertices["y"], vertices["z"] = points.T
    if times is not None:
        vertices["t"] = times[beams]
    return message_writer.make_point_cloud(bag, int(recording.stamp_ns[t]), frame, vertices)


def _describe_cloud_losses(recording: Recording) -> list[str]:
    n_free = 0
    for t in recording.iter_scans(range(recording.n_scans)):
        beams = recording.beams_of(t)
        points = recording.points[beams][~recording.hit[beams]]
        n_free += int(np.count_nonzero(~np.isnan(points).any(axis=1)))
    if not n_free:
        return []
    return [f"{n_free} beams at maximum range are left out: they have no points"]
