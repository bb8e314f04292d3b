"""How large the known part of a map is, and how much of it is known badly."""

import numpy as np

from stillmap.output.protocols import ResultLike


def known_area(result: ResultLike) -> dict[str, float]:
    """`known`: m2 of the map of which beams tell something; `thin`: of these on thin evidence."""
    cell = float(result.map.resolution) ** 2
    known = result.map.p_occupied.size - int(np.count_nonzero(np.isnan(result.map.p_occupied)))
    return {
        "known": round(cell * known, 6),
        "thin": round(cell * int(np.count_nonzero(result.evidence.thin)), 6),
    }
