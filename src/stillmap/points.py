"""Plain arrays of points (N, D), and of whole numbers for them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def finite(points: NDArray[Any]) -> NDArray[np.bool_]:
    """(N,) whether every coordinate of points (N, D) is finite.

    Column by column: `all` over rows of two or three takes ten times as long.
    """
    out = np.asarray(np.isfinite(points[:, 0]))
    for column in points.T[1:]:
        out &= np.isfinite(column)
    return out


def first_of_each(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each group occurs first, by rising groups: `np.unique(..., return_index=True)[1]`.

    Args:
        group: (N,) not negative; below 2^62 / N.
    """
    bits = max(len(group) - 1, 1).bit_length()
    key = np.sort((group << bits) | np.arange(len(group)))  # faster than any sort of indices
    return key[np.diff(key >> bits, prepend=-1) > 0] & ((1 << bits) - 1)
