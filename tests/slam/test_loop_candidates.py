"""Loop candidates, their drift by the graph, and stages."""

from itertools import pairwise

import numpy as np
import pytest
from driven import loop_context
from recordings import of_one_sensor

from stillmap.core import se2
from stillmap.slam import SlamOptions
from stillmap.slam.loop_candidates import (
    graph_distances,
    odometry_constraints,
    propose_candidates,
    split_stages,
    view_centers,
)
from stillmap.slam.loop_closure import reject_inconsistent, reject_inconsistent_since
from stillmap.slam.types import LoopClosure

OPTIONS = SlamOptions()
# as sure as 5 m of travel
SURE = np.diag([0.03**2, 0.03**2, 0.006**2])


def make_context(poses):
    """Poses (K, 3, 3) a metre of travel apart, each a keyframe."""
    n = len(poses)
    recording = of_one_sensor(
        np.arange(n), np.zeros(n + 1, np.int64), np.zeros((0, 2), np.float32), np.zeros(0, bool)
    )
    return loop_context(recording, poses, np.arange(float(n)), np.arange(n))


def straight(n):
    return make_context(se2.matrix(np.arange(float(n)), 0.0, 0.0))


def laps(n):
    """n times along the same 20 m, each time from the start again."""
    return make_context(se2.matrix(np.tile(np.arange(21.0), n), 0.0, 0.0))


def tie(earlier, later, covariance=SURE, T=None):
    T = np.eye(3) if T is None else T
    return LoopClosure(earlier, later, T, covariance, 1.0, score=40.0)


def test_drift_of_candidates_follows_the_graph():
    context = laps(3)

    def proposed(closures):
        centers = view_centers(context)
        found = propose_candidates(context, context.poses, centers, 42, 63, closures)
        return {candidate.later: candidate for candidate in found}

    # third lap: as uncertain as the way from its start
    third = proposed([tie(k, 21 + k) for k in range(21)])
    assert set(third) == set(range(42, 63))
    for later, candidate in third.items():
        assert candidate.drift_distance <= later - 42 + 1 + 20 + 5
        assert candidate.drift_distance <= later - candidate.earlier
    alone = proposed([])[50]
    assert alone.drift_distance == 50 - alone.earlier


def test_candidates_use_corrected_poses():
    n = 60
    drifted = make_context(se2.matrix(np.arange(float(n)), 0.0, 0.0))
    there_and_back = np.concatenate([np.arange(30.0), np.arange(30.0)])
    corrected = se2.matrix(there_and_back, 0.3, 0.0)
    assert list(propose_candidates(drifted, drifted.poses, view_centers(drifted), 30, 60, [])) == []
    found = list(propose_candidates(drifted, corrected, view_centers(drifted), 30, 60, []))
    assert [(c.earlier, c.later) for c in found] == [(k, 30 + k) for k in range(30)]
    np.testing.assert_allclose([c.T for c in found], np.tile(np.eye(3), (30, 1, 1)), atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 41, 500])
def test_stages_cover_all_keyframes(n):
    ranges = list(split_stages(straight(n)))
    assert ranges[0][0] == 0
    assert ranges[-1][1] == n
    assert all(one[1] == other[0] for one, other in pairwise(ranges))
    assert all(first < last for first, last in ranges)


def test_consistency_by_stages_equals_consistency_at_once():
    context = laps(2)
    chain = odometry_constraints(context, [])
    rng = np.random.default_rng(3)
    shifts = rng.choice([0.2, 0.2, -0.3], 21)
    found = [tie(k, 21 + k, T=se2.matrix(shift, 0.0, 0.0)) for k, shift in enumerate(shifts)]
    at_once = [c.rejected for c in reject_inconsistent(context, chain, found)]
    assert {bool(reason) for reason in at_once} == {True, False}
    for stage in (1, 2, 3, 7):
        decided: list[LoopClosure] = []
        for first in range(0, 21, stage):
            new = found[: first + stage]
            decided = reject_inconsistent_since(context, chain, new, decided, 21 + first)
        assert [c.rejected for c in decided] == at_once


def test_drift_between_two_keyframes_is_that_of_the_more_certain_edge():
    """A closure between neighbours of the chain counts only where it is shorter than the travel."""
    context = straight(4)
    certain, uncertain = np.eye(3) * 0.003**2, np.eye(3) * 0.3**2
    assert graph_distances(context, 3, [tie(0, 3, uncertain)]).tolist() == [3.0, 2.0, 1.0, 0.0]
    np.testing.assert_allclose(
        graph_distances(context, 3, [tie(1, 2, uncertain), tie(1, 2, certain)]),
        [2.5, 1.5, 1.0, 0.0],
    )
