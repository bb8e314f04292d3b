"""Recordings as ROS bags.

A bag once more, with beams blanked: as if nothing had come back.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.ros import bag_writer as writing
from stillmap.io.ros import message_writer
from stillmap.io.ros.bag import open_bag
from stillmap.io.ros.bag_types import (
    ZSTD_MAGIC,
    Bag,
    BagKind,
    Channel,
    DamagedBagError,
    Message,
    detect_kind,
)
from stillmap.io.ros.bag_writer import BagWriter, new_bag, require_stamps
from stillmap.io.ros.limits import decompress_zstd
from stillmap.io.ros.message_writer import BASE, ODOM
from stillmap.io.ros.messages import LASER_SCAN, MULTI_ECHO, POINT_CLOUD, decode, frame_name
from stillmap.io.ros.reader import list_scan_messages
from stillmap.preprocessing import laser_scan
from stillmap.preprocessing.options import ReadOptions

Scan = Callable[[int], Any]  # the message of a scan, by its number


def write_recording(
    recording: Recording, path: Path, kind: BagKind, *, overwrite: bool = False
) -> list[str]:
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
    lasers = LaserScanEncoder(recording) if planar_scans else None
    with new_bag(path, kind, overwrite=overwrite) as bag:
        frames = write_sensor_frames(bag, recording)
        name, type = (
            ("scan", message_writer.SCAN) if planar_scans else ("points", message_writer.POINTS)
        )
        sends = [bag.add_topic(f"/{one}", type) for one in number_names(name, len(frames))]
        drive = _driver(bag, recording)
        for t in recording.iter_scans(range(recording.n_scans)):
            drive(t)
            stamp, sensor = int(stamps[t]), int(recording.sensor[t])
            if lasers is None:
                message = _cloud(bag, recording, t, frames[sensor])
            else:
                message = lasers.make_message(bag, t, frames[sensor], lasers.ranges(t))
            sends[sensor](stamp, message)
    return lasers.describe_losses() if lasers is not None else list(_cloud_losses(recording))


class LaserScanEncoder:
    """The lasers of a recording in the plane, as LaserScan messages describe them.

    Raises:
        InputError: a scan has directions that such messages cannot state.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._fans = laser_scan.beam_angles(recording)
        self._range_max = [reach.max_range() for reach in laser_scan.range_limits(recording)]
        self._time_increments, self._uneven = laser_scan.time_increments(recording)

    def ranges(self, t: int) -> NDArray[np.float32]:
        """(n,) metres of a scan, +inf at maximum range, NaN where unusable."""
        return laser_scan.beam_ranges(self._recording, t, np.inf).astype(np.float32)

    def make_message(self, bag: BagWriter, t: int, frame: str, ranges: NDArray[np.float32]) -> Any:
        """A scan with these ranges (n,), see `messages.laser_scan`."""
        return message_writer.make_laser_scan(
            bag,
            int(self._recording.stamp_ns[t]),
            frame,
            ranges,
            (float(self._fans[t, 0]), float(self._fans[t, 1])),
            float(self._time_increments[t]),
            self._range_max[self._recording.sensor[t]],
        )

    def describe_losses(self) -> list[str]:
        """What the messages do not say, a sentence each."""
        if not self._uneven:
            return []
        return [
            f"when beams were taken is left out of {self._uneven} scans: LaserScan holds times "
            "that begin at the stamp and rise evenly"
        ]


def write_sensor_frames(bag: BagWriter, recording: Recording) -> list[str]:
    """Says once where the sensors sit on the robot; returns their S frames."""
    S = len(recording.T_base_sensor)
    frames = number_names("laser" if recording.dimension == 2 else "lidar", S)
    send = bag.add_topic("/tf_static", message_writer.TRANSFORMS, latched=True)
    if recording.n_scans:
        first = int(recording.stamp_ns[0])
        placed = [(BASE, f, T) for f, T in zip(frames, recording.T_base_sensor, strict=True)]
        send(first, message_writer.make_transforms(bag, first, placed))
    return frames


def number_names(name: str, count: int) -> list[str]:
    return [name, *(f"{name}{k}" for k in range(2, count + 1))][:count]


def _driver(bag: BagWriter, recording: Recording) -> Callable[[int], None]:
    """A function that sends the odometry of a scan."""
    T_odom_base = recording.T_odom_base
    if T_odom_base is None:
        return lambda t: None  # noqa: ARG005
    send_tf = bag.add_topic("/tf", message_writer.TRANSFORMS)
    send_odometry = bag.add_topic("/odom", message_writer.ODOMETRY)

    def drive(t: int) -> None:
        stamp, T = int(recording.stamp_ns[t]), T_odom_base[t]
        if t and stamp == recording.stamp_ns[t - 1] and np.array_equal(T, T_odom_base[t - 1]):
            return  # two sensors at the same moment
        send_tf(stamp, message_writer.make_transforms(bag, stamp, [(ODOM, BASE, T)]))
        send_odometry(stamp, message_writer.make_odometry(bag, stamp, T))

    return drive


def _cloud(bag: BagWriter, recording: Recording, t: int, frame: str) -> Any:
    beams = recording.beams_of(t)
    # a point at maximum range would be taken for a thing
    points = np.where(recording.hit[beams, None], recording.points[beams], np.float32(np.nan))
    times = None if recording.beam_time is None else recording.beam_time[beams]
    return message_writer.make_point_cloud(bag, int(recording.stamp_ns[t]), frame, points, times)


def _cloud_losses(recording: Recording) -> Iterator[str]:
    free = 0
    for t in recording.iter_scans(range(recording.n_scans)):
        beams = recording.beams_of(t)
        seen = recording.points[beams][~recording.hit[beams]]
        free += int(np.count_nonzero(~np.isnan(seen).any(axis=1)))
    if free:
        yield f"{free} beams at maximum range are no points: how far they went is left out"


_Send = Callable[[int, bytes], None]


@dataclass(frozen=True)
class FilteredBag:
    """What was written.

    Attributes:
        scans: messages that are scans of the recording, as they were but for blanked readings.
        left_out: messages of scans that the recording does not have, so that nothing is known of
            their beams.
        topics: those that could not be copied, as nobody knows what their messages are made of.
        unfiltered: those of scans that were not mapped; they are as they were.
    """

    scans: int
    omitted: int
    omitted_topics: list[str]
    unfiltered_topics: list[str]


def write_filtered_bag(
    source: Path,
    out: Path,
    recording: Recording,
    blank: NDArray[np.bool_],
    options: ReadOptions,
    *,
    overwrite: bool = False,
) -> FilteredBag:
    """Write a bag with some readings of its scans replaced by what says that nothing came back.

    That is +inf (REP 117), zero for lasers that say it with zeros: more infinities would make
    readers take these for unusable.

    Args:
        source: the bag.
        out: where to, a bag of the same kind. It appears whole or not at all.
        recording: as it was read from `source`.
        blank: (M,) which of its beams.
        options: how it was read.
        overwrite: replace what is there.

    Raises:
        InputError: the bag is not the one that was read, or cannot be written.
    """
    for trusted in (True, False):
        try:
            bag = open_bag(source, out.absolute().parent, trusted=trusted)
            try:
                return _write(bag, source, out, recording, blank, options, overwrite)
            finally:
                bag.close()
        except DamagedBagError:
            continue
    raise InputError("is damaged", where=str(source))


def _write(
    bag: Bag,
    source: Path,
    out: Path,
    recording: Recording,
    blank: NDArray[np.bool_],
    options: ReadOptions,
    overwrite: bool,
) -> FilteredBag:
    kind, mcap = detect_kind(source)
    scan_of = {
        key: t for t, key in enumerate(list_scan_messages(bag, options, out.absolute().parent))
    }
    if len(scan_of) != recording.n_scans:
        raise InputError("is not the bag that was mapped: other scans", where=str(source))
    of_lasers = {topic for topic, _ in scan_of}
    nothing = _no_return(recording)
    seen: dict[str, int] = {}
    scans = left_out = 0
    with writing.new_bag(out, kind, overwrite=overwrite, mcap=mcap) as copy:
        send = {c.id: copy.copy_topic(c) for c in bag.channels}
        for message in bag.messages({c.topic for c in bag.channels}):
            topic = message.channel.topic
            to = send[message.channel.id]
            if topic not in of_lasers:
                _pass_on(message, to)
                continue
            number = seen[topic] = seen.get(topic, 0) + 1
            t = scan_of.get((topic, number))
            if t is None:
                left_out += 1
                continue
            beams = blank[recording.beams_of(t)]
            raw = (
                _blank_readings(message, beams, nothing, copy)
                if beams.any()
                else _unpacked(message)
            )
            if to is not None:
                to(message.log_ns, raw)
            scans += 1
    unfiltered = {
        c.topic for c in bag.channels if c.type in (LASER_SCAN, MULTI_ECHO, POINT_CLOUD)
    } - of_lasers
    return FilteredBag(scans, left_out, _lost(bag.channels, send), sorted(unfiltered))


def _no_return(recording: Recording) -> dict[tuple[str, str], float]:
    """The reading of each laser, by topic and frame, where nothing came back."""
    out = {}
    for laser in recording.source["sensors"]:
        is_zero = laser["ranges"]["zero_means"] == "max-range"
        out[laser["name"], laser["frame"]] = 0.0 if is_zero else math.inf
    return out


def _pass_on(message: Message, to: _Send | None) -> None:
    if to is not None:
        to(message.log_ns, _unpacked(message))


def _lost(channels: list[Channel], send: dict[int, _Send | None]) -> list[str]:
    return sorted({c.topic for c in channels if send[c.id] is None and c.n_messages})


def _unpacked(message: Message) -> bytes:
    packed = message.channel.encoding != "ros1" and message.raw.startswith(ZSTD_MAGIC)
    return decompress_zstd(message.raw) if packed else message.raw


def _blank_readings(
    message: Message,
    blank: NDArray[np.bool_],
    no_return: dict[tuple[str, str], float],
    copy: writing.BagWriter,
) -> bytes:
    """A scan's message with the blanked readings replaced."""
    scan: Any = decode(message)
    nothing = np.float32(no_return[message.channel.topic, frame_name(scan.header.frame_id)])
    if message.channel.type == MULTI_ECHO:
        for k in np.flatnonzero(blank):
            scan.ranges[k].echoes = np.array([nothing])
    else:
        scan.ranges = np.where(blank, nothing, scan.ranges)
    return copy.serialize(scan, message.channel.type)
