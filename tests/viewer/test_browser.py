"""The page in a headless Chromium."""

import base64
import io
import json
import re
import shutil
import subprocess
import time
import urllib.request

import numpy as np
import pytest
from PIL import Image

from stillmap.mesh.texture.atlas import TexturedMesh
from stillmap.results.gltf import write_glb
from stillmap.results.report.renderer import BACKGROUND
from stillmap.viewer.scene import read_scene

pytest.importorskip("viser", reason="the extra `viewer` is not installed")
sockets = pytest.importorskip("websockets.sync.client")

from stillmap.viewer.window import Window  # noqa: E402

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="there is no Chromium here"),
]


class Tab:
    """A tab of a headless Chromium, and what it says happened."""

    def __init__(self, folder):
        flags = ["--headless", "--no-sandbox", "--enable-unsafe-swiftshader"]
        flags += ["--remote-debugging-port=0", f"--user-data-dir={folder}"]
        self.process = subprocess.Popen(
            [BROWSER, *flags, "--window-size=1000,700", "about:blank"],
            stderr=subprocess.PIPE,
            text=True,
        )
        port = next(
            found[1]
            for line in self.process.stderr
            if (found := re.search(r"DevTools listening on ws://[^:]+:(\d+)/", line))
        )
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
            pages = json.load(answer)
        address = next(page for page in pages if page["type"] == "page")["webSocketDebuggerUrl"]
        self.socket = sockets.connect(address, max_size=None)
        self.sent, self.events = 0, []
        for part in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{part}.enable")

    def call(self, method, **words):
        self.sent += 1
        self.socket.send(json.dumps({"id": self.sent, "method": method, "params": words}))
        while True:
            answer = json.loads(self.socket.recv(timeout=30))
            if answer.get("id") == self.sent:
                return answer["result"]
            self.events.append(answer)

    def of(self, *methods):
        return [one["params"] for one in self.events if one.get("method") in methods]

    def picture(self):
        data = self.call("Page.captureScreenshot", format="png")["data"]
        return np.array(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(int)

    def close(self):
        self.socket.close()
        self.process.terminate()
        self.process.wait()
        self.process.stderr.close()


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
def test_page_shows_the_result_without_foreign_requests(result_of, tab, dimension):
    from test_window import beams_of

    out = result_of(dimension, with_models=dimension == 3)
    window = Window(read_scene(out), beams_of(out))
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
    own = (window.url, window.url.replace("http", "ws"), "data:", f"blob:{window.url}")
    assert [address for address in asked if not address.startswith(own)] == []
    assert tab.of("Runtime.exceptionThrown") == []
    refused = [one["entry"]["text"] for one in tab.of("Log.entryAdded")]
    assert not any("Security Policy" in text for text in refused)


def test_texture_colors_are_shown_unchanged(result_of, tab):
    pytest.importorskip("trimesh", reason="the extra `mesh` is not installed")
    out = result_of(3)
    tones = [(118, 13, 41), (250, 248, 240), (230, 60, 40), (60, 200, 60)]
    tiled(out / "mesh.glb", tones)
    window = Window(read_scene(out), None)

    def counted(picture):
        wanted = [*tones, BACKGROUND]
        return {tone: int((np.abs(picture - tone).max(axis=2) <= 1).sum()) for tone in wanted}

    try:
        counts = shown_in(tab, window, counted, tones)
    finally:
        window.close()
    assert min(counts.values()) > 100, counts
