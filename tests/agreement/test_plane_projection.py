"""Scans projected to the plane: kernel against NumPy."""

import numpy as np
import pytest
from reference import plane_projection

from stillmap import _core
from stillmap.core import se3
from stillmap.em import GroundMap

LOW, HIGH, TOP = 0.2, 1.8, 2.1


def ground(rng):
    return GroundMap(rng.normal(0.0, 0.05, (30, 40)), np.array([-20.0, -15.0]), 1.6, True)


def kernel_settings(ground, cell, directions, open_space):
    x, y = ground.corner.tolist()
    return {
        "height": ground.height, "corner_x": x, "corner_y": y, "edge": 1.0, "low": LOW,
        "high": HIGH, "top": TOP, "cell": cell, "directions": directions, "open_space": open_space,
    }  # fmt: skip


def scan(rng, n):
    """Beams to what lies around, some beyond the map of the ground, some not usable."""
    points = (rng.normal(size=(n, 3)) * [14.0, 14.0, 1.5]).astype(np.float32)
    points[rng.random(n) < 0.02] = np.nan
    T = se3.exp(np.array([0.4, -0.3, 1.7, 0.02, -0.03, 2.0]))
    return points, rng.random(n) < 0.8, T


@pytest.mark.parametrize("open_space", [False, True])
@pytest.mark.parametrize("directions", [1, 64, 2048])
def test_agrees_with_numpy(directions, open_space):
    rng = np.random.default_rng(directions)
    place, (points, hit, T) = ground(rng), scan(rng, 4000)
    expected = plane_projection.project_scan(
        points, hit, T, place, (LOW, HIGH, TOP), 0.3, directions, open_space
    )
    settings = kernel_settings(place, 0.3, directions, open_space)
    xy, is_hit, beam = _core.project_scan(points, hit, T, **settings)
    np.testing.assert_array_equal(beam, expected[2])
    np.testing.assert_array_equal(is_hit, expected[1])
    np.testing.assert_allclose(xy, expected[0], atol=1e-12)
    assert is_hit.any()
    assert not is_hit.all()


def test_of_equals_the_first_is_kept():
    flat = GroundMap(np.zeros((2, 2)), np.zeros(2), 1.6, True)
    T = np.eye(4)
    T[:3, 3] = 1.0, 1.0, 1.5
    points = np.float32([[4, 0, -1.5], [4, 0, -1.5], [3.01, 0, -0.5], [3.02, 0, -0.5]])
    settings = kernel_settings(flat, 0.1, 2048, False)
    _, is_hit, beam = _core.project_scan(points, np.ones(4, bool), T, **settings)
    assert beam.tolist() == [0, 2]
    assert is_hit.tolist() == [0, 1]
