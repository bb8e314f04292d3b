"""Collects LaserScan and MultiEchoLaserScan messages by topic and frame."""

import math
from array import array
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.advice import advise
from stillmap.core.array_builder import ArrayBuilder
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


class ScanShape(NamedTuple):
    """Beam geometry that scans of one laser share, in radians, metres and seconds."""

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
        # a full turn may repeat its first beam at the end, or go a few steps further
        if (self.n - 4) * abs(self.angle_increment) > _TURN:
            return MANY_TURNS
        return None

    def angles(self) -> NDArray[np.float64]:
        """(n,) beam angles."""
        return self.angle_min + self.angle_increment * np.arange(self.n, dtype=np.float64)


class _ScanBuffer:
    """The scans of one laser on one topic, in recorded order.

    Attributes:
        topic, frame: of the messages.
        stamp_ns, log_ns: (T,) header stamps and log times.
        number: (T,) number of the message on its topic, from 1.
        shape: (T,) index into `shapes`.
    """

    def __init__(self, topic: str, frame: str, scratch: Path | None) -> None:
        self.topic, self.frame = topic, frame
        self.stamp_ns, self.log_ns, self.number = array("q"), array("q"), array("q")
        self.shape = array("i")
        self.shapes: dict[ScanShape, int] = {}
        self._ranges = ArrayBuilder(np.float32, (), scratch)

    def add(
        self, message: Any, ranges: NDArray[np.float32], log_ns: int, number: int
    ) -> str | None:
        """Add a scan; returns the reason if it cannot be used."""
        shape = ScanShape(
            message.angle_min,
            message.angle_increment,
            len(ranges),
            message.range_min,
            message.range_max,
            message.time_increment,
        )
        if shape not in self.shapes and (fault := shape.find_fault()) is not None:
            return fault
        self.shape.append(self.shapes.setdefault(shape, len(self.shapes)))
        self.stamp_ns.append(stamp_ns(message.header))
        self.log_ns.append(log_ns)
        self.number.append(number)
        self._ranges.append(ranges)
        return None

    def finish(self, skipped: SkippedRecords) -> "LaserScans":
        """The scans with non-decreasing stamps, without repeated ones; others are counted."""
        ranges = self._ranges.finish()
        shapes = list(self.shapes)
        shape = np.asarray(self.shape, np.int32)
        n = np.array([s.n for s in shapes], np.int64)[shape]
        start = np.cumsum(n) - n
        stamps, warnings = np.asarray(self.stamp_ns, np.int64), []
        if np.mean(stamps == 0) > 0.5:
            stamps = np.asarray(self.log_ns, np.int64)
            warnings.append(
                advise(
                    f"{self.topic}: headers have no stamps: log times are used",
                    "let the driver stamp its scans: log times come later and jitter",
                )
            )
        keep = longest_non_decreasing(stamps.tolist())
        number = np.asarray(self.number)
        skipped.add_all(TIME_BACKWARDS, np.delete(number, keep))
        repeated = _find_repeats(stamps, start, n, ranges, keep)
        skipped.add_all(REPEATED, number[keep[repeated]])
        keep = keep[~repeated]
        return LaserScans(
            self.topic,
            self.frame,
            stamps[keep],
            number[keep],
            start[keep],
            shape[keep],
            shapes,
            ranges,
            warnings,
        )


class LaserScans(NamedTuple):
    """T usable scans of one laser, ordered by their stamps.

    Attributes:
        topic, frame: of the messages.
        stamp_ns: (T,) int64.
        number: (T,) int64 number of the message on its topic, from 1.
        start: (T,) int64 index of the first reading of each in `ranges`.
        shape: (T,) int32 index into `shapes`.
        shapes: distinct beam geometries.
        ranges: (N,) float32 metres, of all scans; may be memory-mapped.
        warnings: sentences.
    """

    topic: str
    frame: str
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
        """(T,) number of beams of each scan."""
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
    """Collects the scans of all lasers: one topic may carry several, by frame."""

    def __init__(self, scratch: Path | None) -> None:
        self._scratch = scratch
        self._lasers: dict[tuple[str, str], _ScanBuffer] = {}
        self._skipped: dict[str, SkippedRecords] = {}
        self._count: Counter[str] = Counter()  # messages by topic

    def add_message(self, message: Message, *, skip: bool = False) -> None:
        """Add a message, or `skip` it undecoded; one that cannot be used is counted."""
        topic = message.channel.topic
        self._count[topic] += 1
        if skip:
            return
        try:
            scan = decode(message)
            frame = frame_name(scan.header.frame_id)
            ranges = _first_echoes(scan) if message.channel.type == MULTI_ECHO else scan.ranges
        except Exception:  # any error of rosbags about damaged bytes
            fault: str | None = UNREADABLE
        else:
            known = self._lasers.get((topic, frame))
            laser = known or _ScanBuffer(topic, frame, self._scratch)
            fault = laser.add(scan, ranges, message.log_ns, self._count[topic])
            if fault is None:
                self._lasers[topic, frame] = laser
        if fault is not None:
            skipped = self._skipped.setdefault(topic, SkippedRecords())
            skipped.add(fault, self._count[topic])

    def finish(self) -> tuple[list[LaserScans], dict[str, SkippedRecords]]:
        """The lasers with at least one usable scan, and the messages skipped by topic."""
        found = [
            laser.finish(self._skipped.setdefault(laser.topic, SkippedRecords()))
            for laser in self._lasers.values()
        ]
        return [scans for scans in found if scans.n_scans], self._skipped


def _first_echoes(scan: Any) -> NDArray[np.float32]:
    """(n,) the first echo of each beam: glass and rain return further ones."""
    return np.array([e.echoes[0] if len(e.echoes) else np.nan for e in scan.ranges], np.float32)


def _find_repeats(
    stamps: NDArray[np.int64],
    start: NDArray[np.int64],
    n: NDArray[np.int64],
    ranges: NDArray[np.float32],
    keep: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """(len(keep),) which scans have the stamp and the readings of the previous one."""
    repeated = np.zeros(len(keep), np.bool_)
    for k in np.flatnonzero(np.diff(stamps[keep]) == 0) + 1:
        a, b = keep[k - 1], keep[k]
        one, other = ranges[start[a] : start[a] + n[a]], ranges[start[b] : start[b] + n[b]]
        repeated[k] = np.array_equal(one, other, equal_nan=True)
    return repeated
