"""Occupancy of a rectangle of cells."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
