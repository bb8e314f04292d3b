"""Expected F1 of labels, without truth."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em import occupancy_hmm
from stillmap.em.options import EmOptions
from stillmap.em.types import DYNAMIC_BELOW, Float

CELL = {2: 0.2, 3: 0.4}  # m, by dimension: the same for every recording, whatever its resolution


def expected_f1(
    recording: Recording, poses: Float, p_static: NDArray[np.float32], threads: int = 1
) -> float | None:
    """Expected F1 of the label dynamic, under P(dynamic) of one and the same estimator.

    With q_n = P(beam n hit something dynamic) by the occupancy HMM with cells of `CELL`, and C the
    set of beams that are labelled dynamic, it is 2 sum_{n in C} q_n / (sum_n q_n + |C|).

    Args:
        recording: 2D or 3D, deskewed.
        poses: (T, D+1, D+1) T_map_base.
        p_static: (M,) labels of any estimator.
        threads: does not change the result.

    Returns:
        from 0 to 1; None where nothing is dynamic, neither by the labels nor by q.
    """
    cell = CELL[recording.dimension]
    judged = occupancy_hmm.e_step(recording, poses, cell, EmOptions(), threads).p_static
    both = expected = called = 0.0
    hits = recording.hit & ~np.isnan(judged)
    q = 1.0 - judged[hits].astype(np.float64)
    dynamic = p_static[hits] < DYNAMIC_BELOW
    both, expected, called = float(q[dynamic].sum()), float(q.sum()), int(dynamic.sum())
    return 2.0 * both / (expected + called) if expected + called > 0.0 else None
