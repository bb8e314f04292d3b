"""Maximum range of a laser: which readings are hits, maximum-range beams, or unusable.

Drivers encode "no return" as a value above all real readings (81.91 m on a SICK LMS), as the
maximum range itself (a clipped sensor), as +inf, or as zero. The readings show which.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from stillmap.core.array_types import Bool, Float32, Index
from stillmap.core.errors import advise
from stillmap.core.source import RangeRule
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE, ReadOptions

SelfSector = tuple[int, int, float]  # first and last beam, maximum range (m) of self returns

MAX_ZERO_RANGE = 0.02  # m: smaller than the housing of a laser, so such a reading is a code
MIN_ZERO_SHARE = 0.005  # of the readings: zero is a code
MIN_ZERO_RATIO = 10.0  # zeros over other no-return readings, where drivers have both
FREE_QUANTILE = 0.999  # of the hits: the range up to which the laser detects obstacles

# how a range is known, where somebody says so
GIVEN, DECLARED = "given", "declared in the recording"

_CODE_WINDOW = 0.2  # m below the largest reading: noise of a code
_REFERENCE_WINDOW = 1.0  # m below that: real readings
_SICK_CODES = (81.825, 81.92)  # m: overflow values of the LMS 2xx, 8183 to 8191 cm

_MAX_SELF_RANGE_2D = 1.0  # m
_SAME_RANGE = (0.03, 0.01)  # m plus share of the range
_MIN_SHARE_2D = 0.75  # share of scans in which a beam repeats its median range
_MAX_REPEATED = 0.3  # median share over all beams: more is a standing robot
_NEIGHBOURS = 2  # beams beside, which graze the same edge
_RANGE_MARGIN = 0.1  # m: edges are measured too far


@dataclass(frozen=True)
class MaxRange:
    """Detected maximum range.

    Attributes:
        threshold: m, readings from it on are maximum range; None: only +inf is.
        how: description of the evidence.
        coded: whether the readings show a code above the real ranges.
    """

    threshold: float | None
    how: str
    coded: bool


def find_max_range(ranges: Float32, declared: float | None = None) -> MaxRange:
    """Find the maximum-range code in the readings of one laser.

    A code is a value at the top that repeats (nearly) exactly in many directions. The farthest
    wall also bounds the readings, but noise spreads it over many values, and while the robot
    stands it keeps to few neighbouring directions: there a code must repeat more purely.

    Args:
        ranges: (T, n) float32 readings, one column per beam direction; (n,) is one scan.
        declared: m, maximum range stated in the recording; None: not stated.
    """
    ranges = np.atleast_2d(np.asarray(ranges, np.float32))
    if declared is not None and not 0.0 < declared < MAX_PLAUSIBLE_RANGE:
        declared = None
    real = ranges[(ranges >= MAX_ZERO_RANGE) & (ranges < MAX_PLAUSIBLE_RANGE)]
    code = _find_code(ranges, real) if real.size else None
    if declared is not None and (code is None or declared < code[0]):
        also = f"; {code[1]}" if code else ""
        return MaxRange(declared, f"{DECLARED}{also}", code is not None)
    if code is not None:
        return MaxRange(code[0], code[1], True)
    if np.any(ranges >= MAX_PLAUSIBLE_RANGE):
        return MaxRange(None, "only infinite readings", False)
    return MaxRange(None, "no code among the readings and none declared", False)


def _find_code(ranges: Float32, real: Float32) -> tuple[float, str] | None:
    top = _decimal(real.max())
    if _SICK_CODES[0] <= top <= _SICK_CODES[1]:
        codes = real[real >= np.float32(_SICK_CODES[0])]
        how = f"SICK overflow values from {codes.min():.2f} m ({codes.size} x)"
        return _decimal(codes.min()), how
    longest = real[real >= top - _CODE_WINDOW - _REFERENCE_WINDOW]
    values, counts = np.unique(longest, return_counts=True)
    at_top = values >= top - _CODE_WINDOW
    mode = int(np.argmax(np.where(at_top, counts, 0)))
    per_cm = float(counts[~at_top].sum()) / (100.0 * _REFERENCE_WINDOW)
    if not _is_code(ranges, values, counts, mode):
        return None
    # noisy values of the code exceed the count of real readings per value below
    values, counts = values[at_top], counts[at_top]
    mode -= int(np.count_nonzero(~at_top))
    min_count = 1.0 if per_cm == 0.0 else max(5.0, 20.0 * per_cm)
    lowest = _decimal(min(values[mode], values[counts >= min_count].min(initial=np.inf)))
    n_codes = int(counts[values >= np.float32(lowest)].sum())
    return lowest, f"{values[mode]:.2f} m repeats at the top of the readings ({n_codes} x)"


def _decimal(value: np.float32) -> float:
    """The shortest decimal of a float32: 81.83, not its binary neighbour."""
    return float(str(np.float32(value)))


def _is_code(ranges: Float32, values: Float32, counts: Index, mode: int) -> bool:
    """True if values[mode] is a code (see `find_max_range`).

    With noise of 1 cm and readings rounded to cm, the second value has 60 % of the count of the
    mode; noisy codes (81.87, 81.89, 81.91) still repeat one value 5 times as often.
    """
    count, value = int(counts[mode]), values[mode]
    if count < 5:
        return False
    contrast = count / max(int(np.delete(counts, mode).max(initial=0)), 1)
    directions = np.any(ranges == value, axis=0)
    runs = int(np.count_nonzero(np.diff(directions.astype(np.int8), prepend=0) == 1))
    if runs >= 3 or directions.mean() >= 0.25:
        return contrast >= 4.0
    return count >= 30 and contrast >= 50.0


def infer_range_rule(
    ranges: Float32, declared: float | None, options: ReadOptions
) -> tuple[RangeRule, list[str]]:
    """Infer the rule for the readings (T, n) of one laser, and warnings."""
    limit = find_max_range(ranges, declared)
    threshold, how, warnings = limit.threshold, limit.how, []
    if options.max_range is not None:
        threshold, how = options.max_range, GIVEN
        if limit.coded and limit.threshold is not None and limit.threshold < options.max_range:
            warnings.append(
                f"max_range {options.max_range:g} m exceeds a likely maximum-range code "
                f"({limit.how}), whose readings count as hits"
            )
    no_return = ranges >= np.float32(MAX_PLAUSIBLE_RANGE if threshold is None else threshold)
    has_infinite = bool(np.any(ranges >= MAX_PLAUSIBLE_RANGE))
    coded = limit.coded or has_infinite or no_return.mean() > MIN_ZERO_SHARE
    share = float(no_return.mean()) if coded and ranges.size else 0.0
    zero_means = _zero_meaning(ranges, share, options.zero_means)
    is_hit = (ranges >= np.float32(max(options.min_range, MAX_ZERO_RANGE))) & ~no_return
    free = options.free_range or _free_range(ranges[is_hit], threshold)
    sectors: tuple[SelfSector, ...] = ()
    if options.self_filter:
        min_range = max(options.min_range, MAX_ZERO_RANGE)
        sectors = find_self_sectors(np.atleast_2d(ranges), min_range)
    rule = RangeRule(threshold, how, zero_means, free, options.min_range, sectors)
    if free is None:
        what = "the maximum range of the laser is unknown: maximum-range beams are unusable"
        todo = "give it by read.max_range, so that they show free space"
        warnings.append(advise(what, todo))
    return rule, warnings


def _zero_meaning(
    ranges: Float32, no_return_share: float, option: Literal["auto", "unusable", "max-range"]
) -> Literal["unusable", "max-range"]:
    """Meaning of zero, where a share of the readings has another value for no return."""
    if option != "auto":
        return option
    share = float(np.mean((ranges >= 0.0) & (ranges < MAX_ZERO_RANGE))) if ranges.size else 0.0
    least = MIN_ZERO_RATIO * no_return_share
    return "max-range" if share > max(MIN_ZERO_SHARE, least) else "unusable"


def _free_range(hits: Float32, threshold: float | None) -> float | None:
    """Range up to which a maximum-range beam is free.

    A code of 81.91 m shows no 81.91 m of free space on a laser that detects obstacles up to 20 m:
    the 99.9 % quantile of its hits, at most the threshold.
    """
    if hits.size == 0:
        return threshold
    seen = _decimal(np.quantile(hits, FREE_QUANTILE, method="lower"))
    return seen if threshold is None else min(seen, threshold)


def apply_range_rule(ranges: Float32, rule: RangeRule) -> tuple[Float32, Bool]:
    """Beam lengths (NaN: unusable) and hit mask, in the shape of `ranges`."""
    threshold = np.float32(MAX_PLAUSIBLE_RANGE if rule.threshold is None else rule.threshold)
    zero = (ranges >= 0.0) & (ranges < MAX_ZERO_RANGE)
    no_return = (ranges >= threshold) | (zero & (rule.zero_means == "max-range"))
    min_range: Any = np.float32(max(rule.min_range, MAX_ZERO_RANGE))
    if rule.self_filter:
        min_range = np.maximum(min_range, min_ranges(rule.self_filter, ranges.shape[-1]))
    hit = (ranges >= min_range) & (ranges < threshold)
    free = np.nan if rule.free_range is None else rule.free_range
    length = np.where(no_return, np.float32(free), np.where(hit, ranges, np.float32(np.nan)))
    return length.astype(np.float32, copy=False), hit


def find_self_sectors(ranges: Float32, min_range: float) -> tuple[SelfSector, ...]:
    """Find the beams of a 2D laser that end on the robot itself; () for a standing robot.

    Args:
        ranges: (T, n) metres, one column per beam direction.
        min_range: m, ranges below are unusable.
    """
    T, n = ranges.shape
    if T < 20 or n < 2:
        return ()
    # codes for no return are as large as float32 allows
    is_valid = (ranges >= min_range) & (ranges < MAX_PLAUSIBLE_RANGE)
    valid = np.where(is_valid, ranges, np.float32(np.inf))
    median = np.median(valid, axis=0)
    with np.errstate(invalid="ignore"):
        deviation = np.abs(valid - median)
    repeated = np.mean(deviation < _SAME_RANGE[0] + _SAME_RANGE[1] * median, axis=0)
    measured = np.isfinite(median)
    if not measured.any() or np.median(repeated[measured]) > _MAX_REPEATED:
        return ()
    on_robot = np.flatnonzero((repeated >= _MIN_SHARE_2D) & (median < _MAX_SELF_RANGE_2D))
    gaps = np.flatnonzero(np.diff(on_robot) > 2 * _NEIGHBOURS) + 1
    groups = np.split(on_robot, gaps) if len(on_robot) else []
    return tuple(
        (
            max(int(group[0]) - _NEIGHBOURS, 0),
            min(int(group[-1]) + _NEIGHBOURS, n - 1),
            round(float(median[group].max()) + _RANGE_MARGIN, 3),
        )
        for group in groups
    )


def min_ranges(sectors: Iterable[SelfSector], n: int) -> Float32:
    """(n,) range of each beam in metres below which readings are returns from the robot."""
    out = np.zeros(n, np.float32)
    for first, last, limit in sectors:
        out[first : last + 1] = np.maximum(out[first : last + 1], np.float32(limit))
    return out
