"""Which point of the scene a click means."""

import numpy as np
import pytest

from stillmap.results.viewer.measuring import Ray, pick_plane, pick_point

EYE = np.array([1.0, 2.0, 3.0])
AHEAD = Ray(EYE, np.array([1.0, 0.0, 0.0]))


def test_nearest_surface_is_met_and_on_it_the_point_closest_to_the_ray():
    wall = EYE + np.array([[5.0, 0.04, 0.0], [5.01, 0.01, 0.0], [5.0, 0.0, 0.2]])
    behind = EYE + np.array([[9.0, 0.0, 0.0]])
    assert pick_point(AHEAD, [behind, wall], 0.01) == pytest.approx(wall[1])
    assert pick_point(AHEAD, [behind], 0.01) == pytest.approx(behind[0])


def test_nothing_is_met_beside_the_ray_or_behind_the_camera():
    beside = EYE + np.array([[5.0, 0.06, 0.0], [-5.0, 0.0, 0.0]])
    assert pick_point(AHEAD, [beside], 0.01) is None
    assert pick_point(AHEAD, [], 0.01) is None
    assert pick_point(AHEAD, [np.zeros((0, 3), np.float32)], 0.01) is None


def test_plane():
    down = Ray(EYE, np.array([0.6, 0.0, -0.8]))
    assert pick_plane(down, -1.0) == pytest.approx([4.0, 2.0, -1.0])
    assert pick_plane(down, 3.5) is None  # above the camera
    assert pick_plane(AHEAD, 0.0) is None
