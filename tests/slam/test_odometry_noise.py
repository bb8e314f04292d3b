"""Noise of odometry learned from the recording."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.slam.motion_model import (
    OdometryNoise,
    blind_drift,
    fit_odometry_noise,
    odometry_prior,
    odometry_std,
)
from stillmap.slam.options import OdometryOptions

OPTIONS = OdometryOptions()
STEP = se2.matrix(0.1, 0.0, 0.02)


def posterior(prior, measured, std):
    """Pose and covariance after a scan that says x, y, heading `measured` with deviations `std`."""
    information = np.diag(np.square(std) ** -1.0)
    C = np.linalg.inv(prior.information + information)
    x = se2.parameters(prior.T_map_base)
    x = x + C @ information @ (measured - x)
    return se2.matrix(*x), C


def learn(true_share, scan_std, steps=600):
    """The noise learned from steps whose noise is this share of the options'."""
    rng, noise = np.random.default_rng(0), OdometryNoise()
    std = np.array([odometry_std(0.1, 0.02, OPTIONS)[k] for k in (0, 0, 1)])
    for _ in range(steps):
        prior = odometry_prior(np.eye(3), STEP, OPTIONS, noise)
        truth = se2.parameters(prior.T_map_base) + true_share * std * rng.standard_normal(3)
        measured = truth + 0.2 * scan_std * rng.standard_normal(3)
        noise = noise.update(prior, *posterior(prior, measured, scan_std))
    return noise


@pytest.mark.parametrize("share", [0.2, 0.4, 0.8])
def test_it_converges_to_the_noise_of_the_wheels(share):
    noise = learn(share, np.full(3, 0.003))
    assert noise.translation == pytest.approx(share, rel=0.35)
    assert noise.rotation == pytest.approx(share, rel=0.35)


def test_it_stays_within_bounds_and_scans_that_say_nothing_teach_nothing():
    assert learn(5.0, np.full(3, 0.003)).translation == 1.0
    best = learn(0.0, np.full(3, 0.0005))
    assert best.translation == best.rotation == 0.1
    noise = learn(0.3, np.array([1e3, 1e3, 0.003]))
    assert noise.translation == pytest.approx(1.0, abs=1e-3)
    assert noise.rotation < 0.5


def test_one_fault_does_not_undo_what_was_learned():
    noise = OdometryNoise(0.2, 0.2)
    prior = odometry_prior(np.eye(3), STEP, OPTIONS, noise)
    after = noise.update(prior, *posterior(prior, np.array([9.0, 5.0, 1.0]), np.full(3, 0.003)))
    assert 0.2 < after.translation < 0.4
    assert 0.2 < after.rotation < 0.4


def test_a_robust_fit_over_a_whole_recording():
    rng = np.random.default_rng(1)
    std = np.array([odometry_std(0.1, 0.02, OPTIONS)[k] for k in (0, 0, 1)])
    errors = 0.3 * std * rng.standard_normal((400, 3))
    errors[50:60] += 1.0
    measured = np.tile(STEP, (400, 1, 1))
    noise, is_fault = fit_odometry_noise(measured, measured @ se2.matrix(*errors.T), OPTIONS)
    assert noise.translation == pytest.approx(0.3, rel=0.15)
    assert noise.rotation == pytest.approx(0.3, rel=0.15)
    np.testing.assert_array_equal(np.flatnonzero(is_fault), np.arange(50, 60))
    # of one scan there is nothing to fit
    noise, is_fault = fit_odometry_noise(measured[:0], measured[:0], OPTIONS)
    assert noise == OdometryNoise()
    assert len(is_fault) == 0


def test_blind_steps_drift_as_odometry_does_and_others_do_not():
    prior = odometry_prior(np.eye(3), STEP, OPTIONS)
    of_prior = np.linalg.inv(prior.information)
    blind = blind_drift(prior, of_prior)
    # the prior's information is discounted by 2.2 squared
    np.testing.assert_allclose(blind, of_prior / 2.2**2)
    _, C = posterior(prior, se2.parameters(prior.T_map_base), np.array([1e3, 0.001, 0.001]))
    along_a_wall = blind_drift(prior, C)
    assert along_a_wall[0, 0] == pytest.approx(blind[0, 0], rel=1e-3)
    assert along_a_wall[1, 1] < 0.01 * blind[1, 1]
    assert along_a_wall[2, 2] < 0.01 * blind[2, 2]
