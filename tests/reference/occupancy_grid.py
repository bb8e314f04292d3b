"""Occupancy grid: the sums alpha and beta of (10) per cell, and moments of the end points."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Cell = tuple[int, ...]


class OccupancyGrid:
    """Sparse alpha, beta per cell, and the first moment of the end points weighted with e.

    Args:
        resolution: edge of a cell, metres.
        dimension: 2 or 3.
    """

    def __init__(self, resolution, dimension):
        if not 0 < resolution < np.inf:
            raise ValueError(f"resolution must be positive, got {resolution}")
        self.resolution = resolution
        self.dimension = dimension
        self.alpha: dict[Cell, float] = {}
        self.beta: dict[Cell, float] = {}
        self.moment: dict[Cell, Float] = {}

    def add(self, cell, alpha, beta, end_point=None):
        """Add to the sums of one cell; `end_point` (D,) metres counts with weight `alpha`."""
        self.alpha[cell] = self.alpha.get(cell, 0.0) + alpha
        self.beta[cell] = self.beta.get(cell, 0.0) + beta
        if end_point is not None:
            before = self.moment.get(cell, np.zeros(self.dimension))
            self.moment[cell] = before + alpha * end_point

    def alpha_beta(self, cells):
        """(K, 2) alpha and beta of cells (K, D); zeros for unobserved cells."""
        keys = [tuple(cell) for cell in np.asarray(cells, np.int64).reshape(-1, self.dimension)]
        pairs = [(self.alpha.get(k, 0.0), self.beta.get(k, 0.0)) for k in keys]
        return np.array(pairs).reshape(-1, 2)

    def occupancy_of(self, cell):
        """m_j of (15), NaN where alpha + beta = 0: unknown."""
        alpha, beta = self.alpha.get(cell, 0.0), self.beta.get(cell, 0.0)
        return alpha / (alpha + beta) if alpha + beta > 0 else float("nan")

    def merge(self, other):
        """Add the sums of another grid of the same resolution and dimension."""
        if (self.resolution, self.dimension) != (other.resolution, other.dimension):
            raise ValueError(
                f"other: expected resolution {self.resolution} in {self.dimension}D,"
                f" got {other.resolution} in {other.dimension}D"
            )
        for cell in other.alpha:
            self.add(cell, other.alpha[cell], other.beta[cell])
        for cell, moment in other.moment.items():
            self.moment[cell] = self.moment.get(cell, np.zeros(self.dimension)) + moment

    def bounding_box(self):
        """First cell (D,) and shape of the bounding box of all observed cells."""
        if not self.alpha:
            return np.zeros(self.dimension, np.int64), (0,) * self.dimension
        cells = np.array(list(self.alpha), np.int64)
        first = cells.min(axis=0)
        return first, tuple((cells.max(axis=0) - first + 1)[::-1].tolist())

    def dense(self, first_cell=None, shape=None):
        """Sums over a box of cells, by default the bounding box.

        Returns:
            first_cell (D,), the cell of the lowest corner; alpha and beta with the axes reversed,
            so that in 2D they are indexed [row = y, column = x].
        """
        if first_cell is None or shape is None:
            first, shape = self.bounding_box()
        else:
            first = np.asarray(first_cell, np.int64)
        alpha, beta = np.zeros(shape), np.zeros(shape)
        for cell in self.alpha:
            index = tuple((np.array(cell) - first)[::-1].tolist())
            if all(0 <= i < n for i, n in zip(index, shape, strict=True)):
                alpha[index], beta[index] = self.alpha[cell], self.beta[cell]
        return first, alpha, beta


OccupancyGrid2D = partial(OccupancyGrid, dimension=2)
OccupancyGrid3D = partial(OccupancyGrid, dimension=3)


def occupancy(alpha, beta):
    """Equation (15): alpha / (alpha + beta), NaN where alpha + beta = 0 (unobserved)."""
    a = np.asarray(alpha, float)
    total = a + np.asarray(beta, float)
    m = np.full(total.shape, np.nan)
    np.divide(a, total, out=m, where=total > 0)
    return m
