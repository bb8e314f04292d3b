"""The cloud of an extended place in 3D: what this run saw, and what still stands elsewhere."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npy
from stillmap.core.short_repr import ShortRepr
from stillmap.places.evidence import cell_keys
from stillmap.results.point_cloud import Block, cloud_from_folder
from stillmap.results.points import append_vertices

Float = NDArray[np.float64]

ROUTE = "live/known_route.npy"  # of a result that extends a map, from where that one was made


@dataclass(frozen=True, eq=False)
class KeptCloud(ShortRepr):
    """Points of a known cloud that are still occupied, in its map frame.

    Attributes:
        points: (N, 3) float64, m.
        p_static: (N,) float32.
        route: (K, 4, 4) T_map_base from where the known map was made.
        stands: (H, W) cells of its planar map in which obstacles are among the points.
    """

    points: Float
    p_static: NDArray[np.float32]
    route: Float
    stands: NDArray[np.bool_]


def write_extended_cloud(folder: Path, kept: KeptCloud, edge: float) -> None:
    """Append to `static.ply` of a result what stands where this run saw no surface, and write the
    route.

    Args:
        folder: the result.
        kept: of the known cloud.
        edge: m, of the voxels that one of the two fills.
    """
    seen = cloud_from_folder(folder, "static")
    first = np.floor(seen.origin / edge).astype(np.int64)

    def keys(points: Float) -> NDArray[np.int64]:
        return cell_keys(np.floor(points / edge).astype(np.int64) - first)

    own = np.zeros(0, np.int64)
    for block in seen.iter_blocks():
        own = np.union1d(own, keys(block.points))
    only = ~np.isin(keys(kept.points), own)
    more = Block(kept.points[only], kept.p_static[only], None)
    append_vertices(folder / "static.ply", more)
    write_npy(folder / ROUTE, kept.route)
