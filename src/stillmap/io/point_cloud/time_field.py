"""Time field of a point cloud: detection of its unit, conversion to seconds after the stamp."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.timestamps import MAX_BEAM_TIME, MAX_STAMP_NS

NAMES = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")

_UNITS = (1, 10**3, 10**6, 10**9)  # per second: s, ms, us, ns
_SINCE_1970 = (6e8, 5e9)  # s: the years 1989 to 2128
# the limits differ by less than 1000: at most one unit fits
_SCAN_DURATION = (0.005, 2.0)  # s
_PERIOD_SHARE = (0.05, 1.5)  # duration of a scan over the time between stamps
_SAME_CLOCK_NS = 10 * 10**9


class Clock(NamedTuple):
    """Unit and epoch of a time column.

    Attributes:
        per_second: units per second.
        absolute: times count from 1970; else from the scan's stamp.
    """

    per_second: int
    absolute: bool


def find_time_column(names: Iterable[str]) -> str | None:
    """The name of the time column; None: there is none."""
    for name in names:
        if name.lower() in NAMES:
            return name
    return None


def detect_clock(values: NDArray[Any], period: float | None) -> Clock | None:
    """The one unit that gives a scan a plausible duration; None: none or several.

    Args:
        values: (n,) as recorded; not finite: unknown.
        period: seconds between stamps; None: unknown.
    """
    values = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if not len(values):
        return None
    first, last = float(values.min()), float(values.max())
    for unit in _UNITS:
        # absolute times differ by little within a scan
        if _SINCE_1970[0] < first / unit < _SINCE_1970[1] and last - first < 0.01 * first:
            return Clock(unit, True)
    fitting = _matching_units(last - first, _SCAN_DURATION)
    if period is not None and period > 0:
        by_period = _matching_units(
            last - first, (_PERIOD_SHARE[0] * period, _PERIOD_SHARE[1] * period)
        )
        fitting = fitting | by_period
    return Clock(fitting.pop(), False) if len(fitting) == 1 else None


def _matching_units(duration: float, limits: tuple[float, float]) -> set[int]:
    return {unit for unit in _UNITS if limits[0] <= duration / unit <= limits[1]}


def convert_times(
    values: NDArray[Any], usable: NDArray[np.bool_], clock: Clock, stamp_ns: int | None
) -> tuple[int | None, NDArray[np.float64]]:
    """The stamp of a scan, and seconds (n,) from it to each point, NaN where unknown.

    Args:
        values: (n,) as recorded.
        usable: (n,) mask of valid points.
        clock: unit and epoch.
        stamp_ns: stamp of the scan; None: the first absolute time.
    """
    if not clock.absolute:
        return stamp_ns, _drop_outliers(values.astype(np.float64) / clock.per_second)
    unit = 10**9 // clock.per_second  # ns
    known = usable & np.isfinite(values) & (values > 0) & (values < MAX_STAMP_NS / unit)
    after = np.full(len(values), np.nan)
    if not known.any():
        return stamp_ns, after
    kept = values[known]
    # integers stay exact
    ns = kept.astype(np.int64) * unit if kept.dtype.kind != "f" else _round(kept * float(unit))
    middle = np.partition(ns, len(ns) // 2)[len(ns) // 2]
    first = int(ns[np.abs(ns - middle) < int(MAX_BEAM_TIME * 1e9)].min())
    if stamp_ns is None:
        stamp_ns = first
    same_clock = abs(stamp_ns - first) < _SAME_CLOCK_NS
    after[known] = (ns - (stamp_ns if same_clock else first)) / 1e9
    return stamp_ns, _drop_outliers(after)


def _round(ns: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.round(ns).astype(np.int64)


def _drop_outliers(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.abs(seconds) <= MAX_BEAM_TIME, seconds, np.nan)
