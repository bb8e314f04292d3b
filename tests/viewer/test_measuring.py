"""Distances between points that were clicked."""

import numpy as np
import pytest

from stillmap.results.viewer.measuring import Ray


def test_measured_distances_are_shown_and_cleared(window):
    act, measuring = window._actions(), window._measuring
    act["Measure"]()
    window.step()
    assert measuring._text.content == r"Click on the first point\."
    eye = np.array([0.0, 0.0, 50.0])
    z = window._scene.ground - 0.15  # of the map, beside all points
    for goal in ([30.0, 40.0, z], [30.0, 43.0, z]):
        way = np.array(goal) - eye
        measuring.add(Ray(eye, way / np.linalg.norm(way)), 0.001)
    assert measuring.distances == pytest.approx([3.0])
    assert window._server.scene.get_handle_by_name("/measured_2/distance").text == "3.00 m"
    assert measuring._text.content.startswith(r"3\.00 m")
    # an object is not selected meanwhile
    window._click_object(7)
    window.step()
    assert not window._facts_folder.visible
    act["Clear"]()
    window.step()
    assert measuring.points == []
    assert window._server.scene.get_handle_by_name("/measured_2/distance") is None
    assert not measuring._text.visible


def test_click_beside_everything_measures_nothing(window):
    measuring = window._measuring
    window._actions()["Measure"]()
    up = Ray(np.array([0.0, 0.0, 50.0]), np.array([0.0, 0.0, 1.0]))
    window.step()
    measuring.add(up, 0.01)
    window.step()
    assert measuring.points == []
    assert "no point there" in measuring._text.content


def test_clicked_point_is_one_of_what_is_visible(window):
    cloud = window._layers.clouds["Static points"].points.astype(float)
    point = cloud[np.argmax(cloud[:, 2])]  # nothing is above it
    ray = Ray(point + np.array([0.0, 0.0, 9.0]), np.array([0.0, 0.0, -1.0]))
    window._boxes["Dynamic points"].value = False
    window.step()
    assert window._layers.pick(ray, 1e-4) == pytest.approx(point)
    window._boxes["Static points"].value = False
    window.step()
    depth = window._scene.ground - 0.15
    assert window._layers.pick(ray, 1e-4) == pytest.approx([*point[:2], depth])
    window._boxes["Map"].value = False
    window.step()
    assert window._layers.pick(ray, 1e-4) is None


def test_clicks_after_the_end_of_measuring_are_left_out(window):
    window._measuring.add(Ray(np.array([0.0, 0.0, 50.0]), np.array([0.0, 0.0, -1.0])), 0.01)
    assert window._measuring.points == []
    assert not window._measuring._text.visible
