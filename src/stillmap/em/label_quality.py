"""Expected F1 of labels, without truth: one and the same estimator judges those of all others."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em import occupancy_hmm
from stillmap.em.options import EmOptions
from stillmap.em.types import DYNAMIC_BELOW, Float

_CELL = {2: 0.2, 3: 0.15}  # m, by dimension: the same for every recording, whatever its resolution
_OPTIONS = replace(EmOptions(), change_detection=False)


class ExpectedCounts(NamedTuple):
    """Expected numbers of returns.

    Attributes:
        both: dynamic and labelled dynamic.
        dynamic: dynamic.
        labelled: labelled dynamic.
    """

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
    hits = recording.hit & np.isfinite(recording.points).all(axis=1)
    q, cell = np.ones(int(hits.sum())), _CELL[recording.dimension]
    for poses in candidates:
        judged, _ = occupancy_hmm.final_e_step(recording, poses, cell, _OPTIONS, threads)
        q = np.minimum(q, 1.0 - judged.p_static[hits].astype(np.float64))
    dynamic = p_static[hits] < DYNAMIC_BELOW
    return ExpectedCounts(float(q[dynamic].sum()), float(q.sum()), float(dynamic.sum()))


def expected_f1(counts: Iterable[ExpectedCounts]) -> float | None:
    """2 sum both / (sum dynamic + sum labelled); None where nothing is dynamic."""
    both, dynamic, labelled = np.sum([ExpectedCounts(0.0, 0.0, 0.0), *counts], axis=0).tolist()
    return 2.0 * both / (dynamic + labelled) if dynamic + labelled > 0.0 else None
