"""Boxes for dense arrays of squares: around everything seen, or around most of it.

One pose that is kilometres off makes the box around all squares nearly empty, and too large for
memory and disk. So a box that is much larger than what was seen shrinks: to the place where most
was seen, whole if it is connected, and to what lies near it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.components import adjacent_pairs, component_labels

Squares = NDArray[np.int64]

_MOST_PER_SEEN = 64  # squares of a box for each that was seen
_GAP = 16  # squares, about, between parts of one place, which stays whole


class SquareBox(NamedTuple):
    """A box of squares, bounds included.

    Attributes:
        low, high: (2,) lowest and highest column and row.
    """

    low: Squares
    high: Squares

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        width, height = (self.high - self.low + 1).tolist()
        return height, width

    @property
    def area(self) -> int:
        """Number of squares."""
        return math.prod(self.shape)

    def contains(self, squares: NDArray[Any]) -> NDArray[np.bool_]:
        """(N,) whether squares (N, 2) lie in the box."""
        return np.asarray(((squares >= self.low) & (squares <= self.high)).all(axis=1))


def bound_box(
    squares: Squares,
    least: int,
    most: int,
    *,
    places: NDArray[np.int64] | None = None,
    around: SquareBox | None = None,
) -> SquareBox:
    """The box around squares; of a box nearly empty, the part around where most of them are.

    Args:
        squares: (N, 2) columns and rows, at least one; they may repeat.
        least: area up to which every box is whole.
        most: area that no box exceeds.
        places: (K, 2) squares of which the part has to hold most; None: `squares`.
        around: a larger box, to be returned if it is not nearly empty; None: none.
    """
    whole = SquareBox(squares.min(axis=0), squares.max(axis=0)) if around is None else around
    if whole.area <= least:
        return whole
    limit = min(max(least, _MOST_PER_SEEN * len(np.unique(_keys(squares)))), most)
    if whole.area <= limit:
        return whole
    center = find_busiest(squares if places is None else places, math.isqrt(limit) // 2)
    distance = np.abs(squares - center).max(axis=1)
    joined = _find_joined(squares, distance)
    order = np.lexsort((distance, ~joined))
    low = np.minimum.accumulate(squares[order], axis=0)
    high = np.maximum.accumulate(squares[order], axis=0)
    areas = (high - low + 1).astype(np.float64).prod(axis=1)  # of the boxes around the first
    limit = min(max(limit, int(areas[np.count_nonzero(joined) - 1])), most)
    last = int(np.searchsorted(areas, float(limit), side="right")) - 1
    return SquareBox(low[last], high[last])


def _find_joined(squares: Squares, distance: Squares) -> NDArray[np.bool_]:
    """(N,) squares that others without larger gaps join to the one at the least distance (N,)."""
    large, of = np.unique(squares // _GAP, axis=0, return_inverse=True)
    part = component_labels(adjacent_pairs(large), len(large))[of.reshape(-1)]
    return np.asarray(part == part[np.argmin(distance)])


def find_busiest(places: Squares, edge: int) -> Squares:
    """(2,) median of the places (K, 2) in the square of `edge` places that holds most of them."""
    keys = _keys(places // max(edge, 1))
    number, count = np.unique(keys, return_counts=True)
    chosen = places[keys == number[np.argmax(count)]]
    middle: Squares = np.sort(chosen, axis=0)[len(chosen) // 2]
    return middle


def _keys(squares: Squares) -> Squares:
    """(N,) a number for each square (N, 2)."""
    return np.asarray((squares[:, 0] << 32) + squares[:, 1])
