"""The motion prior: mean, standard deviations, orthonormality."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.slam import motion_model
from stillmap.slam.motion_model import VelocityNoise
from stillmap.slam.options import OdometryOptions

OPTIONS = OdometryOptions()
T0 = se2.matrix(3.0, -1.0, 2.0)


def test_a_constant_velocity_repeats_the_last_motion():
    step = se2.matrix(0.3, 0.0, 0.1)
    prior = motion_model.constant_velocity_prior(T0 @ step, T0, VelocityNoise(0.2, 0.3))
    np.testing.assert_allclose(prior.T_map_base, T0 @ step @ step, atol=1e-14)
    assert prior.translation_std == 0.2
    assert prior.rotation_std == 0.3
    assert not prior.is_odometry


@pytest.mark.parametrize(
    ("seconds", "metres", "radians"),
    # 1/2 a t^2 of 2 m/s^2 and 4 rad/s^2: not below the floor of 0.02 m, not above 0.15
    [(0.01, 0.02, 0.02), (0.2, 0.04, 0.08), (1.0, 0.15, 0.15)],
)
def test_velocity_noise_floor(seconds, metres, radians):
    found = VelocityNoise()
    for _ in range(200):
        found = found.update(np.zeros(3), seconds)
    assert found.translation == pytest.approx(metres)
    assert found.rotation == pytest.approx(radians)


def test_leaps_are_implausible_steps():
    x = np.cumsum([0.0, *[0.3] * 30, 40.0, *[0.3] * 30])
    stamp_ns = 10**8 * np.arange(len(x))
    odometry = se2.matrix(x, 0 * x, 0 * x)
    steps = motion_model.compute_odometry_steps(odometry, stamp_ns)
    np.testing.assert_array_equal(np.flatnonzero(~steps.plausible), [30])
    np.testing.assert_allclose(steps.increments[:, 0, 2], np.diff(x))
    empty = motion_model.compute_odometry_steps(T0[None], stamp_ns[:1])
    assert empty.plausible.shape == (0,)
    # the robot drove on for 20 s in which no scan was recorded
    stamp_ns[31:] += 20 * 10**9
    assert motion_model.compute_odometry_steps(odometry, stamp_ns).plausible.all()


def test_mean_and_standard_deviations_by_hand():
    # 0.5 m and 0.4 rad: 0.02 + 0.2 * 0.5 + 0.3 * 0.4 = 0.24 m, 0.02 + 0.1 * 0.5 + 0.5 * 0.4 rad
    options = OdometryOptions(0.2, 0.3, 0.1, 0.5)
    increment = se2.matrix(0.3, 0.4, -0.4)
    prior = motion_model.odometry_prior(T0, increment, options)
    np.testing.assert_allclose(prior.T_map_base, T0 @ increment, atol=1e-14)
    assert prior.rotation_std == pytest.approx(0.27)
    # a heading that errs as a random walk leads aside: 0.5 m * 0.27 rad / sqrt(3)
    assert prior.translation_std == pytest.approx(np.hypot(0.24, 0.5 * 0.27 / np.sqrt(3.0)))
    covariance = np.linalg.inv(prior.information)
    way = prior.T_map_base[:2, 2] - T0[:2, 2]
    along, across = way / 0.5, np.array([-way[1], way[0]]) / 0.5
    assert along @ covariance[:2, :2] @ along == pytest.approx(0.24**2)
    assert across @ covariance[:2, :2] @ across == pytest.approx(prior.translation_std**2)
    np.testing.assert_allclose(covariance[:2, 2], 0.5 * 0.27**2 * 0.5 * across, atol=1e-12)
    assert covariance[2, 2] == pytest.approx(0.27**2)


def test_errors_of_many_metres_add_up_as_a_random_walk():
    # 9 m and 2.25 rad: 0.02 + 0.2 * 3 + 0.3 * 1.5 m, 0.02 + 0.1 * 3 + 0.5 * 1.5 rad
    std = motion_model.odometry_std(9.0, 2.25, OdometryOptions(0.2, 0.3, 0.1, 0.5))
    assert std == pytest.approx((1.07, 1.07))


def test_long_chains_stay_orthonormal():
    # R R'^T R multiplies what rounding leaves beside a rotation by 2.4 from scan to scan
    before, now = T0, T0 @ se2.matrix(0.1, 0.01, 0.3)
    by_odometry, step = T0, se2.matrix(0.1, 0.01, 0.3)
    unsure = VelocityNoise()
    for _ in range(300):
        before, now = now, motion_model.constant_velocity_prior(now, before, unsure).T_map_base
        by_odometry = motion_model.odometry_prior(by_odometry, step, OPTIONS).T_map_base
    for T in (now, by_odometry):
        np.testing.assert_allclose(T[:2, :2] @ T[:2, :2].T, np.eye(2), atol=1e-12)
    # a circle of radius 0.1 / 0.3: the chain stays on it
    assert np.linalg.norm(now[:2, 2] - T0[:2, 2]) < 1.0
