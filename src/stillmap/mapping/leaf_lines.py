"""Rows of dynamic hits as long as leaves of doors: positions in which one is seen for moments."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import iter_blocks
from stillmap.core.components import adjacent_pairs, component_labels, group_indices
from stillmap.core.recording import Recording
from stillmap.em.types import DYNAMIC_BELOW

Float = NDArray[np.float64]
Cells = NDArray[np.int64]

_BIN_NS = 10**9  # in which the cells that were hit are looked at together
_MIN_LENGTH, _MAX_LENGTH = 0.4, 1.4  # m
_MAX_WIDTH = 0.12  # m: a line of cells that noise widens; people are wider
_MIN_CELLS = 6
_MIDDLE, _ANGLE = 4.0, 8  # cells, and parts of half a turn, by which lines of one leaf may differ


def find_leaf_lines(
    recording: Recording, poses: Float, p_static: NDArray[np.float32], resolution: float
) -> list[Cells]:
    """Cells (K, 2) of each straight row of dynamic hits that may be a leaf.

    Args:
        recording: 2D, M beams.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) of each beam.
        resolution: m, edge of a cell.
    """
    lines: dict[tuple[int, ...], list[Cells]] = {}
    for block in iter_blocks(recording.hit, p_static):
        dynamic = recording.hit[block] & (p_static[block] < DYNAMIC_BELOW)
        beam = block.start + np.flatnonzero(dynamic)
        cells = np.floor(recording.end_points(beam, poses) / resolution).astype(np.int64)
        stamp = recording.stamp_ns[recording.scans_of(beam)]
        second = (stamp - recording.stamp_ns[0]) // _BIN_NS
        seen = np.unique(np.column_stack([cells, second]), axis=0)
        for place, line in _find_lines(seen, resolution) if len(seen) else ():
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
    for one in group_indices(label[kept]):
        yield tuple(place[label[kept[one[0]]]].tolist()), seen[kept[one], :2]
