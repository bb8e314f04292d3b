"""LaserScan and MultiEchoLaserScan messages, gathered topic by topic."""

import math
from array import array
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import ArrayBuilder
from stillmap.core.timestamps import longest_non_decreasing
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.bag_types import Message
from stillmap.io.ros.messages import MULTI_ECHO, decode, frame_name, stamp_ns

UNREADABLE = "message that cannot be decoded"
NO_READINGS = "scan without readings"
NO_ANGLES = "angles that are no numbers"
NO_STEP = "angle_increment of zero"
MANY_TURNS = "beams over more than a full turn"
TIME_BACKWARDS = "time running backwards"
REPEATED = "scan that was recorded twice"

_TURN = 2.0 * math.pi
_MAX_READINGS = 1 << 20
_TOGETHER = 256  # scans


class ScanShape(NamedTuple):
    """What scans of one laser share. Radians, metres, seconds."""

    angle_min: float
    angle_increment: float
    n: int
    range_min: float
    range_max: float
    time_increment: float

    def find_fault(self) -> str | None:
        """Why such a scan cannot be used."""
        if self.n == 0 or self.n > _MAX_READINGS:
            return NO_READINGS
        if not (abs(self.angle_min) < 1e3 and abs(self.angle_increment) < 1e3):
            return NO_ANGLES
        if self.angle_increment == 0.0 and self.n > 1:
            return NO_STEP
        # a full turn may come with its first beam once more at its end, or a few steps over
        if (self.n - 4) * abs(self.angle_increment) > _TURN:
            return MANY_TURNS
        return None

    def angles(self) -> NDArray[np.float64]:
        """(n,) of the beams."""
        return self.angle_min + self.angle_increment * np.arange(self.n, dtype=np.float64)


class _ScanBuffer:
    """The scans of one laser on one topic, in the order of their recording.

    Attributes:
        topic, frame: where they came from.
        kind: of the messages.
        stamp_ns, log_ns: (T,) of the headers, and when they were recorded.
        number: (T,) which message on the topic each was, from 1.
        shape: (T,) which of `shapes` each has.
    """

    def __init__(self, topic: str, frame: str, kind: str, scratch: Path | None) -> None:
        self.topic, self.frame, self.kind = topic, frame, kind
        self.stamp_ns, self.log_ns, self.number = array("q"), array("q"), array("q")
        self.shape = array("i")
        self.shapes: dict[ScanShape, int] = {}
        self._ranges = ArrayBuilder(np.float32, (), scratch)
        self._waiting: list[NDArray[np.float32]] = []

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def add(
        self, message: Any, ranges: NDArray[np.float32], log_ns: int, number: int
    ) -> str | None:
        """Take in a scan; why not, if it cannot be used."""
        shape = ScanShape(
            message.angle_min,
            message.angle_increment,
            len(ranges),
            message.range_min,
            message.range_max,
            message.time_increment,
        )
        known = self.shapes.get(shape)
        if known is None:
            fault = shape.find_fault()
            if fault is not None:
                return fault
            known = self.shapes.setdefault(shape, len(self.shapes))
        self.shape.append(known)
        self.stamp_ns.append(stamp_ns(message.header))
        self.log_ns.append(log_ns)
        self.number.append(number)
        self._waiting.append(ranges)
        if len(self._waiting) >= _TOGETHER:
            self._pass_on()
        return None

    def _pass_on(self) -> None:
        if self._waiting:
            self._ranges.append(np.concatenate(self._waiting))
            self._waiting = []

    def finish(self, skipped: SkippedRecords) -> "LaserScans":
        """All of them with time that does not run backwards; what falls out is counted."""
        self._pass_on()
        ranges = self._ranges.finish()
        shapes = list(self.shapes)
        shape = np.asarray(self.shape, np.int32)
        n = np.array([s.n for s in shapes], np.int64)[shape]
        start = np.cumsum(n) - n
        stamps, warnings = self._stamps()
        keep = longest_non_decreasing(stamps.tolist())
        number = np.asarray(self.number)
        skipped.add_all(TIME_BACKWARDS, np.delete(number, keep))
        again = _find_repeats(stamps, start, n, ranges, keep)
        skipped.add_all(REPEATED, number[keep[again]])
        keep = keep[~again]
        return LaserScans(
            self.topic,
            self.frame,
            self.kind,
            stamps[keep],
            number[keep],
            start[keep],
            shape[keep],
            shapes,
            ranges,
            warnings,
        )

    def _stamps(self) -> tuple[NDArray[np.int64], list[str]]:
        stamps, log = np.asarray(self.stamp_ns, np.int64), np.asarray(self.log_ns, np.int64)
        if np.mean(stamps == 0) <= 0.5:
            return stamps, []
        return log, [f"{self.topic}: headers have no stamps: the times of recording are used"]


class LaserScans(NamedTuple):
    """T usable scans of one laser, by their stamps.

    Attributes:
        topic, frame, kind: see LaserScans.
        stamp_ns: (T,) int64.
        number: (T,) int64, which message on the topic each was, from 1.
        start: (T,) int64, where the readings of each begin in `ranges`.
        shape: (T,) int32 into `shapes`.
        shapes: what scans share.
        ranges: (N,) float32 metres, of all scans; maybe on disk.
        warnings: in words.
    """

    topic: str
    frame: str
    kind: str
    stamp_ns: NDArray[np.int64]
    number: NDArray[np.int64]
    start: NDArray[np.int64]
    shape: NDArray[np.int32]
    shapes: list[ScanShape]
    ranges: NDArray[np.float32]
    warnings: list[str]

    @property
    def n_scans(self) -> int:
        return len(self.stamp_ns)

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(T,) how many beams each scan has."""
        return np.array([s.n for s in self.shapes], np.int64)[self.shape]

    @property
    def typical_shape(self) -> ScanShape:
        """The shape of most scans."""
        return self.shapes[int(np.bincount(self.shape, minlength=len(self.shapes)).argmax())]

    @property
    def rate_hz(self) -> float | None:
        """Scans per second, None where there is no time between them."""
        span = float(self.stamp_ns[-1] - self.stamp_ns[0]) / 1e9 if self.n_scans > 1 else 0.0
        return (self.n_scans - 1) / span if span > 0.0 else None


class LaserCollector:
    """Every laser on the topics that are read: one topic may carry several, by frame."""

    def __init__(self, scratch: Path | None) -> None:
        self._scratch = scratch
        self._lasers: dict[tuple[str, str], _ScanBuffer] = {}
        self._skipped: dict[str, SkippedRecords] = {}
        self._seen: dict[str, int] = {}

    def add(self, message: Message) -> None:
        """Take in a message; what cannot be used is counted."""
        topic = message.channel.topic
        number = self._seen[topic] = self._seen.get(topic, 0) + 1
        try:
            scan = decode(message)
            name = frame_name(scan.header.frame_id)
            ranges = _first_echoes(scan) if message.channel.type == MULTI_ECHO else scan.ranges
        except Exception:  # whatever the library makes of damaged bytes
            self._skip(topic, UNREADABLE, number)
            return
        key = topic, name
        laser = self._lasers.get(key)
        if laser is None:
            laser = _ScanBuffer(topic, name, message.channel.type, self._scratch)
        fault = laser.add(scan, ranges, message.log_ns, number)
        if fault is not None:
            self._skip(topic, fault, number)
        else:
            self._lasers[key] = laser

    def _skip(self, topic: str, reason: str, number: int) -> None:
        self._skipped.setdefault(topic, SkippedRecords()).add(reason, number)

    def finish(self) -> tuple[list[LaserScans], dict[str, SkippedRecords]]:
        """The lasers with at least one usable scan, and what was skipped on each topic."""
        found = [
            laser.finish(self._skipped.setdefault(laser.topic, SkippedRecords()))
            for laser in self._lasers.values()
        ]
        return [scans for scans in found if scans.n_scans], self._skipped


def _first_echoes(scan: Any) -> NDArray[np.float32]:
    """The nearest thing that each beam met: behind glass and rain more may come back."""
    return np.array([e.echoes[0] if len(e.echoes) else np.nan for e in scan.ranges], np.float32)


def _find_repeats(
    stamps: NDArray[np.int64],
    start: NDArray[np.int64],
    n: NDArray[np.int64],
    ranges: NDArray[np.float32],
    keep: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """(len(keep),) which scans have stamp and readings of the one before."""
    again = np.zeros(len(keep), np.bool_)
    for k in np.flatnonzero(np.diff(stamps[keep]) == 0) + 1:
        a, b = keep[k - 1], keep[k]
        one, other = ranges[start[a] : start[a] + n[a]], ranges[start[b] : start[b] + n[b]]
        again[k] = np.array_equal(one, other, equal_nan=True)
    return again
