"""The map of an extended place: what this run saw, and what the known map shows elsewhere."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap
from stillmap.em import OccupancyMap
from stillmap.pipeline.options import MapMode
from stillmap.results.map_npz import write_map_npz
from stillmap.results.map_server import write_map_server

Layer = NDArray[np.float32]


def extend_map(known: GridMap, hits: NDArray[np.floating], seen: OccupancyMap) -> OccupancyMap:
    """The known map, where this run saw cells replaced by what it saw.

    Args:
        known: a map whose axes are those of `seen`.
        hits: (H, W) its sums of hits.
        seen: the map of this run.
    """
    corners = [
        np.round(np.array(one.origin[1::-1]) / seen.resolution).astype(int) for one in (known, seen)
    ]
    low = np.minimum(*corners)
    high = np.maximum(
        corners[0] + known.p_occupied.shape, corners[1] + np.array(seen.p_occupied.shape)
    )
    at = [
        tuple(slice(a, a + n) for a, n in zip((corner - low).tolist(), shape, strict=True))
        for corner, shape in zip(
            corners, (known.p_occupied.shape, seen.p_occupied.shape), strict=True
        )
    ]
    looked = ~np.isnan(np.asarray(seen.p_occupied))

    def lay(fill: float, below: NDArray[np.floating], above: Layer) -> Layer:
        out = np.full(tuple((high - low).tolist()), fill, np.float32)
        out[at[0]] = below
        out[at[1]][looked] = np.asarray(above)[looked]
        return out

    y, x = (low * seen.resolution).tolist()
    return OccupancyMap(
        lay(np.nan, known.p_occupied, seen.p_occupied),
        (x, y, 0.0),
        seen.resolution,
        lay(0.0, hits, seen.alpha),
        lay(0.0, np.zeros_like(hits), seen.beta),
    )


def write_extended(
    folder: Path, known: GridMap, hits: NDArray[np.floating], seen: OccupancyMap, mode: MapMode
) -> None:
    """Replace `map.npz`, `map.yaml` and the picture of a result by those of the extended map."""
    extended = extend_map(known, hits, seen)
    write_map_server(folder, extended, mode)
    write_map_npz(folder / "map.npz", extended)
