"""Covariance of ambiguous loop closures."""

import functools

import numpy as np
import pytest
from driven import driven

from stillmap.core import se2
from stillmap.sim.options import LaserOptions
from stillmap.sim.walls import box
from stillmap.slam.loop_verification import _ambiguity_covariance, build_submap, verify_candidate
from stillmap.slam.types import LoopCandidate


@functools.cache
def corridor(*landmarks):
    """A corridor with a doorway every 2 m along one wall, and true poses along it."""
    piers = [wall for x in range(1, 40, 2) for wall in box(x, 1.2, 0.9, 0.3)]
    walls = (*box(19, 0, 44, 2.6), *piers, *landmarks)
    laser = LaserOptions(beams=120, max_range=5.0)
    return driven(walls, ((0, -0.2), (25, -0.2)), laser, speed=0.5)


def closed(context, sigma):
    """Standard deviations of a closure halfway, and by how much it misses the truth along x."""
    earlier = int(np.searchsorted(context.travelled, 13.0))
    later = earlier + 3
    T = se2.inverse(context.poses[earlier]) @ context.poses[later]
    grid = build_submap(context, float(context.travelled[earlier]))
    closure = verify_candidate(context, grid, LoopCandidate(earlier, later, T, 0.0), sigma, 0.05)
    assert closure.rejected == ""
    off = se2.parameters(se2.inverse(T) @ closure.T)
    return np.sqrt(np.diag(closure.covariance)), float(off[0])


@pytest.mark.parametrize("sigma", [1.0, 1.5, 3.0])
def test_ambiguity_widens_the_covariance(sigma):
    wide, off = closed(corridor(), sigma)
    assert wide[0] > 0.8  # the next door is 2 m away
    assert abs(off) < 2.0 * wide[0]
    assert wide[1] < 0.04
    assert wide[2] < 0.01


def test_no_ambiguity_in_a_narrow_window():
    wide, off = closed(corridor(), 0.3)
    assert wide[0] < 0.1
    assert abs(off) < 0.02


def test_unique_landmark_resolves_ambiguity():
    wide, off = closed(corridor(*box(15.3, -1.1, 0.5, 0.5)), 3.0)
    assert wide[0] < 0.1
    assert abs(off) < 0.02


def test_ambiguity_covariance_by_hand():
    # 2 m ahead, ln 3 nats worse: a quarter of the probability, 0.25 * 2^2 of the variance
    rivals = np.array([[0.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, np.log(3.0)]])
    np.testing.assert_allclose(_ambiguity_covariance(rivals), np.diag([1.0, 0.0, 0.0]))
    # as good as the best: half; a hopeless one: nothing
    rivals = np.array([[0, 0, 0, 0], [0.0, 2.0, 0.2, 0.0], [9.0, 9.0, 3.0, 500.0]])
    d = np.array([0.0, 2.0, 0.2])
    np.testing.assert_allclose(_ambiguity_covariance(rivals), 0.5 * np.outer(d, d), atol=1e-12)
    np.testing.assert_array_equal(_ambiguity_covariance(np.zeros((1, 4))), np.zeros((3, 3)))
