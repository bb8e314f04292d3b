"""Hits on nothing that is followed: where movers are followed, such hits are static rather.

A place that was looked at once or twice does not tell a wall from somebody who passes: its cells
have a probability near the share of static cells. But most hits on movers lie within the box of
one that is followed, and hardly any on what is static do.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.recording import Recording
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.tracking.explained_hits import MoverHits

Labels = NDArray[np.float32]

_CERTAIN, _SURE = 0.05, 0.95  # P(static) below and above which the cells say what a hit is on
_PRIOR_WEIGHT = 10.0  # hits, of what the certain ones say about the likely ones


def weigh_unfollowed_hits(
    recording: Recording, p_static: Labels, explained: Labels, on_movers: MoverHits
) -> Labels:
    """(M,) P(static), higher for hits outside of all boxes, by Bayes' rule.

    Of the hits on movers, a share lies outside: P(dynamic) counts as many times. Hits that are
    dynamic by their cells belong to tracks, which were weighed.

    Args:
        recording: 2D, M beams.
        p_static: (M,) P(c = 1) from the cells alone.
        explained: (M,) the same, given the movers (`explain_hits`).
        on_movers: from `find_mover_hits`.
    """
    recall = _estimate_recall(recording, p_static, explained, on_movers)
    out = arrays.copy(explained, recording.scratch)
    for block, p in _iter_hits(recording, p_static):
        row = np.flatnonzero(p >= DYNAMIC_BELOW)
        out[block][row] = p[row] / (1.0 - recall * (1.0 - p[row]))
    out[on_movers.beam] = explained[on_movers.beam]
    return out


def _estimate_recall(
    recording: Recording, p_static: Labels, explained: Labels, on_movers: MoverHits
) -> float:
    """Share of the undecided hits on movers that lie within a box.

    As many as of the likely ones, if the cells expect too many movers among the undecided ones; or
    as the cells expect, if fewer of those are followed. The mean of both.
    """
    n_certain, likely, undecided = 0, 0.0, 0.0
    for _, p in _iter_hits(recording, p_static):
        n_certain += np.count_nonzero(p < _CERTAIN)
        likely += _sum_dynamic(p, _CERTAIN, DYNAMIC_BELOW)
        undecided += _sum_dynamic(p, DYNAMIC_BELOW, _SURE)
    p = p_static[on_movers.beam]
    certain = (np.count_nonzero(p < _CERTAIN) + 1.0) / (n_certain + 2.0)
    found = _sum_dynamic(p, _CERTAIN, DYNAMIC_BELOW)
    alike = (found + _PRIOR_WEIGHT * certain) / (likely + _PRIOR_WEIGHT)
    within = explained[on_movers.beam[(p >= DYNAMIC_BELOW) & (p < _SURE)]]
    as_expected = (float(np.sum(1.0 - within, dtype=np.float64)) + alike) / (undecided + 1.0)
    return 0.5 * (alike + min(alike, as_expected))


def _iter_hits(recording: Recording, p_static: Labels) -> Iterator[tuple[slice, Labels]]:
    """Blocks of beams, and P(static) of each; NaN for what hit nothing."""
    for block in arrays.iter_blocks(recording.hit, p_static):
        yield block, np.where(recording.hit[block], p_static[block], np.float32(np.nan))


def _sum_dynamic(p_static: Labels, low: float, high: float) -> float:
    """Expected number of dynamic hits among those from one P(static) to another."""
    of = p_static[(p_static >= low) & (p_static < high)]
    return float(np.sum(1.0 - of, dtype=np.float64))
