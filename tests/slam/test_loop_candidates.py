"""Loop candidates, their drift by the graph, and stages."""

import dataclasses
from itertools import accumulate, pairwise

import numpy as np
import pytest

from stillmap import _core
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.eval.trajectory import compute_absolute_errors
from stillmap.sim import RobotOptions, Scene, simulate
from stillmap.sim.options import CrowdOptions, LaserOptions, OdometryOptions
from stillmap.sim.walls import box
from stillmap.slam import (
    SlamOptions,
    local_map,
    loop_candidates,
    loop_verification,
    scan_matching,
)
from stillmap.slam.loop_candidates import (
    graph_distances,
    odometry_constraints,
    propose_candidates,
    split_stages,
    view_centers,
)
from stillmap.slam.loop_closure import close_loops, reject_inconsistent, reject_inconsistent_since
from stillmap.slam.types import LoopCandidate, LoopClosure, LoopContext, MStepResult

OPTIONS = SlamOptions()
# as sure as 5 m of travel
SURE = np.diag([0.03**2, 0.03**2, 0.006**2])


def make_context(poses):
    """Poses (K, 3, 3) a metre of travel apart, each a keyframe."""
    n = len(poses)
    recording = Recording(
        stamp_ns=np.arange(n),
        offset=np.zeros(n + 1, np.int64),
        points=np.zeros((0, 2), np.float32),
        hit=np.zeros(0, bool),
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(n, np.int32),
        T_odom_base=None,
        source={},
    )
    return LoopContext(
        recording,
        np.zeros(0, np.float32),
        poses,
        np.arange(float(n)),
        np.ones(n),
        np.arange(n),
        0.05,
        1.0,
        6.0,
        np.zeros((n, 3, 3)),
    )


def straight(n):
    return make_context(se2.matrix(np.arange(float(n)), 0.0, 0.0))


def laps(n):
    """n times along the same 20 m, each time from the start again."""
    return make_context(se2.matrix(np.tile(np.arange(21.0), n), 0.0, 0.0))


def tie(earlier, later, covariance=SURE, T=None):
    return LoopClosure(earlier, later, np.eye(3) if T is None else T, covariance, 1.0)


def test_drift_without_closures_is_travel():
    np.testing.assert_array_equal(graph_distances(straight(50), 30, []), np.arange(30, -1, -1))


def test_shortest_path_through_a_closure():
    metres = graph_distances(straight(50), 41, [tie(10, 31)])
    np.testing.assert_allclose(metres[[10, 0, 20, 31, 41]], [15, 25, 21, 10, 0])


def test_closures_in_two_rooms_do_not_shorten_the_way_between():
    rooms = [tie(0, 20), tie(60, 80)]
    metres = graph_distances(straight(81), 80, rooms)
    assert metres[60] == pytest.approx(5.0)  # the same room
    assert metres[20] == pytest.approx(5.0 + 40.0)  # the other room and the way there
    assert metres[0] == pytest.approx(5.0 + 40.0 + 5.0)


def test_uncertain_closures_count_as_more_travel():
    sliding = SURE + np.diag([0.6**2, 0.0, 0.0])
    across = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for covariance in (sliding, across @ sliding @ across.T):
        metres = graph_distances(straight(301), 300, [tie(50, 280, covariance)])
        expected = 20.0 + np.hypot(0.6, 0.03) / loop_candidates._DRIFT_TRANSLATION
        assert metres[50] == pytest.approx(expected)


def test_drift_of_candidates_follows_the_graph():
    context = laps(3)
    closures = [tie(k, 21 + k) for k in range(21)]
    # third lap: as uncertain as the way from its start
    third = {
        c.later: c
        for c in propose_candidates(context, context.poses, view_centers(context), 42, 63, closures)
    }
    assert set(third) == set(range(42, 63))
    for later, candidate in third.items():
        assert candidate.drift_distance <= later - 42 + 1 + 20 + 5
        assert candidate.drift_distance <= later - candidate.earlier
    alone = {
        c.later: c
        for c in propose_candidates(context, context.poses, view_centers(context), 42, 63, [])
    }
    assert alone[50].drift_distance == 50 - alone[50].earlier


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


def test_stages_grow_with_travel():
    ranges = list(split_stages(straight(20000)))
    length = np.diff(ranges, axis=1).ravel()
    assert length[0] == loop_candidates._MIN_STAGE
    assert length[:-1].max() > 0.04 * 20000
    assert len(ranges) < 110  # 500, were all as long as the first


def test_consistency_by_stages_equals_consistency_at_once():
    context = laps(2)
    chain = odometry_constraints(context, OPTIONS.odometry, [])
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


def rounds(drift=1.0):
    """Four times round a square of corridors, 24 m each, in poses that drift."""
    pillars = [
        wall
        for x in range(-4, 5, 2)
        for at in ((x, -4.4), (4.4, x), (x + 1, 4.4), (-4.4, x))
        for wall in box(*at, 0.2 + 0.03 * x, 0.3)
    ]
    scene = Scene(
        "rounds",
        walls=(*box(0, 0, 9, 9), *box(0, 0, 4, 4), *pillars),
        route=((-3, -3), (3, -3), (3, 3), (-3, 3), (-3, -2.9)),
        crowd=CrowdOptions(people=0),
        laser=LaserOptions(beams=120, max_range=6.0),
        robot=RobotOptions(scans=1100),
        odometry=OdometryOptions(),
    )
    simulation = simulate(scene, 1)
    truth = simulation.truth.T_world_base
    truth = se2.inverse(truth[0]) @ truth
    steps = (
        se2.inverse(truth[:-1]) @ truth[1:] @ se2.matrix(*(drift * np.array([8e-4, 4e-4, 1e-4])))
    )
    return simulation.recording, truth, np.array([*accumulate(steps, np.matmul, initial=np.eye(3))])


def local(poses):
    n = len(poses)
    return MStepResult(poses, np.zeros((n, 3, 3)), _core.OccupancyGrid2D(0.05), np.ones(n))


def missed(T, truth, candidate):
    """Metres between the truth and a pose of a later scan in the frame of an earlier one."""
    true = se2.inverse(truth[candidate.earlier]) @ truth[candidate.later]
    return np.hypot(*se2.parameters(se2.inverse(true) @ T)[:2])


def test_candidates_follow_from_corrected_stages(monkeypatch):
    asked = []
    attempts = loop_verification.verify_candidates

    def recorded(context, candidates):
        asked.append(list(candidates))
        return attempts(context, asked[-1])

    monkeypatch.setattr(loop_verification, "verify_candidates", recorded)
    recording, truth, poses = rounds(drift=4.0)
    e = np.full(recording.n_beams, 0.9, np.float32)
    calls = []
    monkeypatch.setattr(loop_candidates, "_MIN_STAGE", 8.0)
    close_loops(recording, e, OPTIONS, local(poses), lambda *at: calls.append(at))
    assert len(calls) > 3
    assert calls == sorted(calls)
    assert {total for _, total in calls} == {recording.n_scans}
    third = [c for stage in asked for c in stage if c.later > 600]
    without = [missed(se2.inverse(poses[c.earlier]) @ poses[c.later], truth, c) for c in third]
    assert len(third) > 40
    assert min(without) > 0.3
    assert max(missed(c.T, truth, c) for c in third) < 0.28


def test_verification_starts_at_the_candidate_pose():
    recording, truth, poses = rounds(drift=4.0)
    frames = local_map.select_keyframes(poses, 1.0, 0.5)
    later = int(frames[np.searchsorted(local_map.travelled_distance(poses)[frames], 60.0)])
    earlier = min(range(200), key=lambda t: np.linalg.norm(truth[t] - truth[later]))
    context = dataclasses.replace(
        make_context(poses),
        recording=recording,
        e=np.full(recording.n_beams, 0.9, np.float32),
        travelled=local_map.travelled_distance(poses),
        keyframes=frames,
    )
    T = se2.inverse(truth[earlier]) @ truth[later]
    (found,) = loop_verification.verify_candidates(context, [LoopCandidate(earlier, later, T, 0.0)])
    assert missed(se2.inverse(poses[earlier]) @ poses[later], truth, found) > 0.5
    assert missed(found.T, truth, found) < 0.05  # though no more than 0.2 m are searched


def test_repeated_rounds_do_not_widen_the_search(monkeypatch):
    windows = []
    search = scan_matching.search_pose

    def recorded(grid, scan, prior, translation, rotation):
        windows.append(translation)
        return search(grid, scan, prior, translation, rotation)

    monkeypatch.setattr(scan_matching, "search_pose", recorded)
    monkeypatch.setattr(loop_candidates, "_DRIFT_TRANSLATION", 0.012)
    recording, truth, poses = rounds()
    e = np.full(recording.n_beams, 0.9, np.float32)

    def searched(stage):
        windows.clear()
        monkeypatch.setattr(loop_candidates, "_MIN_STAGE", stage)
        found = close_loops(recording, e, OPTIONS, local(poses), lambda *_: None)
        assert (
            compute_absolute_errors(found.poses, truth).rmse
            < 0.4 * compute_absolute_errors(poses, truth).rmse
        )
        return np.array(windows)

    staged, at_once = searched(10.0), searched(1e9)
    assert len(staged) > 100
    assert staged.max() < 0.75 * at_once.max()
    assert staged.mean() < 0.8 * at_once.mean()
