"""Occupancy of a rectangle of cells."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr


@dataclass(frozen=True, eq=False)
class GridMap(ShortRepr):
    """Occupancy of a rectangle of cells.

    Attributes:
        p_occupied: (H, W) float32; NaN where unobserved, which is not free. Row 0 has the lowest y.
            Layers of large maps are a `core.tiles.TiledArray`, which NumPy takes for an array.
        origin: x, y (metres) and yaw of the lower-left corner of the lower-left cell.
        resolution: metres.
    """

    p_occupied: NDArray[np.float32]
    origin: tuple[float, float, float]
    resolution: float

    def __repr__(self) -> str:
        height, width = self.p_occupied.shape
        return (
            f"<{type(self).__name__}: {width} x {height} cells of {self.resolution:g} m, "
            f"{width * self.resolution:.1f} m x {height * self.resolution:.1f} m>"
        )


Region = tuple[float, float, float, float]  # x0, y0, x1, y1 in metres


def is_inside(points: NDArray[Any], region: Region) -> NDArray[np.bool_]:
    """(...) whether points (..., D), of which x and y count, lie in a region."""
    x0, y0, x1, y1 = region
    x, y = points[..., 0], points[..., 1]
    return np.asarray((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))


def shift_region(region: Region, by: NDArray[np.float64]) -> Region:
    """The region moved by the first two of (3,) metres."""
    (x0, y0, x1, y1), (x, y) = region, by[:2].tolist()
    return x0 + x, y0 + y, x1 + x, y1 + y


def limit_hits(
    recording: Recording, T_map_base: NDArray[np.float64], region: Region | None
) -> Recording:
    """The recording with the hits in a region alone; itself where there is no region."""
    if region is None:
        return recording
    inside = recording.allocate_per_beam(np.bool_)
    for block in arrays.iter_blocks(recording.hit, inside):
        inside[block] = False
        beams = block.start + np.flatnonzero(recording.hit[block])
        inside[beams] = is_inside(recording.end_points(beams, T_map_base), region)
    return replace(recording, hit=inside)
