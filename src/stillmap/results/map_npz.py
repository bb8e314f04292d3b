"""`map.npz`: the occupancy grid with the sums it is made from and the looks it rests on.

How large the known part of a map is, and how much of it is known badly.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npz
from stillmap.core.tiles import Layer, TiledArray, as_type, compact, tiles_of
from stillmap.em import Coverage, OccupancyMap
from stillmap.mapping import Change
from stillmap.pipeline.result import MappingResult

# what `changed` says of a cell
CHANGED = {"came": 1, "left": 2, "comes and goes": 3, "door": 4}


def write_map_npz(
    path: Path,
    occupancy: OccupancyMap,
    changes: Sequence[Change] = (),
    evidence: Coverage | None = None,
) -> None:
    """Write `p_occupied`, `alpha`, `beta` (H, W), `origin` (x, y, yaw), `resolution` in metres.

    Also `changed` (H, W) uint8: 0, or how the place changed, see CHANGED; and where evidence is
    given: `looks`, `clear_looks`, `thin` (H, W).
    """
    arrays: dict[str, Layer] = {
        "p_occupied": as_type(occupancy.p_occupied, np.float32),
        "alpha": as_type(occupancy.alpha, np.float32),
        "beta": as_type(occupancy.beta, np.float32),
        "changed": changed_cells(occupancy, changes),
    }
    if evidence is not None:
        arrays |= {
            "looks": as_type(evidence.observations, np.uint16),
            "clear_looks": as_type(evidence.unobstructed, np.uint16),
            "thin": as_type(evidence.thinly_observed, np.bool_),
        }
    arrays |= {
        "origin": np.asarray(occupancy.origin, np.float64),
        "resolution": np.asarray(occupancy.resolution, np.float64),
    }
    write_npz(path, arrays)


def changed_cells(occupancy: OccupancyMap, changes: Sequence[Change]) -> Layer:
    """(H, W) uint8 code of the last change of each cell; 0: unchanged."""
    height, width = occupancy.p_occupied.shape
    out = TiledArray((height, width), np.uint8, 0)
    first = np.round(np.array(occupancy.origin[:2]) / occupancy.resolution).astype(np.int64)
    for change in sorted(changes, key=lambda one: one.last_ns):
        column, row = (change.swept_cells - first).T
        inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
        code = np.full(int(inside.sum()), CHANGED[change.kind], np.uint8)
        out.put(row[inside], column[inside], code)
    codes: Layer = compact(out)
    return codes


def known_area(result: MappingResult) -> dict[str, float]:
    """`known`: m2 of the map of which beams tell something; `thin`: of these on thin evidence."""
    cell = float(result.map.resolution) ** 2
    known = _count(result.map.p_occupied, lambda p: ~np.isnan(p))
    thin = _count(result.evidence.thinly_observed, lambda thin: thin)
    return {
        "known": round(cell * known, 6),
        "thin": round(cell * thin, 6),
    }


def _count(layer: Layer, select: Callable[[NDArray[Any]], NDArray[np.bool_]]) -> int:
    return sum(int(np.count_nonzero(select(part))) for _, part in tiles_of(layer))
