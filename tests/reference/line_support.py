"""Support of a surfel by static surfels on a line through its cell."""

# ruff: noqa: ARG001  (threads: as the kernels have it)

import numpy as np

DIRECTIONS = 12


def line_support(surfel_map, p_static, *, radius, gap, half_width, threads=1):
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
