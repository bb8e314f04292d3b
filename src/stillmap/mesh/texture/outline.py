"""The outline of an object in an image, from its points alone."""

import numpy as np
from scipy import ndimage

from stillmap.mesh.types import Float

_CELL = 0.01  # m
_MAX_CELLS = 1 << 10  # along an edge, beyond which cells are larger


def outline_depth(points: Float, radius: float) -> Float:
    """(n,) metres from points (n, 2) to the outline of the area that they cover; 0: on it.

    The area is the union of discs around the points, holes filled, eroded by the same radius.

    Args:
        points: metres, in a plane.
        radius: metres of the discs.
    """
    if not len(points):
        return np.zeros(0)
    cell = max(_CELL, float(np.ptp(points, axis=0).max()) / _MAX_CELLS)
    at = np.floor(points / cell).astype(np.int64)
    border = int(np.ceil(radius / cell)) + 2
    at -= at.min(axis=0) - border
    empty = np.ones(at.max(axis=0) + border + 1, np.bool_)
    empty[at[:, 0], at[:, 1]] = False
    covered = ndimage.distance_transform_edt(empty) * cell <= radius
    away = ndimage.distance_transform_edt(ndimage.binary_fill_holes(covered)) * cell
    return np.asarray(np.maximum(away[at[:, 0], at[:, 1]] - cell - radius, 0.0))
