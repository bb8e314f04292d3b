"""Cells and chord lengths along a segment: the l_j of the last paragraph of Sect. 3."""

import numpy as np


def cell_of(point, resolution):
    """(..., D) integer cells of points (..., D) in metres: floor(x / resolution)."""
    return np.floor(np.asarray(point, float) / resolution).astype(np.int64)


def traverse(start, end, resolution):
    """Cells of a segment in order, start cell first and end cell last, with chord lengths.

    Neighbours in the list differ by one step along one axis. A segment through a corner passes
    one more cell with length zero.

    Args:
        start: (D,) metres.
        end: (D,) metres.
        resolution: edge of a cell, metres.

    Returns:
        cells (K, D), K = 1 + sum of |end cell - start cell|, and lengths (K,) in units of cells,
        which sum to |end - start| / resolution.

    Raises:
        ValueError: points that are not finite, or a resolution that is not positive.
    """
    a, b = np.asarray(start, float), np.asarray(end, float)
    if a.ndim != 1 or a.shape != b.shape:
        raise ValueError(f"end: expected shape {a.shape} like start, got {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("start and end must be finite")
    if not resolution > 0:
        raise ValueError(f"resolution must be positive, got {resolution}")
    first, last = cell_of(a, resolution), cell_of(b, resolution)
    crossings = _crossings(a / resolution, b / resolution, first, last)
    cells = [first]
    for _, axis, step in crossings:
        cell = cells[-1].copy()
        cell[axis] += step
        cells.append(cell)
    t = np.array([0.0, *(crossing[0] for crossing in crossings), 1.0])
    return np.array(cells), np.diff(t) * np.linalg.norm(b - a) / resolution


def _crossings(a, b, first, last):
    """(where along the segment in [0, 1], axis, +1 or -1) of each border crossed, in order."""
    found = []
    for axis in range(len(a)):
        step = 1 if last[axis] > first[axis] else -1
        for cell in range(first[axis], last[axis], step):
            border = cell + 1 if step > 0 else cell
            t = (border - a[axis]) / (b[axis] - a[axis])
            found.append((min(max(float(t), 0.0), 1.0), axis, step))
    return sorted(found, key=lambda crossing: crossing[0])
