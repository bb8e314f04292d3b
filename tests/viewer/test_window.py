"""The viewer's layers and controls."""

from types import SimpleNamespace

import numpy as np
import pytest

from stillmap.results.colors import ORANGE
from stillmap.results.points import COLOURS, FIELDS, ply_header, put_colours
from stillmap.viewer import scene as scenes
from stillmap.viewer import shortcuts
from stillmap.viewer.scene import read_scene

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from stillmap.viewer.text import escape_markdown


def node(window, path):
    """A node of viser."""
    return window._server.scene.get_handle_by_name(path)


def test_layers_without_data_are_left_out(result_of, opened, window):
    flat = opened(read_scene(result_of(2)), None)
    objects = ["Objects", "Object tracks", "Object ids"]
    assert list(flat._boxes) == ["Map", "Robot", *objects]
    clouds = ["Static points", "Dynamic points"]
    assert list(window._boxes) == [
        *("Map", "Surface", *clouds, "Robot", "Beams", "Rays"),
        *("Objects", "Object tracks", "Object models", "Object ids"),
    ]


def test_show_scan(result_of, beams_of, opened):
    out = result_of(3, with_models=True)
    scene, beams = read_scene(out), beams_of(out)
    window = opened(scene, beams)
    for scan in (2, 5, 0):
        window.show(scan)
        assert window._slider.value == scan
        assert window._clock.value == f"{0.5 * scan:.1f} of 2.5 s"
        view, ends = beams.scan_view(scan), node(window, "/beams/points")
        assert ends.points == pytest.approx(view.ends, abs=1e-5)
        assert ends.colors.shape == view.ends.shape
        assert node(window, "/robot/robot").position == pytest.approx(scene.poses[scan, :3, 3])
        there = 1 <= scan <= 3
        assert node(window, "/object_models/0007").visible is there
        assert node(window, "/objects/sides").visible is there
        assert len(node(window, "/objects/lines").points) == (12 if there else 0)


def test_slider(window):
    window._slider.value = 4
    window.step()
    assert window.scan == 4


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
    flat, beams = opened(read_scene(out), beams_of(out)), beams_of(out)
    shown = {name for name, box in flat._boxes.items() if box.value}
    assert shown == {"Map", "Dynamic points", "Robot", "Beams", "Objects"}
    points = node(flat, "/dynamic_points/points")
    views = [beams.scan_view(scan) for scan in range(beams.recording.n_scans)]
    ends = np.concatenate([view.ends[view.p_static < 0.5] for view in views])
    assert points.points[:, :2] == pytest.approx(ends[:, :2], abs=1e-5)
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


def test_points_are_colored_by_pictures(result_of, opened):
    out, (grey, red) = result_of(3), ((128, 128, 128), (200, 0, 0))
    for part in ("static", "dynamic"):
        rows = np.zeros(2, FIELDS + COLOURS)
        put_colours(rows, np.array([grey, red], np.uint8))
        (out / f"{part}.ply").write_bytes(ply_header(FIELDS + COLOURS, 2) + rows.tobytes())
    window = opened(read_scene(out), None)
    assert window._coloring.options == ("label", "height", "pictures")
    window._coloring.value = "pictures"
    window.step()
    assert node(window, "/static_points/points").colors.tolist() == [[*grey], [*red]]
    # grey is what no picture shows
    assert node(window, "/dynamic_points/points").colors.tolist() == [[*ORANGE], [*red]]


def test_map_lies_below_the_surface(result_of, opened, window):
    def height(of):
        return float(node(of, "/map/plan").position[2]) + of._scene.origin[2]

    assert -0.3 < height(window) - window._scene.ground < -0.05
    flat = opened(read_scene(result_of(2)), None)
    assert height(flat) == flat._scene.ground


def test_notes_are_shown_with_their_layers(result_of, beams_of, opened, monkeypatch):
    monkeypatch.setitem(scenes.MAX_POINTS, "static", 11)
    out = result_of(3, with_models=True)
    window = opened(read_scene(out), beams_of(out))

    def told():
        return [note.content for note in window._notes.values() if note.visible]

    (text,) = told()
    assert text.startswith("11 of ")
    window._boxes["Static points"].value = False
    window.step()
    assert told() == []


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


def test_point_size(window):
    ends = node(window, "/beams/points")
    before = ends.point_size
    window._size.value = 2.0
    window.step()
    assert ends.point_size == pytest.approx(2 * before)


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


def test_result_of_one_scan(result_of, opened):
    from dataclasses import replace

    scene = read_scene(result_of(2))
    one = opened(replace(scene, stamp_ns=scene.stamp_ns[:1], poses=scene.poses[:1]), None)
    one.play(True)
    one.step()
    assert one.scan == 0


def test_markdown_is_escaped():
    assert escape_markdown("a_b <img src=x>") == r"a\_b \<img src=x\>"


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


def test_actions_of_keys_show_and_hide_every_layer(window):
    act = window._actions()
    for name, box in window._boxes.items():
        before = box.value
        act[name]()
        window.step()
        assert box.value is window._layers.is_shown(name) is not before


def test_keys_are_distinct_and_not_those_of_the_camera(window):
    keys = [*shortcuts.LAYER_KEYS.values(), *shortcuts._ACTION_KEYS.values()]
    assert len(set(keys)) == len(keys)
    assert not set(keys) & {*"WASDQE", "arrowup", "arrowdown"}
    names = {*shortcuts.LAYER_KEYS, *shortcuts._ACTION_KEYS}
    assert set(window._actions()) == names


def test_click_on_a_box_that_is_gone_selects_nothing(window):
    window.show(2)
    window._objects._click_box(SimpleNamespace(instance_index=1))
    window.step()
    assert window._objects.selected is None
    window._objects._click_box(SimpleNamespace(instance_index=0))
    window.step()
    assert window._objects.selected == 7


def test_selected_object_shows_its_facts(window):
    window.show(2)
    window._click_object(7)
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
