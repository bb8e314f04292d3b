"""The position of a leaf in which it rests: surface that seemed never to leave.

Of a door that stands open for most of the time only its shut position changes. The leaf then is a
straight free end of surface as long as the changed line, from one end of that line.
"""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Cells, Float

_MIN_LENGTH, _MAX_LENGTH = 0.4, 1.4  # m, of the changed line
_MAX_WIDTH = 5.0  # cells of it across
_MIN_ON_LINE, _REFITS = 0.65, 3  # share of the cells of the change
_MAX_HIDDEN = 0.15  # m of the line that is not seen to change beside the jambs
_ANGLES = np.radians(np.arange(40.0, 161.0, 3.0))  # between both positions
MIN_COVERED, MIN_EXACT = 0.85, 0.5  # share of the leaf within a cell of surface, and on it
_MIN_CLEAR = 0.9  # share of the cells beside the leaf that are none
_ASIDE = 3.0  # cells to both sides of it
NEAR_HINGE = 0.3  # of the leaf, where the wall is beside it
_BEYOND = (2.5, 5.0)  # cells beyond its end, which is free


class Line(NamedTuple):
    """A straight row of cells: its middle, unit direction, and length in cells."""

    middle: Float
    along: Float
    length: float


def find_resting_leaf(changed: Cells, surface: Cells, resolution: float) -> Cells:
    """(L, 2) cells of the surface that are a leaf whose other position is the changed line.

    Args:
        changed: (K, 2) cells of a change.
        surface: (S, 2) occupied cells that did not change.
        resolution: m, edge of a cell.

    Returns:
        the cells of the leaf; none where there is no such leaf.
    """
    none = np.empty((0, 2), np.int64)
    line = fit_line(changed, resolution)
    if line is None:
        return none
    field = SurfaceField(surface, line.middle, 1.5 * line.length + 10.0)
    best: tuple[float, Cells] = 0.0, none
    most = round(_MAX_HIDDEN / resolution)
    for end, at_hinge in itertools.product((-1.0, 1.0), range(most + 1)):
        hinge = line.middle + end * (0.5 * line.length + at_hinge) * line.along
        for at_end in range(most + 1 - at_hinge):
            length = line.length + at_hinge + at_end
            rated = _rate_leaves(field, hinge, length, -end * line.along)
            if rated is None:
                break  # there is less of a longer one
            best = max(best, rated, key=lambda candidate: candidate[0])
    return best[1]


def fit_line(cells: Cells, resolution: float) -> Line | None:
    """The line along which most of the cells lie."""
    kept = cells
    for _ in range(_REFITS):
        middle = kept.mean(axis=0)
        along = np.linalg.svd(kept - middle, full_matrices=False)[2][0]
        off = (cells - middle) @ np.array([-along[1], along[0]])
        kept = cells[np.abs(off) <= _MAX_WIDTH / 2.0]
        if len(kept) < max(_MIN_ON_LINE * len(cells), 2.0):
            return None
    at = (kept - middle) @ along
    length = float(np.ptp(at)) + 1.0
    if not _MIN_LENGTH <= length * resolution <= _MAX_LENGTH:
        return None
    return Line(middle + 0.5 * (at.max() + at.min()) * along, along, length)


class SurfaceField:
    """Which cells are surface, and which have some within a cell, in a box from `low` on.

    Attributes:
        cells: (K, 2) those of the surface.
        is_surface, is_near: see `sample`.
    """

    def __init__(self, surface: Cells, middle: Float, reach: float) -> None:
        """Those of cells (S, 2) that are within `reach` of a point along both axes."""
        self.cells = surface[(np.abs(surface - middle) < reach).all(axis=1)]
        size = 2 * math.ceil(reach) + 6
        self.low = np.floor(middle - reach).astype(np.int64) - 2
        self.is_surface, self.is_near = np.zeros((2, size, size), bool)
        self.is_surface[tuple((self.cells - self.low).T)] = True
        padded = np.pad(self.is_surface, 1)
        for i in range(3):
            for j in range(3):
                self.is_near |= padded[i : i + size, j : j + size]

    def sample(self, layer: Bool, points: NDArray[Any]) -> Bool:
        """(...,) of a layer at points (..., 2) in cells; outside False."""
        at = np.round(points).astype(np.int64) - self.low
        inside = ((at >= 0) & (at < layer.shape[0])).all(axis=-1)
        out = np.zeros(points.shape[:-1], bool)
        out[inside] = layer[tuple(at[inside].T)]
        return out

    def cells_along(self, row: Float, across: Float) -> Cells:
        """(K, 2) those of a row of points (n, 2) and the rows beside it, `across` (2,) of it."""
        points = np.concatenate([row + k * across for k in (-1.0, 0.0, 1.0)])
        cells = np.unique(np.round(points).astype(np.int64), axis=0)
        return cells[self.sample(self.is_surface, cells)]


def score_leaves(
    field: SurfaceField, row: Float, beyond: Float, along: Float, is_far: Bool, min_clear: float
) -> Float:
    """(H,) scores of leaves: surface along them, none beside and beyond; 0 where there is none.

    Args:
        field: of the surface.
        row: (H, N, 2) cells along each.
        beyond: (H, K, 2) cells beyond its end, which is free.
        along: (H, 2) unit directions.
        is_far: (N,) those of the row that are not near the hinge, where the wall is beside it.
        min_clear: share of the cells beside it that are none.
    """
    across = along[:, None, ::-1] * [-1.0, 1.0]
    covered = field.sample(field.is_near, row).mean(axis=1)
    exact = field.sample(field.is_surface, row).mean(axis=1)
    far = row[:, is_far]
    beside = [field.sample(field.is_surface, far + k * across) for k in (-_ASIDE, _ASIDE)]
    clear = 1.0 - np.max([side.mean(axis=1) for side in beside], axis=0)
    good = (covered >= MIN_COVERED) & (exact >= MIN_EXACT) & (clear >= min_clear)
    for side in np.arange(-_ASIDE, _ASIDE + 1.0):
        good &= ~field.sample(field.is_surface, beyond + side * across).any(axis=1)
    return np.where(good, covered + exact + clear, 0.0)


def _rate_leaves(
    field: SurfaceField, hinge: Float, length: float, line: Float
) -> tuple[float, Cells] | None:
    """Score of the best leaf at any angle to the line and its cells; None without surface.

    The score is 0 if none of them is a leaf.

    Args:
        field: of the surface.
        hinge: (2,) cells.
        length: cells, of the leaf.
        line: (2,) unit direction from the hinge along the other position.
    """
    turned = math.atan2(line[1], line[0]) + np.concatenate([_ANGLES, -_ANGLES])
    along = np.stack([np.cos(turned), np.sin(turned)], axis=1)
    t, ahead = np.arange(1.0, length), np.arange(length + _BEYOND[0], length + _BEYOND[1])
    row = hinge + t[:, None] * along[:, None]
    kept = field.sample(field.is_near, row).mean(axis=1) >= MIN_COVERED
    if not kept.any():
        return None
    row, along = row[kept], along[kept]
    beyond = hinge + ahead[:, None] * along[:, None]
    score = score_leaves(field, row, beyond, along, t >= NEAR_HINGE * length, _MIN_CLEAR)
    best = int(score.argmax())
    return float(score[best]), field.cells_along(row[best], along[best, ::-1] * [-1.0, 1.0])
