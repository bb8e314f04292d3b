"""Filtered copies of bags: readings replaced by "no return", points removed, all else as it was."""

import math
from collections.abc import Callable
from contextlib import closing
from typing import Any, cast

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.files import workplace
from stillmap.core.recording import Recording
from stillmap.io.filtered_copy import FilterJob, Mask, Omissions, other_recording_error
from stillmap.io.ros.bag import open_bag
from stillmap.io.ros.bag_types import Bag, BagKind, DamagedBagError, Message, detect_kind
from stillmap.io.ros.bag_writer import SendRaw, new_bag
from stillmap.io.ros.messages import (
    LASER_SCAN,
    MULTI_ECHO,
    POINT_CLOUD,
    decode,
    decompress,
    frame_name,
)
from stillmap.io.ros.point_cloud2 import find_layout

_PROGRESS_INTERVAL = 200  # messages

# (content of a message, (n,) readings or points to blank, the message); changes the content
_Blank = Callable[[Any, Mask, Message], None]


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a bag with some readings or points blanked.

    Readings of laser scans become +inf (REP 117), or zero for lasers that use zero: further
    infinities would make readers take the zeros for unusable. Points are removed; those of
    organised clouds become NaN.

    Raises:
        InputError: the source is not the bag that was read, or the output cannot be written.
    """
    for trusted in (True, False):
        try:
            scratch = workplace(job.output)
            with closing(open_bag(job.source, scratch, trusted=trusted)) as bag:
                return _copy(bag, job)
        except DamagedBagError:
            continue
    raise InputError("is damaged", where=str(job.source))


def _copy(bag: Bag, job: FilterJob) -> Omissions:
    kind, mcap = detect_kind(job.source)
    kind = cast(BagKind, job.kind) if job.kind else kind
    mcap &= kind == "ros2"
    scans = _ScanMasks(job)
    total = max(sum(c.n_messages for c in bag.channels), 1)
    with new_bag(job.output, kind, overwrite=job.overwrite, mcap=mcap) as copy:
        blank: dict[str, _Blank] = {POINT_CLOUD: _blank_points, **_scan_blanks(job.recording)}
        sends = {c.id: copy.copy_topic(c) for c in bag.channels}
        for number, message in enumerate(bag.messages({c.topic for c in bag.channels})):
            send, mask = sends[message.channel.id], scans.next_mask(message.channel.topic)
            if send is None or mask is None:
                continue
            if mask.any():
                content = decode(message)
                blank[message.channel.type](content, mask, message)
                send(message.log_ns, copy.serialize(content, message.channel.type))
            else:
                send(message.log_ns, decompress(message))
            if number % _PROGRESS_INTERVAL == 0:
                job.report(min(number / total, 1.0))
        scans.require_all_found()
    return _describe_omissions(bag, sends, scans)


class _ScanMasks:
    """Beams to blank of the scan messages of a bag, which come in the order of their numbers.

    Attributes:
        topics: those with scans that were read.
        omitted: number of messages on them so far that were not read.
    """

    def __init__(self, job: FilterJob) -> None:
        recording = job.recording
        if recording.record is None:
            raise other_recording_error(job.source)
        names = [one["name"] for one in recording.source["sensors"]]
        places = [one.get("places", 1) for one in recording.source["sensors"]]
        topic = np.repeat(names, places)[recording.sensor].tolist()
        keys = zip(topic, recording.record.tolist(), strict=True)
        self._job = job
        self._scan = {key: scan for scan, key in enumerate(keys)}
        self._count = dict.fromkeys(topic, 0)
        self._found = 0
        self.topics = frozenset(topic)
        self.omitted = 0

    def next_mask(self, topic: str) -> Mask | None:
        """(n,) of the next message of a topic, none of another one; None: it was not read."""
        if topic not in self.topics:
            return np.zeros(0, np.bool_)
        self._count[topic] += 1
        scan = self._scan.get((topic, self._count[topic]))
        if scan is None:
            self.omitted += 1
            return None
        self._found += 1
        return self._job.blank[self._job.recording.beams_of(scan)]

    def require_all_found(self) -> None:
        """Refuse a bag that lacks scans which were read.

        Raises:
            InputError: it does.
        """
        if self._found < len(self._scan):
            raise other_recording_error(self._job.source)


def _describe_omissions(bag: Bag, sends: dict[int, SendRaw | None], scans: _ScanMasks) -> Omissions:
    omitted = {c.topic for c in bag.channels if sends[c.id] is None and c.n_messages}
    types = LASER_SCAN, MULTI_ECHO, POINT_CLOUD
    unfiltered = {c.topic for c in bag.channels if c.type in types} - scans.topics - omitted
    unknown = "left out: the bag does not say what its messages are made of"
    notes = [
        *(f"{topic} is as it was: it was not mapped" for topic in sorted(unfiltered)),
        *(f"{topic} {unknown}" for topic in sorted(omitted)),
    ]
    return Omissions(scans.omitted, tuple(notes))


def _scan_blanks(recording: Recording) -> dict[str, _Blank]:
    """The functions that blank readings of laser scans, by type of message."""
    lasers = recording.source["sensors"] if recording.dimension == 2 else []
    codes = {
        (laser["name"], laser["frame"]): (
            0.0 if laser["ranges"]["zero_means"] == "max-range" else math.inf
        )
        for laser in lasers
    }

    def find_code(scan: Any, message: Message) -> np.float32:
        return np.float32(codes[message.channel.topic, frame_name(scan.header.frame_id)])

    def blank_ranges(scan: Any, mask: Mask, message: Message) -> None:
        scan.ranges = np.where(mask, find_code(scan, message), scan.ranges)

    def blank_echoes(scan: Any, mask: Mask, message: Message) -> None:
        code = find_code(scan, message)
        for k in np.flatnonzero(mask):
            scan.ranges[k].echoes = np.array([code])

    return {LASER_SCAN: blank_ranges, MULTI_ECHO: blank_echoes}


def _blank_points(cloud: Any, mask: Mask, message: Message) -> None:
    """Remove points of a PointCloud2, or their coordinates where it has rows of points."""
    layout = find_layout(cloud)
    if isinstance(layout, str) or layout.n_points != len(mask):
        raise InputError(f"has another cloud on {message.channel.topic} than was mapped")
    data = np.array(cloud.data, np.uint8)
    if layout.shape[0] > 1:
        points = layout.view(data)
        for axis in "xyz":
            is_float = points[axis].dtype.kind == "f"
            points[axis][mask.reshape(layout.shape)] = np.nan if is_float else 0
        cloud.data, cloud.is_dense = data, False
        return
    step = layout.strides[1]
    end, removed = len(mask) * step, int(np.count_nonzero(mask))
    kept = data[:end].reshape(-1, step)[~mask].reshape(-1)
    cloud.data = np.concatenate([kept, data[end:]])
    cloud.width -= removed
    cloud.row_step = max(cloud.row_step - removed * step, 0)
