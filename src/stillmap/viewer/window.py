"""The page of a result: what is shown of it, and the time."""

import re
import time
from typing import Any

import numpy as np

from stillmap.viewer.beams import Beams
from stillmap.viewer.framing import FIELD_OF_VIEW, framing
from stillmap.viewer.layers import Layers
from stillmap.viewer.scene import Scene
from stillmap.viewer.server import started, stop

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
        self._server = started(port, "stillmap")
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
        stop(self._server)

    def show(self, scan: int) -> None:
        """Show what was there at a scan."""
        self._scan = scan
        with self._server.atomic():
            self._slider.value = scan
            self._clock.value = f"{self._seconds[scan]:.1f} of {self._seconds[-1]:.1f} s"
            self._layers.draw(scan)

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
        self._layers.resize(self._size.value)
        changed = [self._layers.set_shown(name, box.value) for name, box in self._boxes.items()]
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
        first, camera = framing(self._scene), self._server.initial_camera
        camera.fov, camera.far, camera.near = FIELD_OF_VIEW, first.far, 1e-4 * first.far
        camera.position, camera.look_at = first.position, first.look_at
        return first.across

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
                name: gui.add_checkbox(name, shown) for name, shown in self._layers.shown.items()
            }
            self._size = gui.add_slider("Point size", 0.5, 5.0, 0.5, 1.0)
        self._notes = {
            name: gui.add_markdown(_plain(note), visible=self._layers.shown[name])
            for name, note in self._layers.notes.items()
        }
        for note in self._scene.notes:
            gui.add_markdown(_plain(note))

    def _clicked(self, _event: Any) -> None:
        self.play(not self._playing)


def _plain(text: str) -> str:
    """The same text in Markdown: names of files say nothing of how they are shown."""
    return _MARKS.sub(r"\\\1", text)
