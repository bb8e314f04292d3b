"""The viewer's layers and controls."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from stillmap.results.colors import BLUE, ORANGE, TEAL
from stillmap.results.viewer.scene import Scene

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from stillmap.results.viewer.window import ACTION_KEYS, LAYER_KEYS, legend_html


def node(window, path):
    """A node of viser."""
    return window._server.scene.get_handle_by_name(path)


def test_show_scan(result_of, beams_of, opened):
    out = result_of(3, with_models=True)
    scene, beams = Scene(out), beams_of(out)
    window = opened(scene, beams)
    for scan in (2, 5, 0):
        window.show(scan)
        assert window._slider.value == scan
        assert window._clock.value == f"{0.5 * scan:.1f} of 2.5 s"
        ends, shown = beams.scan_view(scan)[0] - scene.origin, node(window, "/beams/points")
        assert shown.points == pytest.approx(ends, abs=1e-5)
        assert shown.colors.shape == ends.shape
        assert node(window, "/robot/robot").position + scene.origin == pytest.approx(
            scene.poses[scan, :3, 3]
        )
        there = 1 <= scan <= 3
        assert node(window, "/object_models/0007").visible is there
        assert node(window, "/objects/sides").visible is there
        assert len(node(window, "/objects/lines").points) == (12 if there else 0)


def test_default_layers_with_a_surface(window):
    shown = {name for name, box in window._boxes.items() if box.value}
    assert shown == {
        *("Map", "Static points", "Dynamic points", "Robot", "Beams", "Objects", "Object models")
    }
    for name in window._boxes:
        path = "/" + name.lower().replace(" ", "_")
        assert node(window, path).visible is window._layers.is_shown(name) is (name in shown)


def test_default_layers_in_2d(result_of, beams_of, opened):
    """Dynamic points come from the recording, above the map."""
    out = result_of(2)
    scene, beams = Scene(out), beams_of(out)
    flat = opened(scene, beams)
    shown = {name for name, box in flat._boxes.items() if box.value}
    assert shown == {"Map", "Dynamic points", "Robot", "Beams", "Objects"}
    points = node(flat, "/dynamic_points/points")
    views = [beams.scan_view(scan) for scan in range(beams.recording.n_scans)]
    ends = np.concatenate([ends[p_static < 0.5] for ends, p_static, _ in views])
    assert points.points[:, :2] == pytest.approx((ends - scene.origin)[:, :2], abs=1e-5)
    assert (points.points[:, 2] > 0.0).all()
    assert (points.colors == ORANGE).all()


def test_points_are_colored_by_label_or_height(window):
    static, dynamic = (node(window, f"/{name}_points/points") for name in ("static", "dynamic"))
    assert window._coloring.options == ("label", "height")
    assert np.ptp(static.colors.astype(int), axis=1).max() < 15  # shades of grey
    assert (dynamic.colors == ORANGE).all()
    labels = static.colors.copy()
    window._coloring.value = "height"
    window.step()
    order = np.argsort(static.points[:, 2])
    assert np.ptp(static.colors.astype(int), axis=1).max() > 50
    assert (np.diff(static.colors[order, 1].astype(int)) >= 0).all()
    assert (dynamic.colors == ORANGE).all()
    window._coloring.value = "label"
    window.step()
    assert (static.colors == labels).all()


def test_check_boxes_show_and_hide(window):
    window.show(2)
    window._boxes["Surface"].value = True
    window._boxes["Object ids"].value = True
    window.step()
    assert node(window, "/surface").visible
    assert node(window, "/object_ids/0").text == "7"
    window._boxes["Surface"].value = False
    window.step()
    assert not node(window, "/surface").visible


def test_playback_starts_again_at_the_end(window):
    window._speed.value = "10 x"
    window.play(True)
    assert window._button.label == "Pause"
    seen = [window.scan]
    while 0 not in seen[1:] and len(seen) < 100:
        window.step()
        if window.scan != seen[-1]:
            seen.append(window.scan)
    assert seen[-1] == 0
    assert len(seen) > 2
    assert seen[1:-1] == sorted(seen[1:-1])
    window.play(False)
    window.step()
    window.step()
    assert window.scan == 0


def test_actions_of_keys_step_and_pause(window):
    act, last = window._actions(), len(window._scene.stamp_ns) - 1

    def after(name):
        act[name]()
        window.step()
        return window.scan

    assert [after("Next scan"), after("Next scan"), after("Previous scan")] == [1, 2, 1]
    assert [after("Last scan"), after("Next scan"), after("First scan")] == [last, last, 0]
    assert after("Previous scan") == 0
    act["Next scan"]()  # two before one is shown
    assert after("Next scan") == 2
    after("Play or pause")
    assert window._playing
    after("Next scan")
    assert not window._playing


def test_keys_are_distinct_and_not_those_of_the_camera(window):
    keys = [*LAYER_KEYS.values(), *ACTION_KEYS.values()]
    assert len(set(keys)) == len(keys)
    assert not set(keys) & {*"WASDQE", "arrowup", "arrowdown"}
    assert {*window._boxes, "Play or pause", "Measure"} <= set(window._actions())


def test_selected_object_shows_its_facts(window):
    window.show(2)
    window._objects._click_box(SimpleNamespace(instance_index=1))  # of a box that is gone
    window.step()
    assert not window._facts_folder.visible
    window._objects._click_box(SimpleNamespace(instance_index=0))
    window.step()
    assert window._facts_folder.visible
    assert window._facts_folder.label == "Object 7"
    for fact in ("0.5 s to 1.5 s", "0.80 x 0.40 x 1.80 m", "1,234", "0.988", "1.0 m/s"):
        assert fact in window._facts.content
    assert node(window, "/selected_object/lines").visible
    window.show(0)
    assert "not seen" in window._facts.content
    assert not node(window, "/selected_object/lines").visible
    window._actions()["Clear"]()
    window.step()
    assert not window._facts_folder.visible


def test_legend_names_the_layers_there_are(window):
    text = legend_html(window._layers)
    assert type(text) is str  # viser sends no other texts, and then nothing more
    colors = {tuple(map(int, one)) for one in re.findall(r"rgb\((\d+), (\d+), (\d+)\)", text)}
    assert {TEAL, ORANGE, BLUE} <= colors
    assert "rays from the sensor" in text
    assert "by height z" in text
    assert "trajectories of the sessions" not in text
    window._actions()["Legend"]()
    assert not window._panel.visible
