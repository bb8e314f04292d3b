"""A bag once more, with beams blanked: as if nothing had come back."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.recording.model import Recording
from stillmap.recording.options import ReadOptions
from stillmap.recording.ros.bags import open_bag
from stillmap.recording.ros.channels import Bag, Channel, DamagedError, Message
from stillmap.recording.ros.kinds import ZSTD_MAGIC, own_form
from stillmap.recording.ros.messages import CLOUD, LASER, MULTI_ECHO, decoded, frame
from stillmap.recording.ros.reading import origins
from stillmap.recording.ros.unpacking import zstd_unpacked
from stillmap.recording.ros_writing import bag as writing

_Send = Callable[[int, bytes], None]


@dataclass(frozen=True)
class Blanked:
    """What was written.

    Attributes:
        scans: messages that are scans of the recording, as they were but for blanked readings.
        left_out: messages of scans that the recording does not have, so that nothing is known of
            their beams.
        topics: those that could not be copied, as nobody knows what their messages are made of.
        unfiltered: those of scans that were not mapped; they are as they were.
    """

    scans: int
    left_out: int
    topics: list[str]
    unfiltered: list[str]


def write(
    source: Path,
    out: Path,
    recording: Recording,
    blank: NDArray[np.bool_],
    options: ReadOptions,
    *,
    overwrite: bool = False,
) -> Blanked:
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
        except DamagedError:
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
) -> Blanked:
    kind, mcap = own_form(source)
    scan_of = {key: t for t, key in enumerate(origins(bag, options, out.absolute().parent))}
    if len(scan_of) != recording.n_scans:
        raise InputError("is not the bag that was mapped: other scans", where=str(source))
    of_lasers = {topic for topic, _ in scan_of}
    nothing = _no_return(recording)
    seen: dict[str, int] = {}
    scans = left_out = 0
    with writing.new_bag(out, kind, overwrite=overwrite, mcap=mcap) as copy:
        send = {c.id: copy.copied_topic(c) for c in bag.channels}
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
            raw = _replaced(message, beams, nothing, copy) if beams.any() else _unpacked(message)
            if to is not None:
                to(message.log_ns, raw)
            scans += 1
    unfiltered = {c.topic for c in bag.channels if c.type in (LASER, MULTI_ECHO, CLOUD)} - of_lasers
    return Blanked(scans, left_out, _lost(bag.channels, send), sorted(unfiltered))


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
    return zstd_unpacked(message.raw) if packed else message.raw


def _replaced(
    message: Message,
    blank: NDArray[np.bool_],
    no_return: dict[tuple[str, str], float],
    copy: writing.Bag,
) -> bytes:
    """A scan's message with the blanked readings replaced."""
    scan: Any = decoded(message)
    nothing = np.float32(no_return[message.channel.topic, frame(scan.header.frame_id)])
    if message.channel.type == MULTI_ECHO:
        for k in np.flatnonzero(blank):
            scan.ranges[k].echoes = np.array([nothing])
    else:
        scan.ranges = np.where(blank, nothing, scan.ranges)
    return copy.serialized(scan, message.channel.type)
