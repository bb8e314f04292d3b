"""The map of (15) as plain arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import _core


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """A 2D map.

    Attributes:
        p_occupied: (H, W) float32, alpha / (alpha + beta) of (15); NaN where nobody looked:
            unknown is not free. Row 0 has the lowest y.
        alpha: (H, W) float64, expected number of static hits.
        beta: (H, W) float64, expected number of dynamic hits + beam length through the cell.
        origin: x, y (metres) and yaw of the lower-left corner of the lower-left cell.
        resolution: metres.
    """

    p_occupied: NDArray[np.float32]
    alpha: NDArray[np.float64]
    beta: NDArray[np.float64]
    origin: tuple[float, float, float]
    resolution: float


def occupancy_map(grid: _core.Grid2D) -> OccupancyMap:
    """The closed-form maximum (15) of the counts in a grid."""
    first_cell, alpha, beta = grid.dense()
    p_occupied = np.full(alpha.shape, np.nan, dtype=np.float32)
    for a, b, p in zip(alpha, beta, p_occupied, strict=True):  # by rows: maps are large
        total = a + b
        np.divide(a, total, out=p, where=total > 0.0, casting="same_kind")  # (15)
    x, y = (float(c) * grid.resolution for c in first_cell)
    return OccupancyMap(p_occupied, alpha, beta, (x, y, 0.0), grid.resolution)
