"""Filtered copies of bags: readings replaced by "no return", points removed, all else as it was."""

import math
from typing import Any, cast

import numpy as np

from stillmap.core.array_types import Bool
from stillmap.core.errors import InputError
from stillmap.core.files import workplace
from stillmap.io.filtered_clouds import FilterJob, Omissions, other_recording_error
from stillmap.io.point_cloud.table import erase_coordinates
from stillmap.io.ros import messages
from stillmap.io.ros.bag import Bag, read_bag
from stillmap.io.ros.clouds import find_layout
from stillmap.io.ros.limits import count_output
from stillmap.io.ros.writer import new_bag

_PROGRESS_INTERVAL = 200  # messages


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a bag with some readings or points blanked.

    Readings of laser scans become +inf (REP 117), or zero for lasers that use zero: further
    infinities would make readers take the zeros for unusable. Points are removed; those of
    organised clouds become NaN.

    Raises:
        InputError: the source is not the bag that was read, or the output cannot be written.
    """
    scratch = workplace(job.output)
    return read_bag([job.source], scratch, lambda bag: _copy(bag, job))[0]


def _copy(bag: Bag, job: FilterJob) -> Omissions:
    kind, mcap = messages.detect_kind(job.source)
    kind = cast(messages.BagKind, job.kind) if job.kind else kind
    topics, scan_of = _number_scans(job)
    count, omitted, damaged = dict.fromkeys(topics, 0), 0, 0
    total = max(sum(c.n_messages for c in bag.channels), 1)
    options = {"overwrite": job.overwrite, "mcap": mcap and kind == "ros2"}
    with new_bag(job.output, kind, **options) as copy:
        sends = {c.id: copy.copy_topic(c) for c in bag.channels}
        for number, message in enumerate(bag.messages({c.topic for c in bag.channels})):
            (topic, channel), blank = (message.channel.topic, message.channel), None
            if topic in topics:
                count[topic] += 1
                scan = scan_of.pop((topic, count[topic]), None)
                if scan is None:  # it was not read
                    omitted += 1
                    continue
                blank = job.blank[job.recording.beams_of(scan)]
            raw = _unpack(message)
            if raw is not None and blank is not None and blank.any():
                raw = copy.serialize(_blank(message, blank, job), channel.type)
            damaged += raw is None
            send = sends[channel.id]
            if send is not None and raw is not None:
                send(message.log_ns, raw)
            if number % _PROGRESS_INTERVAL == 0:
                job.report(min(number / total, 1.0))
        if scan_of:
            raise other_recording_error(job.source)
    unknown = {c.topic for c in bag.channels if sends[c.id] is None and c.n_messages}
    unfiltered = {c.topic for c in bag.channels if c.type in messages.SCAN_TYPES} - topics - unknown
    why = "left out: the bag does not say what its messages are made of"
    notes = [f"{topic} is as it was: it was not mapped" for topic in sorted(unfiltered)]
    notes += [f"{topic} {why}" for topic in sorted(unknown)]
    notes += [f"{damaged} damaged messages are left out"] * bool(damaged)
    return Omissions(omitted, tuple(notes))


def _unpack(message: messages.Message) -> bytes | None:
    """The content of a message; None: it is damaged."""
    try:
        raw = messages.decompress(message)
    except InputError:
        raise
    except Exception:  # any error of the library about damaged data
        return None
    count_output(len(raw))
    return raw


def _number_scans(job: FilterJob) -> tuple[set[str], dict[tuple[str, int], int]]:
    """The topics that were read, and the scan of each message on them, by topic and number."""
    recording, sensors = job.recording, job.recording.source.sensors
    if recording.record is None:
        raise other_recording_error(job.source)
    names = np.repeat([s.name for s in sensors], [s.places for s in sensors])
    topic = names[recording.sensor].tolist()
    keys = zip(topic, recording.record.tolist(), strict=True)
    return set(topic), {key: scan for scan, key in enumerate(keys)}


def _blank(message: messages.Message, mask: Bool, job: FilterJob) -> Any:
    """The content of a message without the readings or points `mask` (n,)."""
    content, topic = messages.decode(message), message.channel.topic
    if message.channel.type == messages.POINT_CLOUD:
        _blank_points(content, mask, topic)
        return content
    key = topic, messages.frame_name(content.header.frame_id)
    rule = next(s.ranges for s in job.recording.source.sensors if (s.name, s.frame) == key)
    code = np.float32(0.0 if rule and rule.zero_means == "max-range" else math.inf)
    if message.channel.type == messages.MULTI_ECHO:
        for k in np.flatnonzero(mask):
            content.ranges[k].echoes = np.array([code])
    else:
        content.ranges = np.where(mask, code, content.ranges)
    return content


def _blank_points(cloud: Any, mask: Bool, topic: str) -> None:
    """Remove points of a PointCloud2, or their coordinates where it has rows of points."""
    layout = find_layout(cloud)
    if isinstance(layout, str) or layout.n_points != len(mask):
        raise InputError(f"has another cloud on {topic} than was mapped")
    data = np.array(cloud.data, np.uint8)
    if layout.shape[0] > 1:
        erase_coordinates(layout.view(data), mask.reshape(layout.shape))
        cloud.data, cloud.is_dense = data, False
        return
    step = layout.dtype.itemsize
    end, removed = len(mask) * step, int(np.count_nonzero(mask))
    kept = data[:end].reshape(-1, step)[~mask].reshape(-1)
    cloud.data = np.concatenate([kept, data[end:]])
    cloud.width -= removed
    cloud.row_step = max(cloud.row_step - removed * step, 0)
