"""The page of a result: default view, controls and playback."""

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

FIELD_OF_VIEW = math.radians(60.0)  # vertical
_MIN_ASPECT = 1.1  # width / height of the window beside the controls
_MARGIN = 1.1
_EXTENT_QUANTILES = (0.03, 0.97)  # of the points, without far outliers
_DIRECTION_3D = np.array([-0.45, -0.7, 0.62])  # from the scene to the camera
_SCALE_3D = 0.95  # of the height: what lies behind the center appears smaller
_MIN_EXTENT = 5.0  # m
_FRAME_TIME = 0.1  # s between updates while playing
_IDLE_TIME = 0.05  # s between polls of the controls
_SPEEDS = {"1 x": 1.0, "3 x": 3.0, "10 x": 10.0, "30 x": 30.0, "100 x": 100.0}
_MARKDOWN = re.compile(r"([\\`*_{}\[\]()<>#+\-.!|~&$:])")  # special characters


class DefaultView(NamedTuple):
    """The initial camera.

    Attributes:
        position, look_at: (3,) m relative to the scene's origin.
        height: height of the view in m at `look_at`.
        far: distance of the far plane in m.
    """

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]
    height: float
    far: float


def default_view(scene: Scene) -> DefaultView:
    """The camera that shows the whole scene: 2D from above, north up; 3D at a slant."""
    low, high = _bounds(scene)
    center, (width, height) = 0.5 * (low + high), np.maximum(high - low, _MIN_EXTENT)[:2]
    shown = _MARGIN * max(height, width / _MIN_ASPECT) * (1.0 if scene.is_2d else _SCALE_3D)
    distance = 0.5 * shown / math.tan(0.5 * FIELD_OF_VIEW)
    if scene.is_2d:
        # not exactly vertical, which would leave the direction of north undefined
        offset = np.array([0.0, -0.01, 1.0]) * distance
    else:
        offset = _DIRECTION_3D / np.linalg.norm(_DIRECTION_3D) * distance
    return DefaultView(center + offset, center, shown, 20.0 * distance)


def _bounds(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner (3,) of the visible content in m, relative to the scene's origin."""
    static = scene.clouds.get("static")
    if static is not None and len(static.points):
        low, high = np.quantile(static.points.astype(np.float64), _EXTENT_QUANTILES, axis=0)
        return low, high
    positions = scene.poses[:, :3, 3] - scene.origin
    if scene.map_image is None:
        return np.asarray(positions.min(axis=0)), np.asarray(positions.max(axis=0))
    x0, y0, x1, y1 = scene.map_image.window
    return np.array([x0, y0, 0.0]) - scene.origin, np.array([x1, y1, 0.0]) - scene.origin


class Window:
    """A scene on a page; the caller calls `step` in a loop.

    Attributes:
        scan: index of the scan that is shown.
    """

    def __init__(self, scene: Scene, beams: Beams | None, port: int = 0) -> None:
        """Serve the page at a port of 127.0.0.1; 0: any free one.

        Raises:
            InputError: the port is taken.
        """
        self._scene = scene
        self._seconds = 1e-9 * (scene.stamp_ns - scene.stamp_ns[0])
        self.scan, self._at, self._playing, self._ticked = 0, 0.0, False, time.monotonic()
        self._server = start_server(port)
        try:
            self._layers = Layers(self._server, scene, beams, self._set_default_view())
            self._controls()
            self.show(0)
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def close(self) -> None:
        """Stop the server."""
        stop_server(self._server)

    def show(self, scan: int) -> None:
        """Show a scan."""
        self.scan = scan
        with self._server.atomic():
            self._slider.value = scan
            self._clock.value = f"{self._seconds[scan]:.1f} of {self._seconds[-1]:.1f} s"
            self._layers.update(scan)

    def play(self, playing: bool) -> None:
        """Start or pause the playback."""
        self._playing = playing
        self._button.label = "Pause" if playing else "Play"

    def step(self) -> None:
        """Wait for a moment, then apply the controls and advance the playback.

        Raises:
            InputError: the recording can no longer be read.
        """
        time.sleep(_FRAME_TIME if self._playing else _IDLE_TIME)
        now = time.monotonic()
        passed, self._ticked = now - self._ticked, now
        wanted = int(self._slider.value)
        if wanted != self.scan:  # the slider was moved
            self._at = float(self._seconds[wanted])
        elif self._playing:
            wanted = self._advance(passed)
        self._layers.scale_points(self._size.value)
        changed = [self._layers.set_visible(name, box.value) for name, box in self._boxes.items()]
        if any(changed):
            for name, note in self._notes.items():
                note.visible = self._boxes[name].value
        if wanted != self.scan or any(changed):
            self.show(wanted)

    def _advance(self, passed: float) -> int:
        """The scan after `passed` s of playback; the first one after the last."""
        self._at += passed * _SPEEDS[self._speed.value]
        if self._at > self._seconds[-1]:
            self._at = 0.0
        return int(np.searchsorted(self._seconds, self._at, side="right")) - 1

    def _set_default_view(self) -> float:
        """Place the camera; returns the height of the view in m."""
        view, camera = default_view(self._scene), self._server.initial_camera
        camera.fov, camera.far, camera.near = FIELD_OF_VIEW, view.far, 1e-4 * view.far
        camera.position, camera.look_at = view.position, view.look_at
        return view.height

    def _controls(self) -> None:
        gui, last = self._server.gui, len(self._seconds) - 1
        gui.add_markdown(f"**{_escape_markdown(self._scene.name)}**")
        # Any: viser's types do not allow setting values
        self._slider: Any = gui.add_slider("Scan", 0, max(last, 1), 1, 0, disabled=not last)
        self._clock: Any = gui.add_text("Time", "", disabled=True)
        self._speed = gui.add_dropdown("Speed", tuple(_SPEEDS))
        self._button = gui.add_button("Play", disabled=not last)
        self._button.on_click(lambda _event: self.play(not self._playing))
        visible = self._layers.default_visibility
        with gui.add_folder("Show"):
            self._boxes = {name: gui.add_checkbox(name, shown) for name, shown in visible.items()}
            self._size = gui.add_slider("Point size", 0.5, 5.0, 0.5, 1.0)
        self._notes = {
            name: gui.add_markdown(_escape_markdown(note), visible=visible[name])
            for name, note in self._layers.notes.items()
        }
        for note in self._scene.notes:
            gui.add_markdown(_escape_markdown(note))


def _escape_markdown(text: str) -> str:
    """Text escaped for Markdown."""
    return _MARKDOWN.sub(r"\\\1", text)
