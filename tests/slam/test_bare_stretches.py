"""Stretches whose length the scans do not show."""

import dataclasses

import numpy as np
import pytest

import stillmap
from stillmap.core import se2
from stillmap.sim import LaserOptions, RobotOptions, Scene, simulate
from stillmap.sim.walls import box
from stillmap.slam import BareStretch, LoopClosure
from stillmap.slam.bare_stretches import find_bare_stretches, unmeasured_variance, without_loops
from stillmap.slam.motion_model import gaussian_prior

NOT_MEASURED, MEASURED = 0.1**2, 0.001**2


def along_x(steps, metres=0.25):
    return se2.matrix(metres * np.arange(steps + 1), 0.0, 0.0)


def test_a_velocity_that_no_scan_corrects_hands_its_error_on():
    """Standard deviation of the sum of errors, against many simulated ways."""
    seconds, steps, std = 0.2, 400, 0.1
    prior, rng = gaussian_prior(np.eye(3), std, 0.05), np.random.default_rng(0)
    for left in (0.9, 0.5, 0.1):  # of the error, after the scan of the step
        error, total = np.zeros((2, 4000))
        for _ in range(steps):
            error = left * (np.exp(-seconds / 5.0) * error + rng.normal(scale=std, size=4000))
            total += error
        covariance = np.diag([1e-6, left * std**2, 1e-6])
        variance = unmeasured_variance(prior, covariance, seconds)
        assert np.sqrt(steps * variance) == pytest.approx(total.std(), rel=0.06)


def test_steps_of_odometry_are_independent():
    prior = gaussian_prior(np.eye(3), 0.1, 0.05, is_odometry=True)
    covariance = np.linalg.inv(prior.information)
    assert unmeasured_variance(prior, covariance, 0.2) == pytest.approx(0.1**2)
    assert unmeasured_variance(prior, 4.0 * covariance, 0.2) == pytest.approx(0.1**2)


def test_blind_steps_at_one_time_have_a_finite_variance():
    prior = gaussian_prior(np.eye(3), 0.1, 0.05)
    assert np.isfinite(unmeasured_variance(prior, np.linalg.inv(prior.information), 0.0))


def test_a_stretch_by_hand():
    variance = np.full(101, MEASURED)
    variance[20:60] = variance[65:80] = NOT_MEASURED  # a short gap
    variance[95:98] = NOT_MEASURED  # 0.17 m: little
    ((first, last, metres, std),) = find_bare_stretches(variance, along_x(100))
    assert (first, last) == (19, 79)
    assert metres == pytest.approx(0.25 * 60)
    assert std == pytest.approx(0.1 * np.sqrt(55))
    parts = find_bare_stretches(variance, along_x(100), breaks=[40])
    assert [(one.first, one.last) for one in parts] == [(19, 39), (39, 79)]
    assert find_bare_stretches(np.zeros(1), along_x(0)) == []


def test_a_loop_measures_what_it_spans():
    stretches = [BareStretch(10, 40, 8.0, 0.5), BareStretch(60, 90, 8.0, 0.5)]
    loop = LoopClosure(5, 50, np.eye(3), np.eye(3), 0.9)
    assert without_loops(stretches, [loop]) == stretches[1:]
    assert without_loops(stretches, [loop.reject("other loops disagree")]) == stretches
    assert without_loops(stretches, [dataclasses.replace(loop, later=30)]) == stretches


@pytest.mark.slow
def test_a_bare_corridor_is_named_where_odometry_is_missing():
    scene = Scene(
        "bare",
        walls=tuple(box(20, 0, 44, 3)),
        route=((0.0, 0.0), (36.0, 0.0)),
        laser=LaserOptions(beams=120, max_range=6.0),
        robot=RobotOptions(scans=240),
    )
    seen = simulate(scene, 0).recording
    with_odometry = stillmap.build(seen)
    assert with_odometry.doubts.bare_stretches == []
    blind = stillmap.build(dataclasses.replace(seen, T_odom_base=None))
    longest = max(blind.doubts.bare_stretches, key=lambda one: one.last - one.first)
    assert longest.last - longest.first > 60
    assert any("how far the robot went" in text for text in blind.warnings)
