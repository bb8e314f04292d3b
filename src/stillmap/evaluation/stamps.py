"""Which of a list of times lies nearest to another time."""

import numpy as np
from numpy.typing import NDArray


def nearest(
    stamps: NDArray[np.float64], at: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Index of the nearest of the sorted `stamps` (N >= 1) for each of `at`, and how far it is.

    Of two as near the earlier one is taken. Any unit; also used for distances along a path.
    """
    after = np.searchsorted(stamps, at).clip(0, len(stamps) - 1)
    before = (after - 1).clip(0)
    index = np.where(np.abs(stamps[before] - at) <= np.abs(stamps[after] - at), before, after)
    return index, np.abs(stamps[index] - at)
