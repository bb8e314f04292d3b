"""`map.npz`: the occupancy grid with the sums it is made from and the looks it rests on.

How large the known part of a map is, and how much of it is known badly.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npz
from stillmap.em import Coverage, OccupancyMap
from stillmap.mapping import Change
from stillmap.pipeline.result import MappingResult

# what `changed` says of a cell
CHANGED = {"came": 1, "left": 2, "comes and goes": 3}


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
    arrays: dict[str, NDArray[Any]] = {
        "p_occupied": np.asarray(occupancy.p_occupied, np.float32),
        "alpha": np.asarray(occupancy.alpha, np.float32),
        "beta": np.asarray(occupancy.beta, np.float32),
        "changed": changed_cells(occupancy, changes),
    }
    if evidence is not None:
        arrays |= {
            "looks": np.asarray(evidence.observations, np.uint16),
            "clear_looks": np.asarray(evidence.unobstructed, np.uint16),
            "thin": np.asarray(evidence.thinly_observed, np.bool_),
        }
    arrays |= {
        "origin": np.asarray(occupancy.origin, np.float64),
        "resolution": np.asarray(occupancy.resolution, np.float64),
    }
    write_npz(path, arrays)


def changed_cells(occupancy: OccupancyMap, changes: Sequence[Change]) -> NDArray[np.uint8]:
    """(H, W) code of the last change of each cell; 0: unchanged."""
    height, width = occupancy.p_occupied.shape
    out = np.zeros((height, width), np.uint8)
    first = np.round(np.array(occupancy.origin[:2]) / occupancy.resolution).astype(np.int64)
    for change in sorted(changes, key=lambda one: one.last_ns):
        column, row = (change.swept_cells - first).T
        inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
        out[row[inside], column[inside]] = CHANGED[change.kind]
    return out


def known_area(result: MappingResult) -> dict[str, float]:
    """`known`: m2 of the map of which beams tell something; `thin`: of these on thin evidence."""
    cell = float(result.map.resolution) ** 2
    known = result.map.p_occupied.size - int(np.count_nonzero(np.isnan(result.map.p_occupied)))
    return {
        "known": round(cell * known, 6),
        "thin": round(cell * int(np.count_nonzero(result.evidence.thinly_observed)), 6),
    }
