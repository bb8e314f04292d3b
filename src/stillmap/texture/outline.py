"""How far within the outline of a thing its points lie, by nothing but these points."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Float = NDArray[np.float64]

_CELL = 0.01  # m
_MOST_CELLS = 1 << 10  # along an edge, beyond which they are larger


def depth_inside(points: Float, apart: float) -> Float:
    """(n,) metres from points (n, 2) to the edge of what they cover; 0: they are its edge.

    They cover discs of `apart` metres around each, and what these enclose, less a seam as wide.

    Args:
        points: metres, in a plane.
        apart: farther apart than twice that they are of two pieces.
    """
    if not len(points):
        return np.zeros(0)
    cell = max(_CELL, float(np.ptp(points, axis=0).max()) / _MOST_CELLS)
    at = np.floor(points / cell).astype(np.int64)
    beside = int(np.ceil(apart / cell)) + 2
    at -= at.min(axis=0) - beside
    empty = np.ones(at.max(axis=0) + beside + 1, np.bool_)
    empty[at[:, 0], at[:, 1]] = False
    covered = ndimage.distance_transform_edt(empty) * cell <= apart
    away = ndimage.distance_transform_edt(ndimage.binary_fill_holes(covered)) * cell
    return np.asarray(np.maximum(away[at[:, 0], at[:, 1]] - cell - apart, 0.0))
