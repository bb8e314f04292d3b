"""Where a robot drives the same way again and again, its pose graph stays as large as the area."""

import numpy as np
import pytest
from recordings import of_one_sensor

import stillmap
from stillmap.core import se2
from stillmap.live import graph_sparsification, loop_closer
from stillmap.live.graph_sparsification import AnchoredPoses
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_closer import LoopCloser
from stillmap.live.scan import to_beams
from stillmap.sim.laser import Movers, cast_beams
from stillmap.slam.loop_closure import LoopState
from stillmap.slam.options import SlamOptions
from stillmap.slam.types import LoopClosure, LoopContext

SIDE = 10.0  # m of a square; scans 0.5 m apart, every second one a keyframe
LAP = round(4 * SIDE / 0.5)
ANGLES = np.linspace(-np.pi, np.pi, 180, endpoint=False)


def drive(laps):
    """(S, 3, 3) poses on the way round the square."""
    s = np.arange(laps * LAP) * 0.5 % (4 * SIDE)
    side, along = np.divmod(s, SIDE)
    corner = np.array([[0.0, 0.0], [SIDE, 0.0], [SIDE, SIDE], [0.0, SIDE]])[side.astype(int)]
    heading = side * np.pi / 2
    xy = corner + along[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return se2.matrix(*xy.T, heading)


def context_of(poses, travelled, keyframes):
    n = len(poses)
    recording = of_one_sensor(
        np.arange(n) * 10**9, np.arange(n + 1), np.ones((n, 2), np.float32), np.ones(n, np.bool_)
    )
    e, explained, flat = np.ones(n, np.float32), np.ones(n), np.zeros((n, 3, 3))
    return LoopContext(recording, e, poses, travelled, explained, keyframes, 0.05, 1.0, 6.0, flat)


def tie(first, second, rejected=""):
    return LoopClosure(first, second, np.eye(3), 1e-4 * np.eye(3), 1.0, rejected)


def state_of(poses, keyframes, loops):
    return LoopState(poses[keyframes], loops, loops, [one for one in loops if not one.rejected])


def laps_with_loops(laps):
    """A context, and the loops of all keyframes but those of the first lap, each with the keyframe
    at the same place one lap before."""
    poses = drive(laps)
    keyframes = np.arange(0, len(poses), 2)
    loops = [tie(k - LAP, k) for k in keyframes.tolist() if k >= LAP]
    context = context_of(poses, 0.5 * np.arange(len(poses)), keyframes)
    return context, state_of(poses, keyframes, loops)


def count_passes(stay):
    """(L,) of each lap, the share of its scans that stay."""
    return stay.reshape(-1, LAP).mean(axis=1)


def test_the_first_and_the_latest_passes_stay_however_many_there_were():
    stay = graph_sparsification.select_scans(*laps_with_loops(20))
    passes = count_passes(stay)
    assert passes[0] == 1.0
    assert (passes[1:12] == 0.0).all()
    assert passes[-2:].min() == 1.0
    assert stay.sum() <= 8 * LAP
    assert graph_sparsification.select_scans(*laps_with_loops(30)).sum() == stay.sum()


def test_stretches_that_no_loop_ties_stay():
    context, state = laps_with_loops(20)
    loops = [one for one in state.found if not 5 * LAP <= one.later < 6 * LAP]
    loops = [one for one in loops if not 5 * LAP <= one.earlier < 6 * LAP]
    state = state_of(context.poses, context.keyframes, loops)
    passes = count_passes(graph_sparsification.select_scans(context, state))
    assert passes[5] == 1.0
    assert passes[4] == 0.0


def test_scans_of_a_robot_that_stands_leave():
    poses = np.concatenate([np.eye(3)[None].repeat(40, axis=0), drive(1)])
    keyframes = np.append(0, np.arange(41, len(poses), 2))
    context = context_of(poses, np.append(np.zeros(40), 0.5 * np.arange(LAP)), keyframes)
    stay = graph_sparsification.select_scans(context, state_of(poses, keyframes, []))
    assert stay[0]
    assert not stay[1:40].any()
    assert stay[41:].all()


def test_a_loop_to_a_scan_that_leaves_becomes_one_to_the_nearest_that_stays():
    context, state = laps_with_loops(20)
    stay, keyframes = graph_sparsification.select_scans(context, state), context.keyframes
    moved = graph_sparsification.select_state(state, keyframes, stay)
    kept = np.flatnonzero(stay)
    poses = context.poses[kept]
    assert len(moved.attempted) == len(moved.found)
    assert len(moved.fitting) == stay[keyframes][LAP // 2 :].sum()
    later = [one.later for one in moved.found]
    assert later == sorted(later)
    for one in moved.fitting:
        between = se2.inverse(poses[one.earlier]) @ poses[one.later]
        np.testing.assert_allclose(one.T, between, atol=1e-9)
        assert one.earlier < one.later


def test_scans_that_left_the_graph_move_with_one_that_stayed():
    poses, anchored = drive(6), AnchoredPoses()
    stay = np.ones(4 * LAP, np.bool_)
    stay[LAP : 3 * LAP] = False
    anchored.remove(stay, poses[: 4 * LAP])
    in_graph = np.concatenate([poses[: 4 * LAP][stay], poses[4 * LAP :]])
    np.testing.assert_allclose(anchored.place(in_graph), poses, atol=1e-9)
    # what they move with leaves as well
    again = np.ones(len(in_graph), np.bool_)
    again[:LAP] = False
    anchored.remove(again, in_graph)
    T = se2.matrix(1.0, 2.0, 0.3)
    np.testing.assert_allclose(anchored.place(T @ in_graph[LAP:]), T @ poses, atol=1e-9)


# a room with a step in each wall
CORNERS = [(-3, -3), (14, -3), (14, 5), (12.5, 5), (12.5, 13), (4, 13), (4, 14), (-3, 14), (-3, 6)]
CORNERS = np.array([*CORNERS, (-2, 6)], float)
WALLS = np.concatenate([CORNERS, np.roll(CORNERS, -1, axis=0)], axis=1)


@pytest.mark.slow
def test_poses_stay_right_while_scans_leave_the_graph(monkeypatch):
    """Many laps of a drifting robot."""
    monkeypatch.setattr(loop_closer, "_MIN_SCANS", 4 * LAP)
    monkeypatch.setattr(graph_sparsification, "_LATEST", 1)
    closer, truth = LoopCloser(SlamOptions()), drive(8)
    n = len(truth)
    nobody = Movers(np.zeros((n, 0, 2)), np.zeros((n, 0)), np.zeros((0, 2)), np.zeros(0, np.int32))
    ranges = cast_beams(se2.parameters(truth), ANGLES, WALLS, nobody).range
    rng, T = np.random.default_rng(2), np.eye(3)
    for k, at in enumerate(truth):
        step = se2.matrix(*rng.normal(0.0, [0.006, 0.006, 0.003]))
        T = T if k == 0 else T @ se2.inverse(truth[k - 1]) @ at @ step
        beams = to_beams(stillmap.Scan(k * 10**9, ranges[k], ANGLES))
        scan = MappedScan(beams, np.ones(len(ANGLES), np.float32), T, 0.5 * k)
        closer.add(scan, 1.0, np.zeros((3, 3)))
        closer.poll()
    closer.stop()
    assert len(closer._scans) < 6 * LAP
    assert len(closer._state.poses) == len(closer._centers) <= len(closer._keyframes)
    every = closer._anchored.place(closer._poses)
    found = np.hypot(*(every[:, :2, 2] - truth[: len(every), :2, 2]).T)
    assert len(every) >= len(truth) - 8
    assert np.sqrt(np.mean(found**2)) < 0.1
    assert np.hypot(*(T[:2, 2] - truth[-1, :2, 2])) > 0.3  # the drift of what was added
