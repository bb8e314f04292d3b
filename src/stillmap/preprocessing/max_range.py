"""What a laser's readings mean: a hit, maximum range, or nothing.

Drivers report "nothing came back" as a code: a value above all real readings (81.91 m on a SICK
LMS), the largest range itself (a clipped sensor), +inf, or zero. Which one it is shows in the data.
"""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stillmap.preprocessing import self_filter
from stillmap.preprocessing.options import MAX_PLAUSIBLE_RANGE, ReadOptions
from stillmap.preprocessing.self_filter import SelfSector

MAX_ZERO_RANGE = 0.02  # m: a laser's housing is larger, so such a reading stands for something else
FREQUENT_ZEROS = 0.005  # share of zero readings that is no accident
MORE_ZEROS = (
    10.0  # times as many as readings of a value of its own: drivers that have both use zero
)
FREE_QUANTILE = 0.999  # of the hits: as far as the laser really sees

_WINDOW = 0.2  # m below the largest reading in which a code may smear
_BELOW = 1.0  # m below that window: readings that are real
_SICK_CODES = (81.825, 81.92)  # m: overflow values of the LMS 2xx, 8183 to 8191 cm


@dataclass(frozen=True)
class MaxRange:
    """The range from which on a reading is maximum range (None: none is), and how it was found.

    Attributes:
        threshold: m; None where no reading but +inf stands for maximum range.
        how: in words.
        coded: whether the readings themselves showed a code above the real ranges.
    """

    threshold: float | None
    how: str
    coded: bool


@dataclass(frozen=True)
class RangeRule:
    """How one laser's readings are understood. Ranges in metres."""

    threshold: float | None
    threshold_how: str
    zero_means: Literal["unusable", "max-range"]
    zero_how: str
    free_range: float | None  # None: nothing in the recording bounds what such a beam shows
    free_how: str
    min_range: float
    # first and last beam, and up to where their readings are of the robot itself
    self_filter: tuple[SelfSector, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "own_body": [list(part) for part in self.self_filter]}


def find_max_range(ranges: NDArray[np.float32], declared: float | None = None) -> MaxRange:
    """Look for a maximum-range code in the readings of one laser.

    A code is a value at the very top that repeats exactly (or nearly), in many directions. The
    farthest wall also ends the readings, but cm noise spreads it over many values, and while the
    robot stands it keeps to few, neighbouring directions: such a value must repeat more purely
    and stand off from the other readings.

    Args:
        ranges: (T, n) float32 readings, one column per beam direction; (n,) is one scan.
        declared: m, what the recording itself names as the largest range; None: nothing.
    """
    ranges = np.atleast_2d(np.asarray(ranges, np.float32))
    if declared is not None and not 0.0 < declared < MAX_PLAUSIBLE_RANGE:
        declared = None
    real = ranges[(ranges >= MAX_ZERO_RANGE) & (ranges < MAX_PLAUSIBLE_RANGE)]
    found = _code(ranges, real) if real.size else None
    if declared is not None and (found is None or declared < found[0]):
        also = f"; {found[1]}" if found else ""
        return MaxRange(declared, f"declared in the recording{also}", found is not None)
    if found is not None:
        return MaxRange(found[0], found[1], True)
    if np.any(ranges >= MAX_PLAUSIBLE_RANGE):
        return MaxRange(None, "only infinite readings", False)
    return MaxRange(None, "no code among the readings and none declared", False)


def _code(ranges: NDArray[np.float32], real: NDArray[np.float32]) -> tuple[float, str] | None:
    top = _decimal(real.max())
    if _SICK_CODES[0] <= top <= _SICK_CODES[1]:
        codes = real[real >= np.float32(_SICK_CODES[0])]
        return _decimal(
            codes.min()
        ), f"SICK overflow values from {codes.min():.2f} m ({codes.size} x)"
    values, counts = np.unique(real[real >= top - _WINDOW - _BELOW], return_counts=True)
    at_top = values >= top - _WINDOW
    mode = int(np.argmax(np.where(at_top, counts, 0)))
    per_cm = float(counts[~at_top].sum()) / (100.0 * _BELOW)
    if not _is_code(ranges, values, counts, mode):
        return None
    # values that smear around the code stand out from the real readings below as it does; with
    # nothing below, all are
    values, counts = values[at_top], counts[at_top]
    mode -= int(np.count_nonzero(~at_top))
    enough = 1.0 if per_cm == 0.0 else max(5.0, 20.0 * per_cm)
    lowest = _decimal(min(values[mode], values[counts >= enough].min(initial=np.inf)))
    n_codes = int(counts[values >= np.float32(lowest)].sum())
    return lowest, f"{values[mode]:.2f} m repeats at the top of the readings ({n_codes} x)"


def _decimal(value: np.float32) -> float:
    """The number as the recording writes it: 81.83, not its nearest binary neighbour."""
    return float(str(np.float32(value)))


def _is_code(
    ranges: NDArray[np.float32],
    values: NDArray[np.float32],
    counts: NDArray[np.intp],
    mode: int,
) -> bool:
    """Whether values[mode] is a code (see `find_max_range`).

    Noise of 1 cm gives the next value 60 % of the count of the most frequent one in readings
    rounded to cm; codes that smear (81.87, 81.89, 81.91) still repeat one value 5 times as often.
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
    ranges: NDArray[np.float32], declared: float | None, options: ReadOptions
) -> tuple[RangeRule, list[str]]:
    """The rule for one laser's readings (T, n), and warnings in words."""
    found = find_max_range(ranges, declared)
    threshold, how, warnings = found.threshold, found.how, []
    if options.max_range is not None:
        threshold, how = options.max_range, "given"
        if found.coded and found.threshold is not None and found.threshold < options.max_range:
            warnings.append(
                f"max_range {options.max_range:g} m is above what looks like a maximum-range code "
                f"({found.how}): those readings count as hits"
            )
    no_return = ranges >= np.float32(MAX_PLAUSIBLE_RANGE if threshold is None else threshold)
    coded = (
        found.coded
        or bool(np.any(ranges >= MAX_PLAUSIBLE_RANGE))
        or no_return.mean() > FREQUENT_ZEROS
    )
    share = float(no_return.mean()) if coded and ranges.size else 0.0
    zero_means, zero_how = _zero_meaning(ranges, share, options.zero_means)
    is_hit = (ranges >= np.float32(max(options.min_range, MAX_ZERO_RANGE))) & ~no_return
    free, free_how = _free_range(ranges[is_hit], threshold, options.free_range)
    shortest = max(options.min_range, MAX_ZERO_RANGE)
    own = (
        self_filter.find_self_sectors(np.atleast_2d(ranges), shortest)
        if options.self_filter
        else ()
    )
    rule = RangeRule(threshold, how, zero_means, zero_how, free, free_how, options.min_range, own)
    if free is None:
        warnings.append("no reading shows how far the laser sees: maximum-range beams are unusable")
    return rule, warnings


def _zero_meaning(
    ranges: NDArray[np.float32], own: float, wanted: Literal["auto", "unusable", "max-range"]
) -> tuple[Literal["unusable", "max-range"], str]:
    """What zero stands for where a share `own` of the readings is another value for no return."""
    if wanted != "auto":
        return wanted, "given"
    share = float(np.mean((ranges >= 0.0) & (ranges < MAX_ZERO_RANGE))) if ranges.size else 0.0
    text = f"{100.0 * share:.2f} % of the readings are zero"
    if own > 0.0 and share <= MORE_ZEROS * own:
        return "unusable", f"{text}; no return has its own value"
    if share > FREQUENT_ZEROS:
        other = "hardly any other" if own > 0.0 else "no other"
        return "max-range", f"{text} and {other} value stands for no return"
    return "unusable", text


def _free_range(
    hits: NDArray[np.float32], threshold: float | None, wanted: float | None
) -> tuple[float | None, str]:
    """How far a maximum-range beam is known to be free.

    A code of 81.91 m does not show 81.91 m of free space on a laser that sees 20 m: beyond what
    it ever sees, no return says nothing. So: the 99.9 % quantile of its hits, at most the
    threshold.
    """
    if wanted is not None:
        return wanted, "given"
    if hits.size == 0:
        return threshold, "the maximum range: there are no hits to tell"
    seen = _decimal(np.quantile(hits, FREE_QUANTILE, method="lower"))
    if threshold is not None and threshold <= seen:
        return threshold, "the maximum range"
    return seen, f"{100.0 * FREE_QUANTILE:g} % of the hits are nearer"


def apply_range_rule(
    ranges: NDArray[np.float32], rule: RangeRule
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Lengths of the beams (NaN: unusable) and whether each hit something, shaped as `ranges`."""
    threshold = np.float32(MAX_PLAUSIBLE_RANGE if rule.threshold is None else rule.threshold)
    zero = (ranges >= 0.0) & (ranges < MAX_ZERO_RANGE)
    no_return = (ranges >= threshold) | (zero & (rule.zero_means == "max-range"))
    nearest: Any = np.float32(max(rule.min_range, MAX_ZERO_RANGE))
    if rule.self_filter:
        nearest = np.maximum(nearest, self_filter.min_ranges(rule.self_filter, ranges.shape[-1]))
    hit = (ranges >= nearest) & (ranges < threshold)
    free = np.nan if rule.free_range is None else rule.free_range
    length = np.where(no_return, np.float32(free), np.where(hit, ranges, np.float32(np.nan)))
    return length.astype(np.float32, copy=False), hit
