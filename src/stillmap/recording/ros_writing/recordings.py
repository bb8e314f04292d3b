"""Recordings as ROS bags."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.recording import planar
from stillmap.recording.model import Recording
from stillmap.recording.ros.kinds import Kind
from stillmap.recording.ros_writing import messages
from stillmap.recording.ros_writing.bag import Bag, new_bag, require_stamps
from stillmap.recording.ros_writing.messages import BASE, ODOM

Scan = Callable[[int], Any]  # the message of a scan, by its number


def write(recording: Recording, path: Path, kind: Kind, *, overwrite: bool = False) -> list[str]:
    """Write a recording as a ROS bag: scans, odometry, and where the sensors sit.

    Scans in the plane become LaserScan on `/scan`, `/scan2`, ..., +inf where nothing came back
    (REP 117), clouds PointCloud2 on `/points`, ...; odometry becomes Odometry on `/odom` and
    transforms from odom to base_link at every scan. All stamps are the recording's.

    Returns:
        What could not be said, a sentence each.

    Raises:
        InputError: the bag cannot be written or cannot hold such a recording.
    """
    stamps = recording.stamp_ns
    if recording.n_scans:
        require_stamps(int(stamps[0]), int(stamps[-1]), kind)
    planar_scans = recording.dimension == 2
    lasers = Lasers(recording) if planar_scans else None
    with new_bag(path, kind, overwrite=overwrite) as bag:
        frames = place_sensors(bag, recording)
        name, type = ("scan", messages.SCAN) if planar_scans else ("points", messages.POINTS)
        sends = [bag.topic(f"/{numbered}", type) for numbered in numbered(name, len(frames))]
        drive = _driver(bag, recording)
        for t in recording.in_turn(range(recording.n_scans)):
            drive(t)
            stamp, sensor = int(stamps[t]), int(recording.sensor[t])
            if lasers is None:
                message = _cloud(bag, recording, t, frames[sensor])
            else:
                message = lasers.message(bag, t, frames[sensor], lasers.ranges(t))
            sends[sensor](stamp, message)
    return lasers.left_out() if lasers is not None else list(_cloud_losses(recording))


class Lasers:
    """The lasers of a recording in the plane, as LaserScan messages describe them.

    Raises:
        InputError: a scan has directions that such messages cannot state.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._fans = planar.fans(recording)
        self._range_max = [reach.limit() for reach in planar.reaches(recording)]
        self._time_increments, self._uneven = planar.time_increments(recording)

    def ranges(self, t: int) -> NDArray[np.float32]:
        """(n,) metres of a scan, +inf at maximum range, NaN where unusable."""
        return planar.ranges(self._recording, t, np.inf).astype(np.float32)

    def message(self, bag: Bag, t: int, frame: str, ranges: NDArray[np.float32]) -> Any:
        """A scan with these ranges (n,), see `messages.laser_scan`."""
        return messages.laser_scan(
            bag,
            int(self._recording.stamp_ns[t]),
            frame,
            ranges,
            (float(self._fans[t, 0]), float(self._fans[t, 1])),
            float(self._time_increments[t]),
            self._range_max[self._recording.sensor[t]],
        )

    def left_out(self) -> list[str]:
        """What the messages do not say, a sentence each."""
        if not self._uneven:
            return []
        return [
            f"when beams were taken is left out of {self._uneven} scans: LaserScan holds times "
            "that begin at the stamp and rise evenly"
        ]


def place_sensors(bag: Bag, recording: Recording) -> list[str]:
    """Says once where the sensors sit on the robot; returns their S frames."""
    S = len(recording.T_base_sensor)
    frames = numbered("laser" if recording.dimension == 2 else "lidar", S)
    send = bag.topic("/tf_static", messages.TRANSFORMS, latched=True)
    if recording.n_scans:
        first = int(recording.stamp_ns[0])
        placed = [(BASE, f, T) for f, T in zip(frames, recording.T_base_sensor, strict=True)]
        send(first, messages.transforms(bag, first, placed))
    return frames


def numbered(name: str, count: int) -> list[str]:
    return [name, *(f"{name}{k}" for k in range(2, count + 1))][:count]


def _driver(bag: Bag, recording: Recording) -> Callable[[int], None]:
    """A function that sends the odometry of a scan."""
    T_odom_base = recording.T_odom_base
    if T_odom_base is None:
        return lambda t: None  # noqa: ARG005
    send_tf = bag.topic("/tf", messages.TRANSFORMS)
    send_odometry = bag.topic("/odom", messages.ODOMETRY)

    def drive(t: int) -> None:
        stamp, T = int(recording.stamp_ns[t]), T_odom_base[t]
        if t and stamp == recording.stamp_ns[t - 1] and np.array_equal(T, T_odom_base[t - 1]):
            return  # two sensors at the same moment
        send_tf(stamp, messages.transforms(bag, stamp, [(ODOM, BASE, T)]))
        send_odometry(stamp, messages.odometry(bag, stamp, T))

    return drive


def _cloud(bag: Bag, recording: Recording, t: int, frame: str) -> Any:
    beams = recording.beams_of(t)
    # a point at maximum range would be taken for a thing
    points = np.where(recording.hit[beams, None], recording.points[beams], np.float32(np.nan))
    times = None if recording.beam_time is None else recording.beam_time[beams]
    return messages.point_cloud(bag, int(recording.stamp_ns[t]), frame, points, times)


def _cloud_losses(recording: Recording) -> Iterator[str]:
    free = 0
    for t in recording.in_turn(range(recording.n_scans)):
        beams = recording.beams_of(t)
        seen = recording.points[beams][~recording.hit[beams]]
        free += int(np.count_nonzero(~np.isnan(seen).any(axis=1)))
    if free:
        yield f"{free} beams at maximum range are no points: how far they went is left out"
