"""The viewer's page, its layers and controls."""

import gzip
import socket
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.trajectory import poses_from_tum
from stillmap.slam import SlamOptions
from stillmap.viewer import scene as scenes
from stillmap.viewer.scene import read_scene
from stillmap.viewer.tracks import Beams

viser = pytest.importorskip("viser", reason="the extra `viewer` is not installed")
sockets = pytest.importorskip("websockets.sync.client")

from stillmap.viewer import server as module  # noqa: E402
from stillmap.viewer.window import Window, _escape_markdown  # noqa: E402


def beams_of(out):
    recording = read(out.parent / out.name.replace("out", "log"))
    poses = poses_from_tum(out / "trajectory.tum", recording)
    return Beams(recording, np.load(out / "beams/p_static.npy"), poses, SlamOptions())


@pytest.fixture
def opened():
    windows = []

    def window(*words):
        windows.append(Window(*words))
        return windows[-1]

    yield window
    for one in windows:
        one.close()


@pytest.fixture
def window(result_of, opened):
    out = result_of(3, with_models=True)
    return opened(read_scene(out), beams_of(out))


def port_of(window):
    return int(window.url.rpartition(":")[2])


def get(window, path="/", **headers):
    request = urllib.request.Request(window.url + path, headers=headers)
    return urllib.request.urlopen(request, timeout=10)


def test_page_is_served_with_its_policy(window):
    with get(window) as page:
        assert page.status == 200
        assert b"<html" in page.read()
        policy = page.headers["Content-Security-Policy"]
    assert f"connect-src 'self' data: blob: ws://127.0.0.1:{port_of(window)};" in policy


@pytest.mark.parametrize(
    "headers", [{"Host": "example.org"}, {"Origin": "https://example.org"}, {"Origin": "null"}]
)
def test_foreign_page_is_refused(window, headers):
    with pytest.raises(urllib.error.HTTPError) as caught:
        get(window, **headers)
    with caught.value:
        assert caught.value.code == 403


@pytest.mark.parametrize("packed", ["gzip", "identity"])
def test_page_disables_tone_mapping(window, packed):
    """It is what viser has, and before all of its own scripts the one that does so."""
    with get(window, **{"Accept-Encoding": packed}) as answer:
        page, headers = answer.read(), answer.headers
    assert int(headers["Content-Length"]) == len(page)
    assert headers["Content-Encoding"] == packed
    page = gzip.decompress(page) if packed == "gzip" else page
    first = page[page.index(b"<script") : page.index(b"</script>")]
    assert b"TONE_MAPPING" in first
    plain = (Path(viser.__file__).parent / "client/build/index.html").read_bytes()
    assert page.replace(first + b"</script>", b"") == plain


def test_socket_answers_only_its_page(window):
    address, protocol = f"ws://127.0.0.1:{port_of(window)}", [f"viser-v{viser.__version__}"]
    with sockets.connect(address, subprotocols=protocol, origin=window.url) as socket_:
        assert len(socket_.recv(timeout=10)) > 0
    with pytest.raises(Exception, match="403"):
        sockets.connect(address, subprotocols=protocol, origin="https://example.org")


def test_only_loopback_answers(window):
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as one:
        # another address of loopback, which stands for those of the network
        assert one.connect_ex(("127.0.0.2", port_of(window))) != 0
    for family, *_, address in socket.getaddrinfo(socket.gethostname(), port_of(window)):
        if family == socket.AF_INET and not address[0].startswith("127."):
            with socket.socket(family, socket.SOCK_STREAM) as one:
                one.settimeout(2)
                assert one.connect_ex(address) != 0


def test_no_share_url_is_requested(window, monkeypatch):
    def refused(*_words, **_more):
        raise AssertionError("a tunnel")

    monkeypatch.setattr("viser._viser.ViserTunnel", refused)
    assert window._server.request_share_url() is None


def test_close_stops_the_server(result_of):
    window = Window(read_scene(result_of(2)), None)
    window.close()
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as one:
        assert one.connect_ex(("127.0.0.1", port_of(window))) != 0


def test_nothing_is_printed(result_of, capfd):
    window = Window(read_scene(result_of(2)), None)
    window.close()
    assert capfd.readouterr() == ("", "")


def test_malformed_requests_are_not_logged(window, capfd):
    for what in (b"nonsense\r\n\r\n", b"GET / HTTP/1.1\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", port_of(window)), timeout=10) as one:
            one.sendall(what)
            one.shutdown(socket.SHUT_WR)
            while one.recv(4096):
                pass
    with get(window) as page:
        assert page.status == 200
    assert capfd.readouterr() == ("", "")


def test_taken_port_is_refused(window, result_of):
    with pytest.raises(InputError, match="is taken"):
        Window(read_scene(result_of(2)), None, port_of(window))


def test_free_port_is_used(result_of, opened):
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    assert port_of(opened(read_scene(result_of(2)), None, port)) == port


def test_unknown_viser_is_refused(result_of, monkeypatch):
    """Where its server starts otherwise than we know, it would answer anybody."""
    from contextlib import contextmanager

    @contextmanager
    def nothing():
        yield []

    monkeypatch.setattr(module, "_guard_servers", nothing)
    with pytest.raises(RuntimeError, match="viser"):
        Window(read_scene(result_of(2)), None)


def test_layers_without_data_are_left_out(result_of, opened, window):
    flat = opened(read_scene(result_of(2)), None)
    objects = ["Objects", "Object tracks", "Object numbers"]
    assert list(flat._boxes) == ["Map", "Robot", *objects]
    clouds = ["Static points", "Dynamic points"]
    assert list(window._boxes) == [
        *("Map", "Surface", *clouds, "Robot", "Beams", "Rays"),
        *("Objects", "Object tracks", "Object models", "Object numbers"),
    ]


def test_show_scan(window):
    layers, scene = window._layers, window._scene
    window._boxes["Beams"].value = True
    window.step()
    for scan in (2, 5, 0):
        window.show(scan)
        assert window._slider.value == scan
        assert window._clock.value == f"{0.5 * scan:.1f} of 2.5 s"
        beams = layers._beams.scan_view(scan)
        assert layers._ends.points == pytest.approx(beams.ends, abs=1e-5)
        assert layers._ends.colors.shape == beams.ends.shape
        assert layers._robot.position == pytest.approx(scene.poses[scan, :3, 3])
        there = 1 <= scan <= 3
        assert layers._models[0].visible is there
        assert len(layers._box.points) == (12 if there else 0)


def test_slider(window):
    window._slider.value = 4
    window.step()
    assert window.scan == 4


def test_default_layers_with_a_surface(window):
    shown = {name for name, box in window._boxes.items() if box.value}
    assert shown == {"Surface", "Robot", "Objects", "Object models"}
    assert all(node.visible is (name in shown) for name, node in window._layers._nodes.items())


def test_default_layers_without_a_surface(result_of, opened):
    out = result_of(3)
    bare = opened(read_scene(out), beams_of(out))
    shown = {name for name, box in bare._boxes.items() if box.value}
    assert shown == {"Map", "Static points", "Robot", "Beams", "Objects"}


def test_map_lies_below_the_surface(result_of, opened, window):
    def height(of):
        plan = of._server.scene.get_handle_by_name("/map/plan")
        return float(plan.position[2]) + of._scene.origin[2]

    assert -0.3 < height(window) - window._scene.ground < -0.05
    flat = opened(read_scene(result_of(2)), None)
    assert height(flat) == flat._scene.ground


def test_notes_are_shown_with_their_layers(result_of, opened, monkeypatch):
    monkeypatch.setitem(scenes.MAX_POINTS, "static", 11)
    out = result_of(3, with_models=True)
    window = opened(read_scene(out), beams_of(out))

    def told():
        return [note.content for note in window._notes.values() if note.visible]

    assert told() == []
    window._boxes["Beams"].value = True
    window.step()
    assert [text.split(":")[0] for text in told()] == ["Beams\\"]
    window._boxes["Beams"].value = False
    window._boxes["Static points"].value = True
    window.step()
    (text,) = told()
    assert text.startswith("11 of ")


def test_check_boxes_show_and_hide(window):
    window.show(2)
    assert window._layers._nodes["Surface"].visible
    window._boxes["Surface"].value = False
    window._boxes["Object numbers"].value = True
    window.step()
    assert not window._layers._nodes["Surface"].visible
    assert [label.text for label in window._layers._label] == ["7"]


def test_point_size(window):
    before = window._layers._ends.point_size
    window._size.value = 2.0
    window.step()
    assert window._layers._ends.point_size == pytest.approx(2 * before)


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
    assert _escape_markdown("a_b <img src=x>") == r"a\_b \<img src=x\>"
