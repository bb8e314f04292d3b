"""Cells of a recording in space that tell of something that came to stay, or left."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.em.courses import OFTEN, Courses

_TELLS = 1.0  # nats by which a change explains what was seen of a cell better than all else
_SURE = 1e-6  # probabilities keep so far from 0 and 1


@dataclass(frozen=True, eq=False)
class Changed:
    """K cells; what each of them says is little, but many side by side may say the same.

    Attributes:
        cells: (K, D) int64.
        p_thing: (K,) float32, that a thing stood there at the last look.
        count: (K,) int32, how often one came or left: once or twice.
        between: (K, 2, 2) int32, looks before and after the first and the last of these changes.
    """

    cells: NDArray[np.int64]
    p_thing: NDArray[np.float32]
    count: NDArray[np.int32]
    between: NDArray[np.int32]


def changed_of(courses: Courses) -> Changed:
    """The cells that a change explains better, whatever share of all cells changed.

    A car that parks and leaves is some hundred cells among a million: each of them alone is more
    probably something that stands still and was missed for a while.
    """
    odds = _log_odds(courses.p_changing) - _log_odds(np.array([courses.share]))
    of = np.flatnonzero((courses.count > 0) & (courses.count < OFTEN) & (odds > _TELLS))
    return Changed(courses.cells[of], courses.p_thing[of], courses.count[of], courses.between[of])


def _log_odds(p: NDArray[np.floating]) -> NDArray[np.float64]:
    kept = np.clip(p.astype(np.float64), _SURE, 1.0 - _SURE)
    return np.asarray(np.log(kept / (1.0 - kept)))
