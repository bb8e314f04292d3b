"""Clouds of files and scans with no more points than a browser draws at ease."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.recording.clouds import ply
from stillmap.recording.clouds.records import columns

_SEED = 1


@dataclass(frozen=True, eq=False)
class Points:
    """Some of the points of a cloud.

    Attributes:
        points: (n, 3) float64 metres in the map frame.
        colours: (n, 3) uint8; None where the file has none.
        of: how many there are in all.
    """

    points: NDArray[np.float64]
    colours: NDArray[np.uint8] | None
    of: int


def chosen(count: int, most: int) -> NDArray[np.int64]:
    """(min(count, most),) numbers below `count`, rising, spread evenly.

    Within its share of the row each is chosen by chance: at even steps a lidar whose rings come in
    turn would show a few of them only. The same numbers every time.
    """
    if count <= most:
        return np.arange(count)
    at = np.arange(most) + np.random.default_rng(_SEED).random(most)
    return np.minimum((at * (count / most)).astype(np.int64), count - 1)


def points_in(path: Path, most: int) -> Points:
    """At most so many points of a PLY file, read piece by piece.

    Raises:
        InputError: it is missing or damaged.
    """
    layout = ply.layout_of(path)
    painted = {"red", "green", "blue"} <= {field.name for field in layout.fields}
    wanted = ("x", "y", "z", *(("red", "green", "blue") if painted else ()))
    use, first = chosen(layout.rows, most), 0
    points, colours = np.empty((len(use), 3)), np.empty((len(use), 3), np.uint8)
    for block in columns(layout, wanted):
        end = first + len(block[0])
        into = slice(*np.searchsorted(use, [first, end]).tolist())
        for n, values in enumerate(block):
            (points if n < 3 else colours)[into, n % 3] = values[use[into] - first]
        first = end
    if not np.isfinite(points).all():
        raise InputError("holds a point that is not finite", where=str(path))
    return Points(points, colours if painted else None, layout.rows)
