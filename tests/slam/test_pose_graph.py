"""Pose graphs with answers known by hand."""

import numpy as np
import pytest
from driven import chained

from stillmap.core import se2
from stillmap.slam.pose_graph import (
    Constraint,
    HeadingMeasurement,
    optimize_headings,
    optimize_poses,
    squared_mahalanobis,
)

STEP = np.diag([1e-2, 1e-2, 1e-4])
MAX_CHI2 = 16.0


def dead_reckoned(chain):
    return chained(np.array([step.T for step in chain]))


def apart(a, b):
    return np.linalg.norm(a[:, :2, 2] - b[:, :2, 2], axis=1)


def test_error_is_shared_evenly():
    # four steps said to be 1.1 m long, yet the end is known to be at 4 m: 1 m each
    chain = [Constraint(k, k + 1, se2.matrix(1.1, 0, 0), STEP) for k in range(4)]
    loop = Constraint(0, 4, se2.matrix(4.0, 0, 0), 1e-6 * np.eye(3))
    x = se2.parameters(optimize_poses(dead_reckoned(chain), chain, [loop], None))
    np.testing.assert_allclose(x[:, 0], [0, 1, 2, 3, 4], atol=1e-4)
    np.testing.assert_allclose(x[:, 1:], 0, atol=1e-6)


def test_uncertain_step_takes_more_error():
    ahead = se2.matrix(1, 0, 0)
    chain = [Constraint(0, 1, ahead, STEP), Constraint(1, 2, ahead, 3 * STEP)]
    loop = Constraint(0, 2, se2.matrix(2.4, 0, 0), 1e-8 * np.eye(3))
    x = se2.parameters(optimize_poses(dead_reckoned(chain), chain, [loop], None))
    np.testing.assert_allclose(x[:, 0], [0, 1.1, 2.4], atol=1e-4)


def test_covariances_hold_in_the_frame_of_the_second_pose():
    # the robot has turned left; loose along its x, which is the map's y
    chain = [
        Constraint(0, 1, se2.matrix(0, 0, np.pi / 2), 1e-8 * np.eye(3)),
        Constraint(1, 2, se2.matrix(1, 0, 0), np.diag([1.0, 1e-6, 1e-6])),
    ]
    loop = Constraint(0, 2, se2.matrix(0.5, 1.5, np.pi / 2), np.diag([1e-4, 1.0, 1e-4]))
    x = se2.parameters(optimize_poses(dead_reckoned(chain), chain, [loop], None))
    np.testing.assert_allclose(x[2, :2], [0.0, 1.5], atol=0.01)


def test_squared_mahalanobis_by_hand():
    poses = np.array([np.eye(3), se2.matrix(2.0, 0.0, 0.0)])
    relation = Constraint(0, 1, se2.matrix(1.7, 0.4, 0.0), np.diag([0.01, 0.04, 1.0]))
    fits = Constraint(0, 1, poses[1], np.eye(3))
    expected = [0.3**2 / 0.01 + 0.4**2 / 0.04, 0.0]
    np.testing.assert_allclose(squared_mahalanobis(poses, [relation, fits]), expected, atol=1e-12)
    assert squared_mahalanobis(poses, []).shape == (0,)


STEP_ERROR = np.diag([0.03**2, 0.015**2, 0.004**2])
LOOP_ERROR = np.diag([0.03**2, 0.03**2, 0.006**2])


def rounds(rng, laps, false):
    """Truth, chain and loops of 100 m a lap, all with the errors that they are said to have.

    60 of the loops are true; the false ones tie any two poses to anywhere within 2 m.
    """
    step, corner = se2.matrix(1.0, 0.0, 0.0), se2.matrix(1.0, 0.0, np.pi / 2)
    truth = chained(np.array(([step] * 24 + [corner]) * (4 * laps)))

    def seen(i, j, covariance):
        noise = se2.matrix(*(np.sqrt(np.diag(covariance)) * rng.standard_normal(3)))
        return Constraint(i, j, se2.inverse(truth[i]) @ truth[j] @ noise, covariance)

    chain = [seen(k, k + 1, STEP_ERROR) for k in range(len(truth) - 1)]
    later = rng.integers(100, len(truth), 60).tolist()
    loops = [seen(k - 100 * int(rng.integers(1, k // 100 + 1)), k, LOOP_ERROR) for k in later]
    for _ in range(false):
        i, j = sorted(rng.choice(len(truth), 2, replace=False).tolist())
        anywhere = se2.matrix(*rng.uniform([-2, -2, -np.pi], [2, 2, np.pi]))
        loops.append(Constraint(i, j, anywhere, LOOP_ERROR))
    return truth, chain, loops


@pytest.mark.parametrize("seed", range(5))
def test_one_false_loop_in_ten_is_survived_by_annealing(seed):
    truth, chain, loops = rounds(np.random.default_rng(seed), laps=3, false=6)
    found = optimize_poses(dead_reckoned(chain), chain, loops, MAX_CHI2)
    misfit = squared_mahalanobis(found, loops)
    assert misfit[:60].max() < MAX_CHI2
    assert misfit[60:].min() > MAX_CHI2
    # as good as without the false ones
    clean = apart(optimize_poses(dead_reckoned(chain), chain, loops[:60], None), truth).max()
    assert apart(found, truth).max() < 1.1 * clean + 0.01
    assert apart(optimize_poses(dead_reckoned(chain), chain, loops, None), truth).max() > 5.0


def test_consistent_loops_keep_their_weight():
    _, chain, loops = rounds(np.random.default_rng(1), laps=2, false=0)
    plain = optimize_poses(dead_reckoned(chain), chain, loops, None)
    robust = optimize_poses(dead_reckoned(chain), chain, loops, MAX_CHI2)
    assert squared_mahalanobis(plain, loops).max() < MAX_CHI2
    np.testing.assert_array_equal(robust, plain)


def test_measured_headings_bend_the_chain():
    # four steps straight ahead, turned by .01 rad in all: .0025 each
    chain = [Constraint(k, k + 1, se2.matrix(1.0, 0, 0), STEP) for k in range(4)]
    measured = [HeadingMeasurement(0, 1.0, 1e-5), HeadingMeasurement(4, 1.01, 1e-5)]
    x = se2.parameters(optimize_headings(dead_reckoned(chain), chain, measured))
    np.testing.assert_allclose(x[:, 2], [0.0, 0.0025, 0.005, 0.0075, 0.01], atol=1e-3)
    np.testing.assert_allclose(x[0], 0.0, atol=1e-12)
    # one wrong heading counts little
    measured = [HeadingMeasurement(k, 0.0 if k != 2 else 0.5, 1e-4) for k in range(5)]
    x = se2.parameters(optimize_headings(dead_reckoned(chain), chain, measured))
    assert np.abs(x[:, 2]).max() < 0.01
