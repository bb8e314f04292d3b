"""Odometry: exact without errors, and drifting as much as real logs do with them."""

import dataclasses

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.sim.episode import simulate_odometry
from stillmap.sim.options import OdometryOptions

PERFECT = OdometryOptions(0.0, 0.0, 0.4, 0.0, 0.0, 0.0)


def arcs() -> np.ndarray:
    """Poses along arcs, straight pieces and turns on the spot, in closed form per step."""
    steps = [(0.1, 0.0)] * 20 + [(0.1, 0.08)] * 30 + [(0.0, -0.1)] * 15 + [(0.08, -0.05)] * 40
    poses = [se2.matrix(3.0, -2.0, 0.7)]
    for d, turn in steps:
        radius = d / turn if turn else 0.0
        dx, dy = (radius * np.sin(turn), radius * (1 - np.cos(turn))) if turn else (d, 0.0)
        poses.append(poses[-1] @ se2.matrix(dx, dy, turn))
    return np.array(poses)


def test_perfect_wheels_give_the_true_motion() -> None:
    poses = arcs()
    odometry = simulate_odometry(poses, PERFECT, np.random.default_rng(0))
    np.testing.assert_allclose(odometry, se2.inverse(poses[:1]) @ poses, atol=1e-9)


@pytest.mark.parametrize("steps", [100, 1000])
def test_noise_does_not_depend_on_the_scan_rate(steps: int) -> None:
    poses = se2.matrix(np.linspace(0, 50, steps + 1), 0.0, 0.0)
    options = dataclasses.replace(PERFECT, drift_noise=0.01)
    rng = np.random.default_rng(8)
    headings = [se2.parameters(simulate_odometry(poses, options, rng))[-1, 2] for _ in range(400)]
    assert np.std(headings) == pytest.approx(0.01 * np.sqrt(50), rel=0.12)


def test_a_slipping_wheel_reads_too_far_on_short_pieces() -> None:
    poses = se2.matrix(np.arange(0, 200.01, 0.1), 0.0, 0.0)
    options = dataclasses.replace(PERFECT, slip_rate=0.1, slip=0.3, slip_length=0.5)
    odometry = simulate_odometry(poses, options, np.random.default_rng(5))
    x, y, turn = se2.parameters(se2.inverse(odometry[:-1]) @ odometry[1:]).T
    ahead = np.hypot(x, y)
    slips = np.abs(turn) > 1e-9
    # 20 slips of half a metre on 200 m, less what overlaps
    assert 0.5 * 0.05 < slips.mean() < 1.5 * 0.05
    np.testing.assert_allclose(ahead[~slips], 0.1, atol=1e-9)
    # one wheel 15 to 45 % too far, 0.4 m from the other; now and then both at once
    one = (np.abs(turn) > 0.149 * 0.1 / 0.4) & (np.abs(turn) < 0.451 * 0.1 / 0.4)
    assert one.sum() > 0.8 * slips.sum()
    np.testing.assert_allclose(ahead[one], 0.1 + np.abs(turn[one]) * 0.4 / 2, rtol=1e-3)
    assert (turn > 1e-9).any()
    assert (turn < -1e-9).any()
