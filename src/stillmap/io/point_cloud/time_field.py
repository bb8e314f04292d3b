"""When each point of a scan was taken, from a column that does not say its unit."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

NAMES = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")

_UNITS = (1, 10**3, 10**6, 10**9)  # per second
_SINCE_1970 = (6e8, 5e9)  # s: the years 1989 to 2128
# factors of less than 1000 between shortest and longest: one unit at most fits
_SWEEP = (0.005, 2.0)  # s that a scanner takes for a scan
_OF_PERIOD = (0.05, 1.5)  # of the time from scan to scan
_LONGEST = 60.0  # s: what lies farther from its scan's stamp is damaged
_LARGEST_NS = 9.2e18
_SAME_CLOCK_NS = 10 * 10**9


class Clock(NamedTuple):
    """How a column of times is read.

    Attributes:
        per_second: its unit.
        absolute: since 1970; else since the scan's stamp.
    """

    per_second: int
    absolute: bool


def find_time_column(names: Iterable[str]) -> str | None:
    """The name among a cloud's that stands for time."""
    for name in names:
        if name.lower() in NAMES:
            return name
    return None


def detect_clock(values: NDArray[Any], period: float | None) -> Clock | None:
    """The only unit that makes a sweep of a scan's times, or None.

    Args:
        values: (n,) as they are recorded; not finite: unknown.
        period: seconds from scan to scan, None where that is not known.
    """
    values = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if not len(values):
        return None
    first, last = float(values.min()), float(values.max())
    for unit in _UNITS:
        # what began long before it took as long as it did is no time since the scan's beginning
        if _SINCE_1970[0] < first / unit < _SINCE_1970[1] and last - first < 0.01 * first:
            return Clock(unit, True)
    fitting = _within(last - first, _SWEEP)
    if period is not None and period > 0:
        by_period = _within(last - first, (_OF_PERIOD[0] * period, _OF_PERIOD[1] * period))
        fitting = fitting | by_period
    return Clock(fitting.pop(), False) if len(fitting) == 1 else None


def _within(length: float, limits: tuple[float, float]) -> set[int]:
    return {unit for unit in _UNITS if limits[0] <= length / unit <= limits[1]}


def convert_times(
    values: NDArray[Any], usable: NDArray[np.bool_], clock: Clock, stamp_ns: int | None
) -> tuple[int | None, NDArray[np.float64]]:
    """A scan's stamp, and seconds from it to each point, NaN where unknown.

    Args:
        values: (n,) as they are recorded.
        usable: (n,) whether there is a point.
        clock: how they are read.
        stamp_ns: the scan's stamp; None: its first point's, where times are absolute.
    """
    if not clock.absolute:
        return stamp_ns, _short(values.astype(np.float64) / clock.per_second)
    unit = 10**9 // clock.per_second  # ns
    known = usable & np.isfinite(values) & (values > 0) & (values < _LARGEST_NS / unit)
    after = np.full(len(values), np.nan)
    if not known.any():
        return stamp_ns, after
    kept = values[known]
    # whole numbers stay exact
    ns = kept.astype(np.int64) * unit if kept.dtype.kind != "f" else _rounded(kept * float(unit))
    middle = np.partition(ns, len(ns) // 2)[len(ns) // 2]
    first = int(ns[np.abs(ns - middle) < int(_LONGEST * 1e9)].min())
    if stamp_ns is None:
        stamp_ns = first
    same_clock = abs(stamp_ns - first) < _SAME_CLOCK_NS
    after[known] = (ns - (stamp_ns if same_clock else first)) / 1e9
    return stamp_ns, _short(after)


def _rounded(ns: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.round(ns).astype(np.int64)


def _short(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.abs(seconds) <= _LONGEST, seconds, np.nan)
