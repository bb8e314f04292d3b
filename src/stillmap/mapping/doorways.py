"""Doorways: gaps in straight walls that are as wide as leaves of doors."""

import math
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Cells, Float, Index

_DIRECTIONS = 60  # of half a turn, of which walls may have some
_MIN_WALL, _MIN_SHARE = 0.5, 0.05  # m of a wall; of the direction that has most
_NEAR = 3  # directions within which the one with most wall counts
_WIDTH = (0.6, 1.3)  # m
_POSTS = (0.35, 1.0)  # m at least, of the shorter and the longer wall beside it
_MAX_HOLE = 2  # cells of a wall that were not hit
_MAX_SPARSE = 4  # rows for each cell, beyond which rows without cells are not counted
_APART = 6.0  # cells by which the middles of two doorways differ at least


class Doorway(NamedTuple):
    """A gap in a wall: (2, 2) cells where the wall ends on either side."""

    ends: Float

    @property
    def width(self) -> float:
        """Cells."""
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))


def find_doorways(surface: Cells, resolution: float) -> list[Doorway]:
    """Gaps between two pieces of one straight wall.

    Walls have few directions in a building: gaps are looked for along those that have most wall.

    Args:
        surface: (S, 2) occupied cells.
        resolution: m, edge of a cell.
    """
    if not len(surface):
        return []
    origin = surface.min(axis=0)
    cells = surface - origin
    gaps = [_find_gaps(cells, u, resolution) for u in _find_directions(cells, resolution)]
    if not gaps:
        return []
    all_ends, posts = (np.concatenate(column) for column in zip(*gaps, strict=True))
    left = np.argsort(-posts, kind="stable")  # longest walls first
    middle = all_ends.mean(axis=1)
    out = []
    while len(left):
        out.append(Doorway(all_ends[left[0]] + origin))
        left = left[np.linalg.norm(middle[left] - middle[left[0]], axis=1) >= _APART]
    return out


class _Runs(NamedTuple):
    """Rows of adjacent cells along a direction, (R,) each, in the order of rows and along them."""

    row: Index
    begin: Index
    end: Index

    @property
    def length(self) -> Index:
        return self.end - self.begin + 1

    @classmethod
    def of_cells(cls, cells: Cells, u: Float, aside: int) -> "_Runs":
        """Of cells (K, 2) along the unit direction u, with those up to `aside` rows beside it."""
        along = np.round(cells @ u).astype(np.int64)
        across = np.round(cells @ np.array([-u[1], u[0]])).astype(np.int64)
        low, stride = along.min(), int(np.ptp(along)) + _MAX_HOLE + 2  # rows do not touch
        rows = across[:, None] + np.arange(-aside, aside + 1)
        key = np.unique(rows * stride + (along - low)[:, None])
        first = np.flatnonzero(np.diff(key, prepend=key[0] - stride) > _MAX_HOLE + 1)
        last = np.append(first[1:], len(key)) - 1
        row = key[first] // stride
        return cls(row, key[first] - row * stride + low, key[last] - row * stride + low)


def _find_directions(cells: Cells, resolution: float) -> Float:
    """(D, 2) unit vectors along most of the walls, cells (K, 2)."""
    angle = np.arange(_DIRECTIONS) * (math.pi / _DIRECTIONS)
    unit = np.column_stack([np.cos(angle), np.sin(angle)])
    across = np.round(cells @ np.array([[0.0, 1.0], [-1.0, 0.0]]) @ unit.T).astype(np.int64)
    rows = map(_count_in_rows, across.T)
    # cells beside each other in rows of walls, of which each direction has some by chance
    wall = np.array([np.sum(one[one >= _MIN_WALL / resolution] ** 2.0) for one in rows])
    wall -= wall.min()
    around = np.stack([np.roll(wall, k) for k in range(-_NEAR, _NEAR + 1)])
    kept = (wall == around.max(axis=0)) & (wall >= max(_MIN_SHARE * wall.max(), 1))
    return np.asarray(unit[kept])


def _count_in_rows(across: Index) -> Index:
    """Number of cells in each row: of all rows, or of those with cells where they are sparse."""
    number = across - across.min()
    if number.max() > _MAX_SPARSE * len(number):  # far apart: an array of all rows is large
        return np.unique(number, return_counts=True)[1]
    return np.bincount(number)


def _find_gaps(cells: Cells, u: Float, resolution: float) -> tuple[Float, Index]:
    """Ends (G, 2, 2) of the gaps along a direction, and the lengths (G,) of the shorter walls."""
    runs = _Runs.of_cells(cells, u, 1)
    gap = runs.begin[1:] - runs.end[:-1]
    posts = np.sort(np.column_stack([runs.length[:-1], runs.length[1:]]), axis=1)
    low, high = (metres / resolution for metres in _WIDTH)
    fits = (runs.row[1:] == runs.row[:-1]) & (gap >= low) & (gap <= high)
    of = np.flatnonzero(fits & (posts >= np.array(_POSTS) / resolution).all(axis=1))
    along = np.column_stack([runs.end[of], runs.begin[of + 1]]).astype(np.float64)
    v = np.array([-u[1], u[0]])
    return along[..., None] * u + runs.row[of, None, None] * v, posts[of, 0]
