"""Support of a surfel by static surfels on a line through its cell."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.surfel_map import SurfelMap

DIRECTIONS = 12


def line_support(
    surfel_map: SurfelMap,
    p_static: ArrayLike,
    *,
    radius: float,
    gap: float,
    half_width: float,
    threads: int = 1,  # noqa: ARG001  signature of the kernel
) -> NDArray[np.float64]:
    """(E,) of 12 lines the largest sum of `p_static` (E,) of other surfels on one.

    Lengths are in cells. A surfel is on a line if its cell is `gap` to `radius` away and less than
    `half_width` off the line.
    """
    p = np.asarray(p_static, float)
    cells = np.array([one.cell for one in surfel_map.fitted])
    out = np.zeros(len(p))
    for k, centre in enumerate(cells):
        x, y = (cells - centre).T
        distance = np.hypot(x, y)
        near = (distance >= gap) & (distance <= radius) & (np.arange(len(p)) != k)
        sums = []
        for angle in np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
            across = np.abs(x * np.sin(angle) - y * np.cos(angle))
            sums.append(p[near & (across < half_width)].sum())
        out[k] = max(sums)
    return out
