"""People who are pasted into recorded rooms."""

import numpy as np
import pytest
from pasted import _HALF, _seen

from stillmap.core.camera import Camera
from stillmap.io.rgbd import T_BASE_CAMERA

K = np.array([[100.0, 0.0, 31.5], [0.0, 100.0, 23.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("color", 64, 48, K, "", np.zeros(0), T_BASE_CAMERA)
# the base is 1 m up, turned to the left; what is ahead of it lies along y
T = np.array([[0.0, -1, 0, 3], [1, 0, 0, 1], [0, 0, 1, 1], [0, 0, 0, 1]])
NOTHING = np.empty((0, 3), np.float32)


def test_a_person_ahead_is_as_far_away_as_his_surface():
    z, colours, its = _seen(CAMERA, T, np.array([3.0, 3.0, 1.0]), NOTHING)
    assert z[23:25, 31:33] == pytest.approx(2.0 - _HALF[1], abs=1e-3)
    # as wide as a circle is seen: half of it by asin(r / d)
    wide = 100.0 * np.tan(np.arcsin(_HALF[0] / 2.0))
    assert its[24].sum() == pytest.approx(2.0 * wide, abs=1.5)
    assert its[:, 31].all()
    assert len(np.unique(colours[its], axis=0)) == 2
    assert np.isinf(z[~its]).all()


def test_what_is_nearer_hides_him():
    left = np.array([[1.0, 0.01 * k, 0.02 * j] for k in range(1, 40) for j in range(-15, 16)])
    points = np.concatenate([left, left + np.array([0.0, 0.005, 0.01])]).astype(np.float32)
    _, _, its = _seen(CAMERA, T, np.array([3.0, 3.0, 1.0]), points)
    assert not its[24, :31].any()
    assert its[24, 33:40].all()
    # behind him, nothing is hidden
    _, _, its = _seen(CAMERA, T, np.array([3.0, 3.0, 1.0]), points * np.float32(3.0))
    assert its[24, 24:40].all()


@pytest.mark.parametrize("centre", [None, np.array([3.0, -2.0, 1.0])])
def test_nobody_is_seen_who_is_not_there_or_behind(centre):
    z, _, its = _seen(CAMERA, T, centre, NOTHING)
    assert not its.any()
    assert np.isinf(z).all()
