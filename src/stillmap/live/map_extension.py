"""The map of an extended place: what this run saw, and what the known map shows elsewhere."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap
from stillmap.core.short_repr import ShortRepr
from stillmap.em import OccupancyMap
from stillmap.live.cloud_extension import KeptCloud, write_extended_cloud
from stillmap.pipeline.options import MapMode
from stillmap.results.map_server import write_map_npz, write_map_server

Layer = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class KeptMap(ShortRepr):
    """The part of a known map that an extended one keeps, in its map frame.

    Attributes:
        grid: the planar map.
        hits: (H, W) its sums of hits.
        cloud: of a map in 3D, what still stands.
    """

    grid: GridMap
    hits: NDArray[np.floating]
    cloud: KeptCloud | None = None


class Overlay:
    """The box around two maps with the same axes and cells, one of which lies on the other.

    Args:
        below, above: the maps.
    """

    def __init__(self, below: GridMap, above: GridMap) -> None:
        edge = above.resolution
        shapes = [np.array(one.p_occupied.shape) for one in (below, above)]
        corners = [
            np.round(np.array(one.origin[1::-1]) / edge).astype(int) for one in (below, above)
        ]
        low = np.minimum(*corners)
        high = np.maximum(*(a + n for a, n in zip(corners, shapes, strict=True)))
        self.shape = tuple((high - low).tolist())
        y, x = (low * edge).tolist()
        self.origin = (x, y, 0.0)
        self._below, self._above = (
            tuple(slice(a, a + n) for a, n in zip((corner - low).tolist(), shape, strict=True))
            for corner, shape in zip(corners, np.array(shapes).tolist(), strict=True)
        )

    def lay(
        self,
        fill: float,
        below: NDArray[np.floating],
        above: NDArray[np.floating],
        use: NDArray[np.bool_],
    ) -> Layer:
        """A layer of both: `above` where `use`, `below` elsewhere, `fill` where there is none."""
        out = np.full(self.shape, fill, np.float32)
        out[self._below] = below
        out[self._above][use] = np.asarray(above)[use]
        return out

    def find_below(self, fill: float, below: NDArray[np.floating]) -> Layer:
        """Values of the lower map in the cells of the upper one; `fill` outside it."""
        out = np.full(self.shape, fill, np.float32)
        out[self._below] = below
        return out[self._above]


def overlay(below: GridMap, above: GridMap) -> GridMap:
    """A map on which another one lies, where that one is known."""
    box = Overlay(below, above)
    seen = np.asarray(above.p_occupied)
    p_occupied = box.lay(np.nan, below.p_occupied, seen, ~np.isnan(seen))
    return GridMap(p_occupied, box.origin, above.resolution)


def extend_map(kept: KeptMap, seen: OccupancyMap) -> OccupancyMap:
    """The known map, where this run saw cells replaced by what it saw. Of a map in 3D, cells stay
    occupied where the known one shows what this run did not see through: it may have looked over
    it.

    Args:
        kept: a map whose axes are those of `seen`.
        seen: the map of this run.
    """
    known, p = kept.grid, np.asarray(seen.p_occupied)
    box, use = Overlay(known, seen), ~np.isnan(p)
    if kept.cloud is not None:
        standing = np.where(kept.cloud.stands, known.p_occupied, np.nan)
        use &= ~(box.find_below(np.nan, standing) > p)
    return OccupancyMap(
        box.lay(np.nan, known.p_occupied, p, use),
        box.origin,
        seen.resolution,
        box.lay(0.0, kept.hits, seen.alpha, use),
        box.lay(0.0, np.zeros_like(kept.hits), seen.beta, use),
    )


def write_extended(folder: Path, kept: KeptMap, seen: OccupancyMap, mode: MapMode) -> None:
    """Replace `map.npz`, `map.yaml` and the picture of a result by those of the extended map, and
    in 3D its cloud."""
    extended = extend_map(kept, seen)
    write_map_server(folder, extended, mode)
    write_map_npz(folder / "map.npz", extended)
    if kept.cloud is not None:
        write_extended_cloud(folder, kept.cloud, seen.resolution)
