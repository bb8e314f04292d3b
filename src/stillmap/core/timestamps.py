"""Time stamps: exact nanoseconds from decimal text, and clock jumps."""

from bisect import bisect_right
from collections.abc import Sequence
from decimal import ROUND_HALF_EVEN, Decimal, InvalidOperation

import numpy as np
from numpy.typing import NDArray

# ns from 1970, the years 1824 to 2116: the time between any two stamps fits into int64
MAX_STAMP_NS = 2**62 - 1

MAX_LATENESS_NS = 10**9  # of a scan among others: a larger one is no delay, but another clock

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
    """True if all stamps (T,) lie at most `MAX_STAMP_NS` before or after 1970."""
    return not np.any((stamp_ns < -MAX_STAMP_NS) | (stamp_ns > MAX_STAMP_NS))


def format_seconds(stamp_ns: int) -> str:
    """Seconds with nine decimals, exact."""
    whole, rest = divmod(abs(stamp_ns), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def order_in_time(stamp_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Indices that sort stamps (T,), as recorded one after the other, without those that are off.

    Records that come late are sorted. Left out are those that are off by more than
    `MAX_LATENESS_NS`, as where a stamp jumps or the clock was set back, and late ones about these.
    """
    forward = longest_non_decreasing(stamp_ns.tolist())
    others = np.delete(np.arange(len(stamp_ns)), forward)
    run = np.searchsorted(forward, others)
    before = stamp_ns[forward[np.maximum(run - 1, 0)]]
    after = stamp_ns[forward[np.minimum(run, len(forward) - 1)]]
    off = np.maximum(before - stamp_ns[others], stamp_ns[others] - after)
    jumps = before[off > MAX_LATENESS_NS]
    near = np.searchsorted(jumps, stamp_ns[others] + np.array([[-1], [1]]) * MAX_LATENESS_NS)
    is_late = (off <= MAX_LATENESS_NS) & (near[0] == near[1])
    kept = np.sort(np.concatenate([forward, others[is_late]]))
    return np.asarray(kept[np.argsort(stamp_ns[kept], kind="stable")])


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
