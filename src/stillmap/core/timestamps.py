"""Time stamps: exact nanoseconds from decimal text, clock jumps, and times of beams."""

from bisect import bisect_right
from collections.abc import Sequence
from decimal import ROUND_HALF_EVEN, Decimal, InvalidOperation

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.recording import Recording

_MAX_SECONDS = 9_000_000_000  # int64 holds 9.22e9 s in nanoseconds


def parse_ns(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, exact; rounded half to even.

    Raises:
        ValueError: not a number, not finite, or outside the range of int64 nanoseconds.
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
    if abs(seconds) > _MAX_SECONDS:
        raise ValueError(f"not a time stamp: {text!r}")
    return int(seconds.scaleb(9).to_integral_value(ROUND_HALF_EVEN))


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
