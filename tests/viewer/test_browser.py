"""The page in a headless Chromium."""

import re
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stillmap.mesh.texture import TexturedMesh
from stillmap.results.colors import BACKGROUND, TEAL
from stillmap.results.gltf import write_glb
from stillmap.results.viewer.scene import Scene

pytest.importorskip("viser", reason="the extra `viewer` is not installed")
pytest.importorskip("websockets.sync.client")

from browser_tab import BROWSER, HEIGHT, Tab

from stillmap.results.viewer.window import Window

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="there is no Chromium here"),
]


@pytest.fixture
def tab(tmp_path):
    one = Tab(tmp_path / "profile")
    yield one
    one.close()


def hues(picture):
    """How many pixels are of each kind of colour, left of what is clicked."""
    shown = picture[:, :650]
    red, green, blue = shown[..., 0], shown[..., 1], shown[..., 2]
    return {
        "orange": int(((red > blue + 100) & (red > green + 60)).sum()),
        "blue": int((blue > red + 60).sum()),
        "dark": int((shown.max(axis=2) < 60).sum()),
    }


def shown_in(tab, window, counted, wanted):
    """How many pixels of each kind the page has as soon as there are some, or after a while."""
    tab.call("Page.navigate", url=window.url)
    end = time.monotonic() + 40
    while True:
        for _ in range(20):
            window.step()
        counts = counted(tab.picture())
        if all(counts[name] > 20 for name in wanted) or time.monotonic() > end:
            return counts


def tiled(path, tones):
    """A model of square metres side by side, each painted in one colour, in the map's plane."""
    corners = [
        np.array([(n, 0, 0), (n + 1, 0, 0), (n + 1, 1, 0), (n, 1, 0)]) for n in range(len(tones))
    ]
    uv = np.tile([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], (len(tones), 1))
    square = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    page = np.repeat(np.arange(len(tones), dtype=np.int32), 2)
    textured = TexturedMesh(
        vertices=np.concatenate(corners).astype(float),
        faces=np.concatenate([square + 4 * n for n in range(len(tones))]).astype(np.int32),
        uv=uv,
        page=page,
        pages=tuple(np.full((16, 16, 3), tone, np.uint8) for tone in tones),
        view=page,
    )
    write_glb(path, textured, quality=0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_page_shows_the_result_without_foreign_requests(result_of, beams_of, tab, dimension):
    out = result_of(dimension, with_models=dimension == 3)
    window = Window(Scene(out), beams_of(out))
    try:
        window._boxes["Beams"].value = True
        window.step()
        window.show(2)
        window._size.value = 3.0
        counts = shown_in(tab, window, hues, ("orange", "blue", "dark"))
    finally:
        window.close()
    assert min(counts.values()) > 20, counts
    asked = [one["request"]["url"] for one in tab.of("Network.requestWillBeSent")]
    asked += [one["url"] for one in tab.of("Network.webSocketCreated")]
    assert window.url + "/" in asked
    blobs = f"blob:{window.url.rpartition('/')[0]}/"  # they have no path
    own = (window.url, window.url.replace("http", "ws"), "data:", blobs)
    assert [address for address in asked if not address.startswith(own)] == []
    assert tab.of("Runtime.exceptionThrown") == []
    refused = [one["entry"]["text"] for one in tab.of("Log.entryAdded")]
    assert not any("Security Policy" in text for text in refused)


def test_texture_colors_are_shown_unchanged(result_of, tab):
    pytest.importorskip("trimesh", reason="the extra `mesh` is not installed")
    out = result_of(3)
    tones = [(118, 13, 41), (250, 248, 240), (230, 60, 40), (60, 200, 60)]
    tiled(out / "mesh.glb", tones)
    window = Window(Scene(out), None)
    for name, box in window._boxes.items():
        box.value = name == "Surface"

    def counted(picture):
        wanted = [*tones, BACKGROUND]
        return {tone: int((np.abs(picture - tone).max(axis=2) <= 1).sum()) for tone in wanted}

    try:
        counts = shown_in(tab, window, counted, tones)
    finally:
        window.close()
    assert min(counts.values()) > 100, counts


def until(window, seen, seconds=60.0):
    """Run the window until something is seen."""
    end = time.monotonic() + seconds
    while not seen():
        assert time.monotonic() < end, "not seen in time"
        for _ in range(5):
            window.step()


@pytest.fixture
def shown(result_of, beams_of, opened, tab):
    """Opens a page of a result with D dimensions and waits until it shows the scene."""

    def page(dimension):
        out = result_of(dimension)
        window = opened(Scene(out, "walk.bag"), beams_of(out))
        counts = shown_in(tab, window, hues, ("orange", "blue"))
        assert min(counts["orange"], counts["blue"]) > 20, counts
        # what covers the page without a graphics card
        tab.value("document.querySelector('.mantine-Notification-closeButton')?.click()")
        until(window, lambda: "Legend" in tab.value("document.body.innerText"))
        return window

    return page


def field_of(tab):
    """The number that the page shows for the scan."""
    return int(tab.value("document.querySelector('[role=slider]').ariaValueNow"))


def pixel_of(tab, window, point):
    """Where a point (3,) of the scene is on the page, whose controls are beside the scene."""
    (client,) = window._server.get_clients().values()
    w, x, y, z = client.camera.wxyz
    seen = Rotation.from_quat([x, y, z, w]).inv().apply(point - client.camera.position)
    focal_length = 0.5 * HEIGHT / np.tan(0.5 * client.camera.fov)
    width = tab.value("document.querySelector('canvas').getBoundingClientRect().width")
    return np.array([width, HEIGHT]) / 2 + focal_length * seen[:2] / seen[2]


@pytest.mark.parametrize("dimension", [2, 3])
def test_space_plays_and_pauses(shown, tab, dimension):
    window = shown(dimension)
    before = tab.picture()[:, :650]

    def changed():
        """Number of pixels of the scene that are others than before."""
        return int((np.abs(tab.picture()[:, :650] - before).max(axis=2) > 60).sum())

    tab.press(" ", "Space")
    until(window, lambda: field_of(tab) >= 2)
    until(window, lambda: changed() > 50)
    tab.press(" ", "Space")
    until(window, lambda: "Play" in tab.value("document.body.innerText").split("\n"))
    scan = window.scan
    for _ in range(20):
        window.step()
    assert window.scan == scan == field_of(tab)


def test_arrows_step_and_leave_the_camera(shown, tab):
    window = shown(2)
    (client,) = window._server.get_clients().values()
    before = client.camera.position.copy()
    for scan in (1, 2):
        tab.press("ArrowRight", "ArrowRight")
        until(window, lambda wanted=scan: field_of(tab) == wanted)
    tab.press("ArrowLeft", "ArrowLeft")
    until(window, lambda: field_of(tab) == 1)
    assert client.camera.position == pytest.approx(before)


def test_keys_and_check_boxes_show_and_hide_layers(shown, tab):
    window = shown(3)

    def rays():
        """Pixels in the color of rays."""
        picture = tab.picture()[:, 250:650]
        return int((np.abs(picture - TEAL).max(axis=2) < 25).sum())

    assert rays() < 20
    tab.press("7", "Digit7")
    until(window, lambda: rays() > 200)
    assert "rays from the sensor" in tab.value("document.body.innerText")
    tab.click(
        *tab.value(
            "(() => { const l = [...document.querySelectorAll('label')].find(e => e.textContent == "
            "'7 Rays'); const r = l.closest('div').parentElement.querySelector('[type=checkbox]')"
            ".getBoundingClientRect(); return [r.x + r.width/2, r.y + r.height/2] })()"
        )
    )
    until(window, lambda: rays() < 20)
    # the check box does not keep the keys for itself
    tab.press("7", "Digit7")
    until(window, lambda: rays() > 200)


def test_distance_between_two_clicks(shown, tab):
    window = shown(2)
    tab.press("m", "KeyM")
    until(window, lambda: "Click on the first point" in tab.value("document.body.innerText"))
    (client,) = window._server.get_clients().values()
    # about the center of the view, beside the legend
    ends = client.camera.look_at + np.array([[-0.8, -0.6, 0.0], [1.6, 1.2, 0.0]])
    for count, end in enumerate(ends):
        tab.click(*pixel_of(tab, window, end))
        until(window, lambda wanted=count + 1: len(window._measuring.points) == wanted)
    until(window, lambda: re.search(r"\d\.\d\d m\n", tab.value("document.body.innerText")))
    length = re.search(r"(\d\.\d\d) m\n", tab.value("document.body.innerText"))[1]
    assert float(length) == pytest.approx(3.0, abs=0.05)  # pixels are whole
    tab.press("Escape", "Escape")
    until(window, lambda: f"{length} m\n" not in tab.value("document.body.innerText"))
