"""The motion prior: where it is, how wide it is, and that it stays a pose."""

import dataclasses

import numpy as np
import pytest

from stillmap import se2
from stillmap.slam import motion
from stillmap.slam.motion import MotionOptions

OPTIONS = MotionOptions()
T0 = se2.matrix(3.0, -1.0, 2.0)


def test_odometry_moves_from_the_last_pose():
    increment = se2.matrix(0.4, 0.1, 0.2)
    prior = motion.from_odometry(T0, increment, OPTIONS)
    np.testing.assert_allclose(prior.T_map_base, T0 @ increment, atol=1e-14)


def test_a_constant_velocity_repeats_the_last_motion():
    step = se2.matrix(0.3, 0.0, 0.1)
    prior = motion.from_constant_velocity(T0 @ step, T0, OPTIONS)
    np.testing.assert_allclose(prior.T_map_base, T0 @ step @ step, atol=1e-14)
    assert prior.sigma_translation == OPTIONS.without_odometry_translation
    assert prior.sigma_rotation == OPTIONS.without_odometry_rotation


def test_widths_by_hand():
    # 0.5 m and 0.4 rad: 0.01 + 0.2 * 0.5 + 0.3 * 0.4 = 0.23 m, 0.02 + 0.1 * 0.5 + 0.5 * 0.4 rad
    options = MotionOptions(0.01, 0.2, 0.3, 0.02, 0.1, 0.5)
    prior = motion.from_odometry(T0, se2.matrix(0.3, 0.4, -0.4), options)
    assert prior.sigma_translation == pytest.approx(0.23)
    assert prior.sigma_rotation == pytest.approx(0.27)
    np.testing.assert_allclose(prior.information, np.diag([0.23**-2, 0.23**-2, 0.27**-2]))


def test_standing_still_is_the_surest():
    still = motion.from_odometry(T0, np.eye(3), OPTIONS)
    for increment in (se2.matrix(0.1, 0, 0), se2.matrix(0, 0, -0.1), se2.matrix(-0.1, 0, 0)):
        moving = motion.from_odometry(T0, increment, OPTIONS)
        assert moving.sigma_translation > still.sigma_translation > 0
        assert moving.sigma_rotation > still.sigma_rotation > 0


def test_widened_is_never_narrower():
    prior = motion.from_odometry(T0, se2.matrix(0.5, 0, 0), OPTIONS)
    wide = motion.widened(prior, 10 * prior.sigma_translation, 0.1 * prior.sigma_rotation)
    assert wide.sigma_translation == pytest.approx(10 * prior.sigma_translation)
    assert wide.sigma_rotation == prior.sigma_rotation
    np.testing.assert_allclose(wide.T_map_base, prior.T_map_base, atol=1e-15)
    np.testing.assert_allclose(np.diag(wide.information)[:2], wide.sigma_translation**-2)


def test_poses_stay_poses_however_long_the_chain():
    # R R'^T R multiplies what rounding leaves beside a rotation by 2.4 from scan to scan
    before, now = T0, T0 @ se2.matrix(0.1, 0.01, 0.3)
    by_odometry, step = T0, se2.matrix(0.1, 0.01, 0.3)
    for _ in range(300):
        before, now = now, motion.from_constant_velocity(now, before, OPTIONS).T_map_base
        by_odometry = motion.from_odometry(by_odometry, step, OPTIONS).T_map_base
    for T in (now, by_odometry):
        np.testing.assert_allclose(T[:2, :2] @ T[:2, :2].T, np.eye(2), atol=1e-12)
    # a circle of radius 0.1 / 0.3: the chain stays on it
    assert np.linalg.norm(now[:2, 2] - T0[:2, 2]) < 1.0


def test_every_width_can_be_chosen():
    names = [f.name for f in dataclasses.fields(MotionOptions)]
    assert len(names) == 8
    increment = se2.matrix(0.2, 0.1, 0.3)
    for name in names:
        more = dataclasses.replace(OPTIONS, **{name: 2 * getattr(OPTIONS, name)})
        if name.startswith("without"):
            a, b = (motion.from_constant_velocity(T0, T0, o) for o in (OPTIONS, more))
        else:
            a, b = (motion.from_odometry(T0, increment, o) for o in (OPTIONS, more))
        rotation = "rotation" in name
        assert (b.sigma_rotation > a.sigma_rotation) == rotation
        assert (b.sigma_translation > a.sigma_translation) != rotation
