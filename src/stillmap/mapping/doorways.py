"""Doorways: gaps in straight walls as wide as leaves of doors, and surfaces that fill them.

Such a surface behind the face of the wall is a shut leaf or the back of a niche. Of one that never
was seen open nothing tells which. But those that were seen to swing or stood open tell how many of
the doorways have a door, and for which share of the time doors are shut.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Cells, Float, Index
from stillmap.mapping.doors import Door, measure_states
from stillmap.mapping.resting_leaf import SurfaceField

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


def _find_runs(cells: Cells, u: Float) -> tuple[Index, Index, Index]:
    """Row, begin and end (R,) of each run of adjacent cells (K, 2) along a unit direction, in the
    order of rows and along them; the cells of the rows to either side count as well."""
    along = np.round(cells @ u).astype(np.int64)
    across = np.round(cells @ np.array([-u[1], u[0]])).astype(np.int64)
    low, stride = along.min(), int(np.ptp(along)) + _MAX_HOLE + 2  # rows do not touch
    rows = across[:, None] + np.arange(-1, 2)
    key = np.unique(rows * stride + (along - low)[:, None])
    first = np.flatnonzero(np.diff(key, prepend=key[0] - stride) > _MAX_HOLE + 1)
    last = np.append(first[1:], len(key)) - 1
    row = key[first] // stride
    begin, end = (key[at] - row * stride + low for at in (first, last))
    return row, begin, end


def _find_directions(cells: Cells, resolution: float) -> Float:
    """(D, 2) unit vectors along most of the walls, cells (K, 2)."""
    angle = np.arange(_DIRECTIONS) * (math.pi / _DIRECTIONS)
    unit = np.column_stack([np.cos(angle), np.sin(angle)])
    across = np.round(cells @ np.array([[0.0, 1.0], [-1.0, 0.0]]) @ unit.T).astype(np.int64)
    rows = map(_count_in_rows, across.T)
    # cells beside each other in rows of walls, of which each direction has some by chance
    wall = np.array([np.sum(count[count >= _MIN_WALL / resolution] ** 2.0) for count in rows])
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
    row, begin, end = _find_runs(cells, u)
    gap, length = begin[1:] - end[:-1], end - begin + 1
    posts = np.sort(np.column_stack([length[:-1], length[1:]]), axis=1)
    low, high = (metres / resolution for metres in _WIDTH)
    fits = (row[1:] == row[:-1]) & (gap >= low) & (gap <= high)
    of = np.flatnonzero(fits & (posts >= np.array(_POSTS) / resolution).all(axis=1))
    along = np.column_stack([end[of], begin[of + 1]]).astype(np.float64)
    v = np.array([-u[1], u[0]])
    return along[..., None] * u + row[of, None, None] * v, posts[of, 0]


class LoneLeaf(NamedTuple):
    """A leaf that was in one position, open or shut.

    Attributes:
        hinge: (2,) cells.
        length: cells.
        shut, leaf: (2,) unit directions from the hinge to the other end of the doorway, and along
            the leaf.
        cells: (K, 2) of it, without those at the edge of the wall.
        is_open: in which position it was.
        roughness: cells, standard deviation of its surface from a line; 0 of a shut one.
    """

    hinge: Float
    length: float
    shut: Float
    leaf: Float
    cells: Cells
    is_open: bool
    roughness: float = 0.0


_RECESS = np.arange(2.0, 7.0)  # cells behind the face of the wall
_MIN_COVERED, _MIN_EXACT = 0.9, 0.5  # share of the leaf within a cell of surface, and on it
_MIN_JAMB = 0.5  # share of the edges of the wall, from its face to the leaf, that are seen
_ASIDE, _MAX_ASIDE = np.array([3.0, 4.0, 5.0]), 0.4  # cells beside the leaf; share that is surface
_HIDDEN = np.arange(5.0)  # cells of the leaf that the edge of a wall may hide, drawn too long
_PRIOR_SECONDS = 300.0  # for which doors that stand open half of the time count
_MAX_ITERATIONS = 100


def find_shut_leaf(doorway: Doorway, surface: Cells) -> LoneLeaf | None:
    """The surface that fills a doorway; None: there is none.

    Which end its hinge is at nobody knows: the first one is given.

    Args:
        doorway: a gap in a wall.
        surface: (S, 2) occupied cells.
    """
    field = SurfaceField(surface, doorway.ends.mean(axis=0), doorway.width + 14.0)
    best: tuple[float, LoneLeaf | None] = 0.0, None
    u = (doorway.ends[1] - doorway.ends[0]) / doorway.width
    for v in (np.array([-u[1], u[0]]), np.array([u[1], -u[0]])):
        for back in _RECESS.tolist():
            score, cells = _rate_leaf(field, doorway, u, back * v)
            if score > best[0]:
                hinge = doorway.ends[0] + back * v
                best = score, LoneLeaf(hinge, doorway.width, u, u, cells, False)
    return best[1]


def _rate_leaf(
    field: SurfaceField, doorway: Doorway, u: Float, recess: Float
) -> tuple[float, Cells]:
    """Score of the leaf so far behind a doorway along u, 0 where there is none, and its cells."""
    row = doorway.ends[0] + recess + np.arange(2.0, doorway.width - 1.0)[:, None] * u
    covered = float(field.sample(field.is_near, row).mean())
    exact = float(field.sample(field.is_surface, row).mean())
    if covered < _MIN_COVERED or exact < _MIN_EXACT:
        return 0.0, np.empty((0, 2), np.int64)
    depth = np.arange(1.0, float(np.linalg.norm(recess)))[:, None] / np.linalg.norm(recess)
    for end, outwards in zip(doorway.ends, (-u, u), strict=True):
        jamb = field.sample(field.is_near, end + depth * recess).mean()
        beside = end + recess + (_HIDDEN[:, None] + _ASIDE)[..., None] * outwards
        is_free = field.sample(field.is_surface, beside).mean(axis=1) <= _MAX_ASIDE
        if jamb < _MIN_JAMB or not is_free.any():
            return 0.0, np.empty((0, 2), np.int64)
        hidden = float(is_free.argmax())
        if hidden:
            more = np.arange(-1.0, hidden + _ASIDE[0])[:, None] * outwards
            row = np.concatenate([row, end + recess + more])
    return covered + exact, field.cells_along(row, recess / np.linalg.norm(recess))


def estimate_p_door(p_shut: Float, n_doors: int) -> Float:
    """(F,) probability that each of F surfaces which fill a doorway is a door that opens at times.

    Of all doorways the share pi has such a door, and pi ~ Beta(1, 2). Its posterior mean given
    which of the filled ones are doors, and these given pi, are computed in turn.

    Args:
        p_shut: (F,) probability that a door would have been shut whenever this one was seen.
        n_doors: doorways that have one for certain: it was seen to swing, or stood open.
    """
    p_door = np.full(len(p_shut), 0.5)
    for _ in range(_MAX_ITERATIONS):
        share = (n_doors + p_door.sum() + 1.0) / (n_doors + len(p_door) + 3.0)
        p_door, before = share * p_shut / (share * p_shut + 1.0 - share), p_door
        if np.allclose(p_door, before, rtol=0.0, atol=1e-3):
            break
    return p_door


def estimate_shut_share(doors: Sequence[Door]) -> float:
    """Share of the time for which doors are shut, by those that were seen to swing."""
    lasts = measure_states(state for door in doors for state in door.states)
    shut, whole = (1e-9 * span for span in (lasts["shut"], sum(lasts.values())))
    return (0.5 * _PRIOR_SECONDS + shut) / (_PRIOR_SECONDS + whole)
