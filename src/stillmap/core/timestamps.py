"""Time stamps: exact nanoseconds from decimal text, clock jumps, and times of beams."""

# signatures name Recording, which needs this module
from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from decimal import ROUND_HALF_EVEN, Decimal, InvalidOperation
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays

if TYPE_CHECKING:
    from stillmap.core.recording import Recording

# ns from 1970, the years 1824 to 2116: the time between any two stamps fits into int64
MAX_STAMP_NS = 2**62 - 1

MAX_BEAM_TIME = 60.0  # s from the stamp of a scan: times farther from it are damaged


def parse_ns(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, exact; rounded half to even.

    Raises:
        ValueError: not a number, not finite, or more than `MAX_STAMP_NS` from 1970.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(f"not a time stamp: {text!r}") from error
    # checked before any arithmetic: 1e999999999 would be expanded
    if "_" in text or not seconds.is_finite() or seconds.adjusted() > 9:
        raise ValueError(f"not a time stamp: {text!r}")
    if seconds.adjusted() < -12:
        return 0
    if abs(seconds) * 10**9 > MAX_STAMP_NS:
        raise ValueError(f"not a time stamp: {text!r}")
    return int(seconds.scaleb(9).to_integral_value(ROUND_HALF_EVEN))


def are_dated(stamp_ns: NDArray[np.int64]) -> bool:
    """Whether all of stamps (T,) lie at most `MAX_STAMP_NS` before or after 1970."""
    return not np.any((stamp_ns < -MAX_STAMP_NS) | (stamp_ns > MAX_STAMP_NS))


def format_seconds(stamp_ns: int) -> str:
    """Seconds with nine decimals, exact."""
    whole, rest = divmod(abs(stamp_ns), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def longest_non_decreasing(values: Sequence[int]) -> NDArray[np.intp]:
    """Indices of a longest non-decreasing subsequence, in O(n log n) (patience sorting).

    One stamp that jumps ahead costs that element alone, not all that follow it.
    """
    tails: list[int] = []  # smallest last value of a subsequence of each length
    tail_index: list[int] = []
    before = np.full(len(values), -1, np.intp)
    for i, value in enumerate(values):
        length = bisect_right(tails, value)
        if length:
            before[i] = tail_index[length - 1]
        if length == len(tails):
            tails.append(value)
            tail_index.append(i)
        else:
            tails[length] = value
            tail_index[length] = i
    out = np.empty(len(tails), np.intp)
    i = tail_index[-1] if tail_index else -1
    for k in range(len(out) - 1, -1, -1):
        out[k] = i
        i = int(before[i])
    return out


def beam_stamps_ns(recording: Recording, scans: slice) -> NDArray[np.int64]:
    """(n,) stamp in nanoseconds of each beam of a slice of scans."""
    offset = recording.offset[scans.start : scans.stop + 1]
    stamps = np.repeat(recording.stamp_ns[scans], np.diff(offset))
    if recording.beam_time is None:
        return stamps
    seconds = recording.beam_time[offset[0] : offset[-1]].astype(np.float64)
    return np.asarray(stamps + np.round(1e9 * seconds).astype(np.int64))


def max_scan_duration_ns(recording: Recording) -> int:
    """Maximum time in nanoseconds from the stamp of a scan to its beams.

    Without beam times the median time between stamps (of all sensors, which may be interleaved).
    """
    steps, times = np.diff(recording.stamp_ns), recording.beam_time
    longest = float(np.median(steps)) if len(steps) else 0.0
    if times is not None:
        for block in arrays.iter_blocks(times):
            longest = max(longest, 1e9 * float(np.abs(times[block]).max()))
    return int(np.ceil(longest))
