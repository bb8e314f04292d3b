"""Colours of what is shown: (n, 3) uint8 red, green, blue.

Clouds of files and scans with no more points than a browser draws at ease.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.io.point_cloud import ply
from stillmap.io.point_cloud.binary_table import read_columns
from stillmap.results.report.figures import ORANGE

Colors = NDArray[np.uint8]

BLUE = (36, 99, 168)  # of the report: what stands still, and where the robot went

# dynamic, undecided, static: told apart by those who see no red, too
_BY_P_STATIC = (ORANGE, (205, 205, 205), BLUE)

_BY_HEIGHT = ((40, 53, 90), (45, 96, 130), (60, 140, 132), (122, 178, 106), (214, 196, 96))

_TURN = 0.618034  # of the circle of hues, from one number to the next: neighbours differ


def color_by_p_static(p_static: NDArray[np.float32]) -> Colors:
    """From orange, dynamic, over grey to blue, static; of (n,) P(c = 1)."""
    return _blended(_BY_P_STATIC, np.asarray(p_static, np.float64))


def color_by_height(z: NDArray[np.floating], low: float, high: float) -> Colors:
    """From dark blue at `low` metres to yellow at `high`; of (n,) metres."""
    return _blended(_BY_HEIGHT, (np.asarray(z, np.float64) - low) / max(high - low, 1e-9))


def color_by_id(number: NDArray[np.intp] | Sequence[int]) -> Colors:
    """A colour that a thing keeps, of its number (n,)."""
    hue = np.mod(np.asarray(number, np.float64) * _TURN + 0.05, 1.0)
    # a cosine for each of the three, a third of the circle apart
    part = np.cos(2.0 * np.pi * (hue[:, None] - np.array([0.0, 1.0, 2.0]) / 3.0))
    return np.rint(120.0 + 105.0 * part).astype(np.uint8)


def _blended(stops: Sequence[tuple[int, int, int]], share: NDArray[np.float64]) -> Colors:
    """Between colours that lie evenly from 0 to 1."""
    at = np.linspace(0.0, 1.0, len(stops))
    columns = [np.interp(share, at, column) for column in np.array(stops, np.float64).T]
    blended: NDArray[np.float64] = np.stack(columns, axis=-1)
    return np.rint(blended).astype(np.uint8)


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
    colors: NDArray[np.uint8] | None
    total: int


def sample_indices(count: int, most: int) -> NDArray[np.int64]:
    """(min(count, most),) numbers below `count`, rising, spread evenly.

    Within its share of the row each is chosen by chance: at even steps a lidar whose rings come in
    turn would show a few of them only. The same numbers every time.
    """
    if count <= most:
        return np.arange(count)
    at = np.arange(most) + np.random.default_rng(_SEED).random(most)
    return np.minimum((at * (count / most)).astype(np.int64), count - 1)


def sample_ply(path: Path, most: int) -> Points:
    """At most so many points of a PLY file, read piece by piece.

    Raises:
        InputError: it is missing or damaged.
    """
    layout = ply.read_layout(path)
    painted = {"red", "green", "blue"} <= {field.name for field in layout.fields}
    wanted = ("x", "y", "z", *(("red", "green", "blue") if painted else ()))
    use, first = sample_indices(layout.rows, most), 0
    points, colours = np.empty((len(use), 3)), np.empty((len(use), 3), np.uint8)
    for block in read_columns(layout, wanted):
        end = first + len(block[0])
        into = slice(*np.searchsorted(use, [first, end]).tolist())
        for n, values in enumerate(block):
            (points if n < 3 else colours)[into, n % 3] = values[use[into] - first]
        first = end
    if not np.isfinite(points).all():
        raise InputError("holds a point that is not finite", where=str(path))
    return Points(points, colours if painted else None, layout.rows)
