"""Expected F1 of labels, without truth: one and the same estimator judges those of all others."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import finite_rows
from stillmap.core.recording import Recording
from stillmap.em.final_labels import final_e_step
from stillmap.em.options import EmOptions
from stillmap.em.types import DYNAMIC_BELOW, Float

_CELL = {2: 0.2, 3: 0.15}  # m, by dimension: the same for every recording, whatever its resolution
_MIN_DYNAMIC = 0.002  # share of the returns: with less, F1 is that of a few returns by chance
_OPTIONS = replace(EmOptions(), change_detection=False)


class ExpectedCounts(NamedTuple):
    """Expected numbers of returns.

    Attributes:
        returns: all.
        likely: more likely dynamic than static.
        both: dynamic and labelled dynamic.
        dynamic: dynamic.
        labelled: labelled dynamic.
    """

    returns: float
    likely: float
    both: float
    dynamic: float
    labelled: float


def count_expected(
    recording: Recording,
    candidates: Iterable[Float],
    p_static: NDArray[np.float32],
    threads: int = 1,
) -> ExpectedCounts:
    """Expected counts of the labels of some scans.

    q_n = P(return n is of something dynamic) by the occupancy HMM in cells of a fixed size. A wrong
    pose makes what is static look dynamic, hardly the reverse: q_n is the lowest of all candidates.

    Args:
        recording: 2D or 3D, deskewed.
        candidates: poses (T, D+1, D+1) T_map_base, each on its own.
        p_static: (M,) labels of any estimator.
        threads: does not change the result.
    """
    hits = recording.hit & finite_rows(recording.points)
    q, cell = np.ones(int(hits.sum())), _CELL[recording.dimension]
    for poses in candidates:
        judged, _ = final_e_step(recording, poses, cell, _OPTIONS, threads, with_shapes=False)
        q = np.minimum(q, 1.0 - judged.p_static[hits].astype(np.float64))
    dynamic = p_static[hits] < DYNAMIC_BELOW
    sums = (float(q[dynamic].sum()), float(q.sum()), float(dynamic.sum()))
    return ExpectedCounts(float(len(q)), float(np.count_nonzero(q > 0.5)), *sums)


def expected_f1(counts: Iterable[ExpectedCounts]) -> float | None:
    """2 sum both / (sum dynamic + sum labelled); None where hardly anything is dynamic."""
    none = ExpectedCounts(*np.zeros(5))
    returns, likely, both, dynamic, labelled = np.sum([none, *counts], axis=0).tolist()
    is_rare = likely + labelled <= 2.0 * _MIN_DYNAMIC * returns
    return None if is_rare else 2.0 * both / (dynamic + labelled)
