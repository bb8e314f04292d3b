"""Angles between the neighbouring beams of a lidar or a depth camera."""

import numpy as np
from numpy.typing import NDArray

_AZIMUTH = 0.006  # rad, of a pixel; lidars have finer steps than that
_MIN_ELEVATION, _MAX_ELEVATION, _FACTOR = 0.005, 0.07, 1.15  # rad
# share of the pixels between the lowest and the highest beam of their column that beams fill
_FILLED = 0.8


def find_pixel_size(points: NDArray[np.float32], hit: NDArray[np.bool_]) -> tuple[float, float]:
    """Azimuth and elevation (rad) of the smallest pixels that hardly any gaps lie between.

    Args:
        points: (N, 3) of one sweep, in the sensor frame.
        hit: (N,).
    """
    x, y, z = points[hit].T.astype(np.float64)
    if not len(x):
        return _AZIMUTH, _MAX_ELEVATION
    column = np.floor(np.arctan2(y, x) / _AZIMUTH).astype(np.int64)
    elevation = np.arctan2(z, np.hypot(x, y))
    edge = _MIN_ELEVATION
    while edge < _MAX_ELEVATION and _filled_share(column, elevation, edge) < _FILLED:
        edge *= _FACTOR
    return _AZIMUTH, min(edge, _MAX_ELEVATION)


def _filled_share(column: NDArray[np.int64], elevation: NDArray[np.float64], edge: float) -> float:
    row = np.floor(elevation / edge).astype(np.int64)
    filled = len(np.unique(np.stack([column, row]), axis=1).T)
    order = np.argsort(column, kind="stable")
    first = np.flatnonzero(np.diff(column[order], prepend=column[order[0]] - 1))
    low, high = (f.reduceat(row[order], first) for f in (np.minimum, np.maximum))
    return filled / float((high - low + 1).sum())
