"""The page of a result: what is shown of it, and the time.

From where one looks first.
"""

import math
import re
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.viewer.layers import Layers
from stillmap.viewer.scene import Scene
from stillmap.viewer.server import start_server, stop_server
from stillmap.viewer.tracks import Beams

FIELD_OF_VIEW = math.radians(60.0)  # from top to bottom

_WIDE = 1.1  # width of a window for its height, at least, beside what is clicked

_MARGIN = 1.1

_REACH = (0.03, 0.97)  # quantiles of points that are to be seen: few lie far away

_SLANT = np.array([-0.45, -0.7, 0.62])  # from behind, from the right, from above

_NEARER = 0.95  # in space: what lies behind the middle looks smaller

_LEAST = 5.0  # m


class DefaultView(NamedTuple):
    """Where the eye is.

    Attributes:
        position, look_at: (3,) metres around the scene's origin.
        across: metres from the lower to the upper edge of the window, where it looks.
        far: metres to the last that is to be seen.
    """

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]
    height: float
    far: float


def default_view(scene: Scene) -> DefaultView:
    """In the plane from above, north up; in space at a slant."""
    low, high = _box(scene)
    middle, (width, height) = 0.5 * (low + high), np.maximum(high - low, _LEAST)[:2]
    across = _MARGIN * max(height, width / _WIDE) * (1.0 if scene.is_2d else _NEARER)
    away = 0.5 * across / math.tan(0.5 * FIELD_OF_VIEW)
    if scene.is_2d:
        # not quite from above: then nothing would say where north is
        offset = np.array([0.0, -0.01, 1.0]) * away
    else:
        offset = _SLANT / np.linalg.norm(_SLANT) * away
    return DefaultView(middle + offset, middle, across, 20.0 * away)


def _box(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3,) and (3,) metres around the scene's origin: corners of what is to be seen."""
    static = scene.clouds.get("static")
    if static is not None and len(static.points):
        low, high = np.quantile(static.points.astype(np.float64), _REACH, axis=0)
        return low, high
    way = scene.poses[:, :3, 3] - scene.origin
    if scene.map_image is None:
        return np.asarray(way.min(axis=0)), np.asarray(way.max(axis=0))
    x0, y0, x1, y1 = scene.map_image.window
    return np.array([x0, y0, 0.0]) - scene.origin, np.array([x1, y1, 0.0]) - scene.origin


_FRAME = 0.1  # s: as often as the page is told of something new while it plays

_IDLE = 0.05  # s between looks at what was clicked

_SPEEDS = {"1 x": 1.0, "3 x": 3.0, "10 x": 10.0, "30 x": 30.0, "100 x": 100.0}

_MARKS = re.compile(r"([\\`*_{}\[\]()<>#+\-.!|~&$:])")  # that mean something in Markdown


class Window:
    """A scene on a page of its own; `step` has to be called again and again."""

    def __init__(self, scene: Scene, beams: Beams | None, port: int = 0) -> None:
        """Serve it at a port of 127.0.0.1; 0: any that is free.

        Raises:
            InputError: the port is taken.
        """
        self._scene = scene
        self._seconds = 1e-9 * (scene.stamp_ns - scene.stamp_ns[0])
        self._scan, self._at, self._playing, self._ticked = 0, 0.0, False, time.monotonic()
        self._server = start_server(port, "stillmap")
        try:
            self._layers = Layers(self._server, scene, beams, self._look())
            self._controls()
            self.show(0)
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str:
        """Where to look."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    @property
    def scan(self) -> int:
        """Number of the scan that is shown."""
        return self._scan

    def close(self) -> None:
        """Nothing is served any more; a page that is open stays as it is."""
        stop_server(self._server)

    def show(self, scan: int) -> None:
        """Show what was there at a scan."""
        self._scan = scan
        with self._server.atomic():
            self._slider.value = scan
            self._clock.value = f"{self._seconds[scan]:.1f} of {self._seconds[-1]:.1f} s"
            self._layers.update(scan)

    def play(self, playing: bool) -> None:
        """Let the time go on, or not."""
        self._playing = playing
        self._button.label = "Pause" if playing else "Play"

    def step(self) -> None:
        """Wait a moment, then do what was clicked meanwhile, and go on in time.

        Raises:
            InputError: the recording can no longer be read.
        """
        time.sleep(_FRAME if self._playing else _IDLE)
        now = time.monotonic()
        passed, self._ticked = now - self._ticked, now
        wanted = int(self._slider.value)
        if wanted != self._scan:  # somebody moved it
            self._at = float(self._seconds[wanted])
        elif self._playing:
            wanted = self._later(passed)
        self._layers.scale_points(self._size.value)
        changed = [self._layers.set_visible(name, box.value) for name, box in self._boxes.items()]
        if any(changed):
            for name, note in self._notes.items():
                note.visible = self._boxes[name].value
        if wanted != self._scan or any(changed):
            self.show(wanted)

    def _later(self, passed: float) -> int:
        """The scan that is due so many seconds later; after the last one the first."""
        self._at += passed * _SPEEDS[self._speed.value]
        if self._at > self._seconds[-1]:
            self._at = 0.0
        return int(np.searchsorted(self._seconds, self._at, side="right")) - 1

    def _look(self) -> float:
        """Metres from the lower to the upper edge of the window."""
        first, camera = default_view(self._scene), self._server.initial_camera
        camera.fov, camera.far, camera.near = FIELD_OF_VIEW, first.far, 1e-4 * first.far
        camera.position, camera.look_at = first.position, first.look_at
        return first.height

    def _controls(self) -> None:
        gui, last = self._server.gui, len(self._seconds) - 1
        gui.add_markdown(f"**{_plain(self._scene.name)}**")
        # Any: their values are set, which viser's types do not know
        self._slider: Any = gui.add_slider("Scan", 0, max(last, 1), 1, 0, disabled=not last)
        self._clock: Any = gui.add_text("Time", "", disabled=True)
        self._speed = gui.add_dropdown("Speed", tuple(_SPEEDS))
        self._button = gui.add_button("Play", disabled=not last)
        self._button.on_click(self._clicked)
        with gui.add_folder("Show"):
            self._boxes = {
                name: gui.add_checkbox(name, shown)
                for name, shown in self._layers.default_visibility.items()
            }
            self._size = gui.add_slider("Point size", 0.5, 5.0, 0.5, 1.0)
        self._notes = {
            name: gui.add_markdown(_plain(note), visible=self._layers.default_visibility[name])
            for name, note in self._layers.notes.items()
        }
        for note in self._scene.notes:
            gui.add_markdown(_plain(note))

    def _clicked(self, _event: Any) -> None:
        self.play(not self._playing)


def _plain(text: str) -> str:
    """The same text in Markdown: names of files say nothing of how they are shown."""
    return _MARKS.sub(r"\\\1", text)
