"""Loop closure in 3D: found, verified, propagated; false loops rejected."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import Boxes, Lidar, Way, recorded
from driven import chained, silent

from stillmap.core import se2, se3
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.slam import SlamOptions, lidar_odometry, loop_closure_3d
from stillmap.slam.options import OdometryOptions
from stillmap.slam.pose_graph import Constraint, optimize_poses, squared_mahalanobis

LIDAR = Lidar(rings=16, columns=180, period=0.2, reach=40.0)
SPEED = 3.0


def block():
    """A building to go round, and buildings of all sizes around the way."""
    rng = np.random.default_rng(5)
    rows = [[0, 0, -2.0, 200, 200, 0.4, 0, 0, 0], [7.5, 7.5, 2, 8, 8, 8, 0, 0, 0]]
    for angle in np.linspace(0.0, 2.0 * np.pi, 14, endpoint=False):
        x, y = 7.5 + 19.0 * np.cos(angle), 7.5 + 19.0 * np.sin(angle)
        rows.append([x, y, 2.0, *rng.uniform(2.0, 6.0, 2), rng.uniform(4.0, 12.0), 0, 0, 0])
    return Boxes.of(rows)


def round_the_block():
    """Straight on for 15 m, a quarter turn, and so on, one and a half times, at 3 m/s."""
    turning = np.tile(np.repeat([0.0, 1.0], [50, 16]), 7)
    twists = np.zeros((len(turning), 6))
    twists[:, 0] = SPEED
    twists[:, 5] = np.convolve(turning, np.full(8, 1.0 / 8.0), mode="same")
    return Way(np.eye(4), twists, 0.1)


@pytest.fixture(scope="module")
def drive():
    """A recording, its true poses, e, and what odometry without any error would find."""
    recording, truth, e = recorded(block(), LIDAR, round_the_block(), 200, seed=1)
    driven = lidar_odometry.register_sweeps(recording, e, OdometryOptions(), silent, 1)
    assert compute_absolute_errors(driven.poses, truth).rmse < 0.1
    return recording, truth, e, driven


def drifted(driven, per_step):
    """The same poses, every step off by a twist (6,)."""
    steps = se2.inverse(driven.poses[:-1]) @ driven.poses[1:] @ se3.exp(np.asarray(per_step))
    return replace(driven, poses=driven.poses[0] @ chained(steps))


def closed(drive, driven):
    recording, _, e, _ = drive
    return loop_closure_3d.close_loops_3d(recording, e, SlamOptions(), driven, silent, 1)


def off(loop, truth):
    """m from the true relation of its sweeps."""
    true = se2.inverse(truth[loop.earlier]) @ truth[loop.later]
    return np.linalg.norm((se2.inverse(true) @ loop.T)[:3, 3])


@pytest.mark.slow
def test_loops_correct_drift(drive):
    truth = drive[1]
    driven = drifted(drive[3], [0.005, 0.0, 0.005, 0.0, 0.0, 0.0005])
    found, loops, graph = closed(drive, driven)
    before, after = (compute_absolute_errors(poses, truth).rmse for poses in (driven.poses, found))
    assert before > 0.2
    assert after < 0.35 * before
    accepted = [loop for loop in loops if not loop.rejected]
    assert len(accepted) >= 3
    assert max(off(loop, truth) for loop in accepted) < 0.15
    assert len(graph.constraints) == len(graph.keyframes) - 1 + len(accepted)


@pytest.mark.slow
def test_false_candidates_are_rejected(drive, monkeypatch):
    """Turned so far that the far side of the block seems to be where the drive began."""
    driven = drive[3]
    wrong = driven.poses.copy()
    half = len(wrong) // 2
    wrong[half:, :3, 3] += wrong[2, :3, 3] - wrong[half, :3, 3]
    monkeypatch.setattr(loop_closure_3d, "_MIN_LOOP_TRAVEL", 10.0)
    monkeypatch.setattr(loop_closure_3d, "_SUBMAP_TRAVEL", 5.0)
    poses, loops, _ = closed(drive, replace(driven, poses=wrong))
    tried = [loop for loop in loops if loop.later >= half > loop.earlier]
    assert tried
    assert all(loop.rejected or off(loop, drive[1]) < 0.3 for loop in tried)
    assert np.isfinite(poses).all()


@pytest.mark.slow
def test_similar_streets_are_rejected():
    """Two streets of the same width: the ground and the rows of houses meet, their ends do not."""
    rng = np.random.default_rng(7)
    rows = [[60.0, 0.0, -2.0, 300.0, 300.0, 0.4, 0, 0, 0]]
    for x in np.arange(-40.0, 160.0, 9.0):
        for side in (-1, 1):
            w, y = rng.uniform(4.0, 8.5), side * (12.0 + rng.uniform(-1.0, 1.0))
            rows.append([x, y, 2.0, w, 8.0, rng.uniform(4.0, 12.0), 0, 0, 0])
    twists = np.zeros((400, 6))
    twists[:, 0] = 4.0
    recording, truth, e = recorded(Boxes.of(rows), LIDAR, Way(np.eye(4), twists, 0.1), 110, seed=2)
    straight = lidar_odometry.LidarOdometry(
        truth, np.tile(twists[0], (110, 1)), np.zeros((110, 6, 6)), np.full(110, 0.8)
    )
    wrong = truth.copy()
    wrong[70:, 0, 3] -= wrong[70, 0, 3] - wrong[10, 0, 3]  # as if the robot had been carried back
    _, loops, _ = closed((recording, truth, e, straight), replace(straight, poses=wrong))
    assert len(loops) >= 8
    assert all(loop.rejected for loop in loops)


def test_pose_graph_3d():
    """Two steps said to be 1.2 m long, yet the end is known to be at 2 m."""
    step = se3.exp(np.array([1.2, 0, 0, 0, 0, 0.0]))
    covariance = np.diag([1e-2] * 3 + [1e-4] * 3)
    chain = [Constraint(0, 1, step, covariance), Constraint(1, 2, step, covariance)]
    start = np.array([np.eye(4), step, step @ step])
    loop = Constraint(0, 2, se3.exp(np.array([2.0, 0, 0, 0, 0, 0])), 1e-8 * np.eye(6))
    found = optimize_poses(start, chain, [loop], None)
    assert found[:, 0, 3] == pytest.approx([0.0, 1.0, 2.0], abs=1e-4)
    assert squared_mahalanobis(found, chain) == pytest.approx([4.0, 4.0], rel=1e-3)
    false = Constraint(0, 2, se3.exp(np.array([9.0, 0, 0, 0, 0, 1.0])), 1e-2 * np.eye(6))
    robust = optimize_poses(start, chain, [loop, false], 25.0)
    assert robust[2, 0, 3] == pytest.approx(2.0, abs=0.01)


def test_covariance_convention_of_gtsam():
    """Loose in x of the second pose, which looks along y: the middle gives way along y."""
    turned = se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    ahead = se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))
    tight, loose = np.diag([1e-6] * 6), np.diag([1e-2, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6])
    chain = [Constraint(0, 1, turned, tight), Constraint(1, 2, ahead, loose)]
    start = np.array([np.eye(4), turned, turned @ ahead])
    end = turned @ ahead
    end[1, 3] += 0.3
    found = optimize_poses(start, chain, [Constraint(0, 2, end, np.diag([1e-8] * 6))], None)
    assert found[2, :3, 3] == pytest.approx([0.0, 1.3, 0.0], abs=1e-3)
    assert found[1, :3, 3] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
