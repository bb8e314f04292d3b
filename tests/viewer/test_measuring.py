"""Which point a click means, and distances between such points."""

import numpy as np
import pytest

from stillmap.results.viewer.measuring import Ray, pick_plane, pick_point

EYE = np.array([1.0, 2.0, 3.0])
AHEAD = Ray(EYE, np.array([1.0, 0.0, 0.0]))
DOWN = np.array([0.0, 0.0, -1.0])


def test_nearest_surface_is_met_and_on_it_the_point_closest_to_the_ray():
    wall = EYE + np.array([[5.0, 0.04, 0.0], [5.01, 0.01, 0.0], [5.0, 0.0, 0.2]])
    behind = EYE + np.array([[9.0, 0.0, 0.0]])
    assert pick_point(AHEAD, [behind, wall], 0.01) == pytest.approx(wall[1])
    assert pick_point(AHEAD, [behind], 0.01) == pytest.approx(behind[0])
    beside = EYE + np.array([[5.0, 0.06, 0.0], [-5.0, 0.0, 0.0]])
    for clouds in ([beside], [], [np.zeros((0, 3), np.float32)]):
        assert pick_point(AHEAD, clouds, 0.01) is None


def test_plane():
    down = Ray(EYE, np.array([0.6, 0.0, -0.8]))
    assert pick_plane(down, -1.0) == pytest.approx([4.0, 2.0, -1.0])
    assert pick_plane(down, 3.5) is None  # above the camera
    assert pick_plane(AHEAD, 0.0) is None


def test_measured_distances_are_shown_and_cleared(window):
    act, measuring = window._actions(), window._measuring
    eye = np.array([0.0, 0.0, 50.0])
    measuring.add(Ray(eye, DOWN), 0.01)  # it has not begun
    assert measuring.points == []
    act["Measure"]()
    assert measuring._text.content == r"Click on the first point\."
    measuring.add(Ray(eye, -DOWN), 0.01)
    assert measuring.points == []
    assert "no point there" in measuring._text.content
    z = window._scene.ground - 0.15  # of the map, beside all points
    for goal in ([30.0, 40.0, z], [30.0, 43.0, z]):
        way = np.array(goal) - eye
        measuring.add(Ray(eye, way / np.linalg.norm(way)), 0.001)
    assert measuring.distances == pytest.approx([3.0])
    assert window._server.scene.get_handle_by_name("/measured_2/distance").text == "3.00 m"
    assert measuring._text.content.startswith(r"3\.00 m")
    # an object is not selected meanwhile
    window._objects._on_click(7)
    window.step()
    assert not window._facts_folder.visible
    act["Clear"]()
    assert measuring.points == []
    assert window._server.scene.get_handle_by_name("/measured_2/distance") is None
    assert not measuring._text.visible


def test_clicked_point_is_one_of_what_is_visible(window):
    cloud = window._layers.clouds["Static points"].points.astype(float)
    point = cloud[np.argmax(cloud[:, 2])]  # nothing is above it
    ray = Ray(point + np.array([0.0, 0.0, 9.0]), DOWN)

    def met_without(name):
        window._boxes[name].value = False
        window.step()
        return window._layers.pick(ray, 1e-4)

    assert met_without("Dynamic points") == pytest.approx(point)
    depth = window._scene.ground - 0.15
    assert met_without("Static points") == pytest.approx([*point[:2], depth])
    assert met_without("Map") is None
