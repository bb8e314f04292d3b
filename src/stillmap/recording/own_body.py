"""What beams meet of the robot itself: always there, and at the same distance, wherever it goes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.options import BEYOND

_FARTHEST = 1.0  # m: robots are not larger
_SAME = (0.03, 0.01)  # m and share of the range by which such readings differ
_ALWAYS = 0.75  # share of the scans in which a beam ends there
_MOVING = 0.3  # of usual beams: while the robot moves, hardly any range is measured again
_AROUND = 2  # beams beside such ones that graze what they hit
_BEHIND = 0.1  # m behind it: an edge is measured too far

Part = tuple[int, int, float]  # first and last beam, and up to where their readings are its own


def find(ranges: NDArray[np.float32], shortest: float) -> tuple[Part, ...]:
    """The beams that end on the robot itself.

    Only a robot that moves shows what moves with it: of a laser that stands all beams end in the
    same places.

    Args:
        ranges: (T, n) metres, one column per beam direction.
        shortest: m; what is nearer is no reading.
    """
    T, n = ranges.shape
    if T < 20 or n < 2:
        return ()
    # codes for no return are as large as floating point numbers can be
    real = np.where((ranges >= shortest) & (ranges < BEYOND), ranges, np.float32(np.inf))
    middle = np.median(real, axis=0)
    with np.errstate(invalid="ignore"):
        away = np.abs(real - middle)
    again = np.mean(away < _SAME[0] + _SAME[1] * middle, axis=0)
    measured = np.isfinite(middle)
    if not measured.any() or np.median(again[measured]) > _MOVING:
        return ()
    own = np.flatnonzero((again >= _ALWAYS) & (middle < _FARTHEST))
    groups = np.split(own, np.flatnonzero(np.diff(own) > 2 * _AROUND) + 1) if len(own) else []
    return tuple(
        (
            max(int(group[0]) - _AROUND, 0),
            min(int(group[-1]) + _AROUND, n - 1),
            round(float(middle[group].max()) + _BEHIND, 3),
        )
        for group in groups
    )


def limits(parts: Any, n: int) -> NDArray[np.float32]:
    """(n,) metres: readings below are of the robot itself."""
    out = np.zeros(n, np.float32)
    for first, last, limit in parts:
        out[first : last + 1] = np.maximum(out[first : last + 1], np.float32(limit))
    return out
