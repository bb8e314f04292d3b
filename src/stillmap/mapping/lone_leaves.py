"""Leaves of doors that stood open whenever they were seen, found by the doorway that they fit.

Such a leaf is a straight row of surface from one end of a doorway, as long as that is wide, with a
free end. It is thin, as beams passed on both sides of it, they passed through the doorway, and
nothing stands where it swings.
"""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Bool, Cells, Float
from stillmap.core.square_box import adjacent_pairs, component_labels, group_indices
from stillmap.mapping import resting_leaf
from stillmap.mapping.doorways import Doorway, LoneLeaf
from stillmap.mapping.labelled_recording import LabelledRecording
from stillmap.mapping.resting_leaf import SurfaceField

_ANGLES = np.radians(np.arange(60.0, 148.0, 4.0))  # from the doorway to the leaf
_SHIFT = np.array([-0.5, 1.0])  # cells of the hinge into the doorway
_BACK = np.arange(-1.0, 6.0)  # cells of the hinge behind the face of the wall
_LONGER = np.arange(-2.0, 5.0)  # cells by which the leaf is longer than the doorway is wide
_MIN_CLEAR = 0.85  # share of the cells beside the leaf that are none
_BEYOND = (2.0, 5.0)  # cells beyond its end, which is free
_NOISE = math.radians(15.0)  # of the swing beside either position
_RADII = np.array([0.4, 0.55, 0.7, 0.85, 0.97])  # of the leaf, where the swing is looked at
_MAX_SWEPT = 0.02  # share of the swing that is surface
_BAND = 4.0  # cells beside the leaf that are of it
_JAMB = 4.0  # cells behind the face of the wall, where its edge and the leaf are one
_BEHIND_WALL, _GOES_ON, _MAX_GOES_ON = 8.0, 7.0, 1  # cells behind the hinge; of a row beyond; in it
_MIN_PASSED = 0.9  # share of the doorway, and of its side of the leaf, that beams passed
_MIN_BEHIND = 0.3  # the same of the other side, which walls hide from the doorway
# cells that surface deviates from a line, where none of the other side was passed, and more where
# all of it was
_ROUGHNESS, _MORE_ROUGHNESS = 0.75, 0.35
_BESIDE = np.array([3.0, 4.0, 5.0])  # cells from the leaf, of a row that beams pass beside it
_MAX_HIT_SHARE, _MIN_LENGTHS = 0.25, 0.5  # of the beams in a cell that passed; cell lengths


def find_open_leaf(doorway: Doorway, surface: Cells) -> LoneLeaf | None:
    """The best candidate for a leaf that stands open at a doorway; None: there is none.

    Args:
        doorway: a gap in a wall.
        surface: (S, 2) occupied cells.
    """
    field = SurfaceField(surface, doorway.ends.mean(axis=0), 2.0 * doorway.width + 12.0)
    best: tuple[float, LoneLeaf | None] = 0.0, None
    for end, side in itertools.product((0, 1), (-1.0, 1.0)):
        rated = _rate_leaves(field, doorway, end, side)
        if rated is not None and rated[0] > best[0]:
            best = rated
    leaf = best[1]
    if leaf is None or _goes_on(leaf, field.cells):
        return None
    leaf = leaf._replace(roughness=_measure_roughness(leaf, field.cells))
    return leaf if leaf.roughness <= _ROUGHNESS + _MORE_ROUGHNESS else None


def _goes_on(leaf: LoneLeaf, surface: Cells) -> bool:
    """True if the surface of a leaf goes on behind the hinge."""
    along, across = se2.along_and_across(surface - leaf.hinge, leaf.leaf)
    behind = (along < -_BEHIND_WALL) & (along > -_BEHIND_WALL - _GOES_ON)
    row = np.unique(np.round(along[behind & (np.abs(across) <= 1.5)]))
    return len(row) > _MAX_GOES_ON


def _measure_roughness(leaf: LoneLeaf, surface: Cells) -> float:
    """Standard deviation of the surface of a leaf from a line, cells."""
    along, across = se2.along_and_across(surface - leaf.hinge, leaf.leaf)
    of_leaf = (along > resting_leaf.NEAR_HINGE * leaf.length) & (along < leaf.length)
    of_leaf &= np.abs(across) <= _BAND
    line = np.column_stack([along[of_leaf], np.ones(np.count_nonzero(of_leaf))])
    fitted = line @ np.linalg.lstsq(line, across[of_leaf], rcond=None)[0]
    return float(np.sqrt(np.mean((across[of_leaf] - fitted) ** 2)))


def is_doorway_free(doorway: Doorway, counts: _core.OccupancyGrid2D) -> bool:
    """True if beams passed through a doorway; `counts` of all beams, all hits as if static."""
    gap = doorway.ends[0] + np.linspace(0.2, 0.8, 9)[:, None] * np.diff(doorway.ends, axis=0)
    return _passed_share(counts, gap) >= _MIN_PASSED


def is_thin(leaf: LoneLeaf, counts: _core.OccupancyGrid2D) -> bool:
    """True if beams passed on both sides of a leaf, the more the rougher it is; `counts` as for
    `is_doorway_free`."""
    across = np.array([-leaf.leaf[1], leaf.leaf[0]])
    if across @ leaf.shut < 0.0:
        across = -across
    t = np.arange(resting_leaf.NEAR_HINGE * leaf.length + 1.0, leaf.length)
    row = leaf.hinge + t[:, None] * leaf.leaf
    inside, behind = (
        max(_passed_share(counts, row + k * side * across) for k in _BESIDE) for side in (1.0, -1.0)
    )
    is_straight = leaf.roughness <= _ROUGHNESS + _MORE_ROUGHNESS * behind
    return inside >= _MIN_PASSED and behind >= _MIN_BEHIND and is_straight


def _passed_share(counts: _core.OccupancyGrid2D, points: Float) -> float:
    """Share of the cells at points (n, 2) that beams passed, and few ended in."""
    alpha, beta = counts.alpha_beta(np.round(points).astype(np.int64)).T
    passed = (beta >= _MIN_LENGTHS) & (alpha <= _MAX_HIT_SHARE * (alpha + beta))
    return float(passed.mean())


class _Hypotheses(NamedTuple):
    """H leaves of any length at one end of a doorway.

    Attributes:
        hinge, leaf: (H, 2).
        angle: (H,) rad from the doorway.
    """

    hinge: Float
    leaf: Float
    angle: Float

    def select(self, kept: Bool) -> "_Hypotheses":
        return _Hypotheses._make(column[kept] for column in self)


def _rate_leaves(
    field: SurfaceField, doorway: Doorway, end: int, side: float
) -> tuple[float, LoneLeaf] | None:
    """Score and shape of the best leaf hinged at one end of a doorway, towards one side of it."""
    u = (doorway.ends[1 - end] - doorway.ends[end]) / doorway.width
    v = side * np.array([-u[1], u[0]])
    every = _sample_leaves(field, doorway, doorway.ends[end], u, v)
    every = every.select(_swept_share(field, doorway.width, every, u, v) <= _MAX_SWEPT)
    if not len(every.hinge):
        return None
    best: tuple[float, LoneLeaf] | None = None
    for length in doorway.width + _LONGER:
        t = _count_up(length + _BEYOND[1])
        points = every.hinge[:, None] + t[:, None] * every.leaf[:, None]
        row, beyond = points[:, t <= length], points[:, t >= length + _BEYOND[0]]
        is_far = t[t <= length] >= resting_leaf.NEAR_HINGE * length
        score = resting_leaf.score_leaves(field, row, beyond, every.leaf, is_far, _MIN_CLEAR)
        k = int(score.argmax())
        if score[k] > (best[0] if best else 0.0):
            cells = field.cells_along(row[k], every.leaf[k, ::-1] * [-1.0, 1.0])
            cells = cells[(cells - doorway.ends[end]) @ v > _JAMB]
            best = float(score[k]), LoneLeaf(every.hinge[k], length, u, every.leaf[k], cells, True)
    return best


def _sample_leaves(
    field: SurfaceField, doorway: Doorway, end: Float, u: Float, v: Float
) -> _Hypotheses:
    """Those that lie on surface over the shortest length."""
    grids = np.meshgrid(_SHIFT, _BACK, _ANGLES, indexing="ij")
    shift, back, angle = (grid.ravel() for grid in grids)
    hinge = end + shift[:, None] * u + back[:, None] * v
    leaf = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    least = _count_up(doorway.width + _LONGER[0])
    kept = np.arange(len(angle))
    for layer, share in (
        (field.is_near, resting_leaf.MIN_COVERED),
        (field.is_surface, resting_leaf.MIN_EXACT),
    ):
        row = hinge[kept, None] + least[:, None] * leaf[kept, None]
        kept = kept[field.sample(layer, row).mean(axis=1) >= share]
    return _Hypotheses(hinge[kept], leaf[kept], angle[kept])


def _count_up(last: float) -> Float:
    """(N,) 1, 2, ... up to `last`: cells from the hinge."""
    return np.arange(1.0, math.floor(last) + 1.0)


def _swept_share(
    field: SurfaceField, width: float, every: _Hypotheses, u: Float, v: Float
) -> Float:
    """(H,) share of surface in the sectors from the doorway to each leaf."""
    part = np.linspace(0.0, 1.0, 16)
    turned = _NOISE + part * (every.angle[:, None] - 2.0 * _NOISE)
    rays = np.cos(turned)[..., None] * u + np.sin(turned)[..., None] * v
    points = every.hinge[:, None, None] + (_RADII * width)[:, None] * rays[:, :, None]
    return np.asarray(field.sample(field.is_surface, points).mean(axis=(1, 2)))


_BIN_NS = 10**9  # in which the cells that were hit are looked at together
_MIN_LENGTH, _MAX_LENGTH = 0.4, 1.4  # m
_MAX_WIDTH = 0.12  # m: a line of cells that noise widens; people are wider
_MIN_CELLS = 6
_MIDDLE, _ANGLE = 4.0, 8  # cells, and parts of half a turn, by which lines of one leaf may differ


def find_leaf_lines(known: LabelledRecording) -> list[Cells]:
    """Cells (K, 2) of each straight row of dynamic hits, in 2D, that may be a leaf."""
    recording = known.recording
    lines: dict[tuple[int, ...], list[Cells]] = {}
    for beam in known.iter_hits(dynamic=True):
        stamp = recording.stamp_ns[recording.scans_of(beam)]
        second = (stamp - recording.stamp_ns[0]) // _BIN_NS
        seen = np.unique(np.column_stack([known.end_cells(beam), second]), axis=0)
        for place, line in _find_lines(seen, known.resolution) if len(seen) else ():
            lines.setdefault(place, []).append(line)
    return [np.unique(np.concatenate(parts), axis=0) for _, parts in sorted(lines.items())]


def _find_lines(seen: Cells, resolution: float) -> Iterator[tuple[tuple[int, ...], Cells]]:
    """Place and cells (K, 2) of each row of adjacent cells (N, 3), of cell and second."""
    # cells of different seconds do not touch
    label = component_labels(adjacent_pairs(seen * np.array([1, 1, 2])), len(seen))
    count = np.bincount(label)
    xy = seen[:, :2].astype(np.float64)
    mean = np.stack([np.bincount(label, column) / count for column in xy.T], axis=1)
    x, y = (xy - mean[label]).T
    xx, yy, x_y = (np.bincount(label, product) / count for product in (x * x, y * y, x * y))
    half, root = 0.5 * (xx + yy), np.sqrt(0.25 * (xx - yy) ** 2 + x_y**2)
    # of cells that fill a rectangle
    length = np.sqrt(12.0 * (half + root)) * resolution
    width = np.sqrt(12.0 * np.maximum(half - root, 0.0)) * resolution
    is_line = (count >= _MIN_CELLS) & (width <= _MAX_WIDTH)
    is_line &= (length >= _MIN_LENGTH) & (length <= _MAX_LENGTH)
    angle = 0.5 * np.arctan2(2.0 * x_y, xx - yy)
    part = np.round(angle / np.pi * _ANGLE).astype(np.int64) % _ANGLE
    place = np.column_stack([np.round(mean / _MIDDLE).astype(np.int64), part])
    kept = np.flatnonzero(is_line[label])
    for members in group_indices(label[kept]):
        yield tuple(place[label[kept[members[0]]]].tolist()), seen[kept[members], :2]
