"""Subsampling of point clouds to what a browser can draw."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import sample_indices
from stillmap.core.errors import InputError
from stillmap.io.point_cloud import ply
from stillmap.io.point_cloud.table import read_columns


@dataclass(frozen=True, eq=False)
class Points:
    """A subsampled point cloud.

    Attributes:
        points: (n, 3) m in the map frame.
        colors: (n, 3) uint8; None where the file has none.
        total: number of points in the file.
    """

    points: NDArray[np.floating]
    colors: NDArray[np.uint8] | None
    total: int


def sample_ply(path: Path, max_count: int) -> Points:
    """At most `max_count` points of a PLY file, read block by block.

    Raises:
        InputError: it is missing or damaged.
    """
    layout = ply.read_layout(path)
    has_colors = {"red", "green", "blue"} <= {field.name for field in layout.fields}
    wanted = ("x", "y", "z", *(("red", "green", "blue") if has_colors else ()))
    use, first = sample_indices(layout.rows, max_count), 0
    points, colors = np.empty((len(use), 3)), np.empty((len(use), 3), np.uint8)
    for block in read_columns(layout, wanted):
        end = first + len(block[0])
        into = slice(*np.searchsorted(use, [first, end]).tolist())
        for n, values in enumerate(block):
            (points if n < 3 else colors)[into, n % 3] = values[use[into] - first]
        first = end
    if not np.isfinite(points).all():
        raise InputError("holds a point that is not finite", where=str(path))
    return Points(points, colors if has_colors else None, layout.rows)
