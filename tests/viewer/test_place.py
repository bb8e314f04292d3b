"""A place in the viewer: a slider over its sessions."""

from pathlib import Path

import numpy as np
import pytest
from small_place import CHAIR, NAMES, make_place

from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.results.colors import KIND_COLORS
from stillmap.results.viewer.scene import Scene

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

PLACE_LAYERS = ["Sessions", "Changes", "Change labels"]


@pytest.fixture
def place(tmp_path):
    return make_place(tmp_path / "place")


@pytest.fixture
def window(place, opened):
    return opened(Scene(place), None)


def node(window, path):
    """A node of viser."""
    return window._server.scene.get_handle_by_name(path)


def chair_color(window):
    """Of the map where the chair is from the second session on."""
    scene, (column, row) = window._scene, CHAIR
    x0, _, x1, y1 = scene.map_image.window
    picture = node(window, "/map/plan").image
    scale = picture.shape[1] / (x1 - x0)
    x, y = -4.0 + 0.1 * (column + 0.5), -3.0 + 0.1 * (row + 0.5)
    return tuple(picture[int((y1 - y) * scale), int((x - x0) * scale), :3].tolist())


def test_last_session_is_shown_at_first(window):
    assert window._sessions.session == 3
    assert "session 4 of 4" in window._sessions._title.content
    assert window._clock.value == "0.0 of 4.0 s"
    assert list(window._boxes)[-3:] == PLACE_LAYERS
    assert [window._boxes[name].value for name in PLACE_LAYERS] == [True, True, False]


def test_slider_shows_map_scans_and_changes_of_a_session(window):
    window._sessions._slider.value = 2
    window.step()
    assert window._sessions.session == 1
    title = window._sessions._title.content.replace("\\", "")
    assert title == "**session 2 of 4: tuesday, 2026-05-29**"
    assert "A0" in window._sessions._table.content
    assert chair_color(window) == KIND_COLORS["appeared"]
    assert node(window, "/robot/robot").position == pytest.approx([-2.0, 0.2, 0.0])
    path = node(window, "/robot/lines").points
    assert (path[..., 1] == np.float32(0.2)).all()
    window.show(4)
    assert node(window, "/robot/robot").position == pytest.approx([2.0, 0.2, 0.0])


def test_map_and_boxes_are_those_of_the_session(window):
    shown, seen = {}, []
    for session in range(4):
        window.show_session(session)
        seen.append(chair_color(window))
        shown[session] = [k for k in KIND_COLORS if node(window, f"/changes/{k}").visible]
    assert shown == {0: [], 1: ["appeared"], 2: ["moved", "door"], 3: ["gone"]}
    assert seen == [(255, 255, 255), KIND_COLORS["appeared"], (0, 0, 0), (0, 0, 0)]
    window.show_session(2)
    moved = node(window, "/changes/moved").points
    # the four sides of both boxes, the arrow and its head
    assert len(moved) == 4 + 4 + 3
    assert moved[..., 0].min() == pytest.approx(1.95, abs=1e-3)
    assert moved[..., 0].max() == pytest.approx(3.05, abs=1e-3)
    window.show_session(3)
    assert len(node(window, "/changes/gone").points) == 4


def test_objects_are_those_of_the_session(window):
    for session in (1, 0):
        window.show_session(session)
        window.show(2)
        assert window._objects._drawn == [session]


def test_objects_of_another_session_at_the_same_time_are_not_shown(tmp_path, opened):
    """Clocks of robots, or of simulations, may agree."""
    window = opened(Scene(make_place(tmp_path / "place", step=0)), None)
    objects = [track.session for track in window._scene.tracks]
    assert objects == [*NAMES[:2]]
    for session in (0, 1):
        window.show_session(session)
        node_count = []
        for scan in range(5):
            window.show(scan)
            node_count += window._objects._drawn
        assert {*node_count} <= {session}


def test_keys_step_through_sessions(window):
    act = window._actions()

    def after(name):
        act[name]()
        window.step()
        return window._sessions.session

    assert [after("Previous session") for _ in range(4)] == [2, 1, 0, 0]
    assert [after("Next session") for _ in range(4)] == [1, 2, 3, 3]


@pytest.mark.parametrize("name", ["changes.json", "states.npz", "trajectory.tum"])
def test_damaged_place_is_refused(place, name):
    (place / name).write_bytes(b"{")
    with pytest.raises(InputError, match=Path(name).name):
        Scene(place)


def test_command_takes_no_recording_for_a_place(place, capsys):
    assert main(["view", str(place), "--input", "a.bag"]) == 2
    assert "is a place" in capsys.readouterr().err
