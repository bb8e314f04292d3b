"""The page of a result: its controls, and what happens when they are used."""

import time
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from typing import Any

import numpy as np

from stillmap.core.array_types import Int64
from stillmap.results import colors
from stillmap.results.report.figures import UNKNOWN
from stillmap.results.report.template import render_part
from stillmap.results.viewer.layers import DYNAMIC, STATIC, Layers
from stillmap.results.viewer.measuring import Measuring
from stillmap.results.viewer.nodes import (
    FIELD_OF_VIEW,
    Nodes,
    default_view,
    escape_markdown,
    table_html,
)
from stillmap.results.viewer.objects import ObjectNodes, describe_object
from stillmap.results.viewer.scene import Beams, Scene
from stillmap.results.viewer.server import start_server, stop_server
from stillmap.results.viewer.sessions import Sessions

_FRAME_TIME = 0.1  # s between updates while playing
_IDLE_TIME = 0.05  # s between polls of the controls
_SPEEDS = {"1 x": 1.0, "3 x": 3.0, "10 x": 10.0, "30 x": 30.0, "100 x": 100.0}
_LEGEND_MARGIN, _LEGEND_WIDTH = 15, 215  # pixels: to the borders of the page; of the panel


# W, A, S, D, Q, E and the vertical arrows move viser's camera
LAYER_KEYS = {
    "Map": "1",
    "Surface": "2",
    STATIC: "3",
    DYNAMIC: "4",
    "Robot": "5",
    "Beams": "6",
    "Rays": "7",
    "Objects": "8",
    "Object tracks": "9",
    "Object models": "0",
    "Object ids": "N",
    "Sessions": "T",
    "Changes": "C",
    "Change labels": "B",
}
ACTION_KEYS = {
    "Play or pause": "space",
    "Next scan": "arrowright",
    "Previous scan": "arrowleft",
    "First scan": "home",
    "Last scan": "end",
    "Measure": "M",
    "Clear": "escape",
    "Default view": "V",
    "Legend": "L",
    "Next session": "pagedown",
    "Previous session": "pageup",
}


class Window:
    """A scene on a page; the caller calls `step` in a loop.

    Callbacks of viser run in its threads: they only queue what `step` then does.

    Attributes:
        scan: index of the scan that is shown.
    """

    def __init__(self, scene: Scene, beams: Beams | None, port: int = 0) -> None:
        """Serve the page at a port of 127.0.0.1; 0: any free one.

        Raises:
            InputError: the port is taken.
        """
        self._scene, self._view = scene, default_view(scene)
        self._events: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._server = start_server(port, f"{scene.name} - stillmap")
        try:
            camera, distance = self._server.initial_camera, self._view.distance
            camera.fov, camera.far, camera.near = FIELD_OF_VIEW, 20.0 * distance, 2e-3 * distance
            camera.position, camera.look_at = self._view.position, self._view.look_at
            nodes = Nodes(self._server, scene, self._view.height)
            self._objects = ObjectNodes(nodes, lambda number: self._defer(self._select, number)())
            self._add_controls(nodes, beams)
            for action, act in self._actions().items():
                is_layer = action in LAYER_KEYS
                label = f"Show or hide: {action.lower()}" if is_layer else action
                key: Any = (LAYER_KEYS | ACTION_KEYS)[action]
                self._server.gui.add_command(label, hotkey=key).on_trigger(self._defer(act))
            if self._sessions is None:
                self._show_scans(slice(0, len(scene.stamp_ns)))
            else:
                self.show_session(self._sessions.count - 1)
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str:
        """Address of the page: who knows it can see the page."""
        return self._server.url

    def close(self) -> None:
        """Stop the server."""
        stop_server(self._server)

    def show(self, scan: int) -> None:
        """Show a scan."""
        self.scan = scan
        with self._server.atomic():
            self._slider.value = scan
            self._clock.value = f"{self._seconds[scan]:.1f} of {self._seconds[-1]:.1f} s"
            self._layers.update(self._first + scan)
            self._show_facts()

    def show_session(self, session: int) -> None:
        """Show a session of a place from its first scan."""
        if self._sessions is not None:
            with self._server.atomic():
                self._sessions.choose(session)
                self._layers.show_session(self._sessions)
                self._show_scans(self._sessions.scans)

    def _show_scans(self, scans: slice) -> None:
        """Let the controls choose among these scans, and show the first one."""
        self._stamp_ns: Int64 = self._scene.stamp_ns[scans]
        self._first = scans.start
        self._seconds = 1e-9 * (self._stamp_ns - self._stamp_ns[0])
        last = len(self._stamp_ns) - 1
        self._slider.max, self._slider.disabled = max(last, 1), not last
        self._button.disabled = not last
        self._at, self._playing, self._ticked = 0.0, False, time.monotonic()
        self.show(0)

    def play(self, playing: bool) -> None:
        """Start or pause the playback."""
        self._playing, self._ticked = playing and len(self._seconds) > 1, time.monotonic()
        self._button.label = "Pause" if self._playing else "Play"

    def step(self) -> None:
        """Wait for a moment, then apply the controls and advance the playback.

        Raises:
            InputError: the recording can no longer be read.
        """
        time.sleep(_FRAME_TIME if self._playing else _IDLE_TIME)
        for _ in range(self._events.qsize()):
            self._events.get()()
        now = time.monotonic()
        passed, self._ticked = now - self._ticked, now
        sessions = self._sessions
        if sessions is not None and sessions.wanted != sessions.session:
            self.show_session(sessions.wanted)
        # a page may still name a scan of a longer session
        wanted = min(int(self._slider.value), len(self._seconds) - 1)
        if wanted != self.scan:  # the slider was moved
            self._at = float(self._seconds[wanted])
        elif self._playing:
            wanted = self._advance(passed)
        self._layers.scale_points(self._size.value)
        changed = [self._layers.set_visible(name, box.value) for name, box in self._boxes.items()]
        if wanted != self.scan or any(changed):
            self.show(wanted)

    def _advance(self, passed: float) -> int:
        """The scan after `passed` s of playback; the first one after the last."""
        self._at += passed * _SPEEDS[self._speed.value]
        if self._at > self._seconds[-1]:
            self._at = 0.0
        return int(np.searchsorted(self._seconds, self._at, side="right")) - 1

    def _defer(self, act: Callable[..., None], *arguments: Any) -> Callable[..., None]:
        """A callback for viser that lets `step` act."""
        return lambda *_event: self._events.put(partial(act, *arguments))

    def _actions(self) -> dict[str, Callable[[], None]]:
        """The actions of keys, by name of the action or layer."""
        actions: dict[str, Callable[[], None]] = {
            "Play or pause": lambda: self.play(not self._playing),
            # not from `scan`: keys may be pressed faster than scans are shown
            "Next scan": lambda: self._go_to(int(self._slider.value) + 1),
            "Previous scan": lambda: self._go_to(int(self._slider.value) - 1),
            "First scan": lambda: self._go_to(0),
            "Last scan": lambda: self._go_to(len(self._seconds) - 1),
            "Measure": self._measuring.toggle,
            "Clear": self._clear,
            "Default view": self._reset_cameras,
            "Legend": lambda: _toggle(self._panel, "visible"),
        }
        sessions = self._sessions
        if sessions is not None:
            actions["Next session"] = lambda: sessions.go_to(sessions.wanted + 1)
            actions["Previous session"] = lambda: sessions.go_to(sessions.wanted - 1)
        return actions | {name: partial(_toggle, box) for name, box in self._boxes.items()}

    def _go_to(self, scan: int) -> None:
        """Pause at the scan that is nearest to an index."""
        self.play(False)
        self._slider.value = min(max(scan, 0), len(self._seconds) - 1)

    def _reset_cameras(self) -> None:
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = np.array([0.0, 0.0, 1.0])
                client.camera.position = self._view.position
                client.camera.look_at = self._view.look_at

    def _select(self, number: int | None) -> None:
        """Show the facts of an object; None: of none."""
        if not self._measuring.active:
            self._objects.selected = number
            self.show(self.scan)

    def _show_facts(self) -> None:
        found = [one for one in self._scene.tracks if one.id == self._objects.selected]
        self._facts_folder.visible = bool(found)
        for track in found:
            now, start = (int(self._stamp_ns[n]) for n in (self.scan, 0))
            self._facts_folder.label = f"Object {track.id}"
            self._facts.content = table_html(describe_object(track, now, start))

    def _clear(self) -> None:
        """Stop measuring, remove what was measured and selected."""
        if self._measuring.active:
            self._measuring.toggle()
        self._measuring.clear()
        self._select(None)

    def _add_controls(self, nodes: Nodes, beams: Beams | None) -> None:
        gui, scene = self._server.gui, self._scene
        gui.set_panel_label("stillmap")
        gui.main_panel.dock_right()  # beside the scene, not over it
        name, folder = escape_markdown(scene.name), escape_markdown(scene.folder)
        gui.add_markdown(f"**{name}**" if name == folder else f"**{name}**, result {folder}")
        self._sessions = None if scene.timeline is None else Sessions(nodes, scene.timeline)
        self._layers = Layers(nodes, beams, self._objects, self._sessions)
        # Any: viser's types do not allow setting values
        self._slider: Any = gui.add_slider("Scan", 0, 1, 1, 0)
        self._clock: Any = gui.add_text("Time", "", disabled=True)
        self._speed = gui.add_dropdown("Speed", tuple(_SPEEDS))
        self._button = gui.add_button("Play")
        self._button.on_click(self._defer(lambda: self.play(not self._playing)))
        self._measuring = Measuring(nodes, self._layers.pick, self._defer)
        self._facts_folder: Any = gui.add_folder("Object", visible=False)
        with self._facts_folder:
            self._facts: Any = gui.add_html("")
            gui.add_button("Close").on_click(self._defer(self._select, None))
        with gui.add_folder("Show"):
            self._boxes: dict[str, Any] = {
                name: gui.add_checkbox(f"{LAYER_KEYS[name]} {name}", shown)
                for name, shown in self._layers.default_visibility.items()
            }
            colorings = self._layers.colorings
            self._coloring = gui.add_dropdown("Points by", colorings, visible=len(colorings) > 1)
            recolor = self._defer(lambda: self._layers.color_points(self._coloring.value))
            self._coloring.on_update(recolor)
            self._size = gui.add_slider("Point size", 0.5, 5.0, 0.5, 1.0)
        for note in scene.notes:
            gui.add_markdown(escape_markdown(note))
        keys = {name: key for name, key in ACTION_KEYS.items() if name in self._actions()}
        gui.add_html(render_part("viewer.html.j2", "keys", keys))
        self._panel: Any = gui.add_panel()
        self._panel.float(x=_LEGEND_MARGIN, y=-_LEGEND_MARGIN, width=_LEGEND_WIDTH)
        with self._panel.add_tab("Legend"):
            gui.add_html(legend_html(self._layers))


def legend_html(layers: Layers) -> str:
    """A row for each meaning of a color in the layers."""
    shades = (colors.STATIC_COLORS, colors.HEIGHT_COLORS)
    shown = {**vars(colors), "UNKNOWN": UNKNOWN}
    ids = colors.color_by_id([0, 1, 2]).tolist()
    drawn = (layers.default_visibility, layers.heights, shown, colors.KIND_COLORS, ids, shades)
    return render_part("viewer.html.j2", "legend", *drawn)


def _toggle(control: Any, name: str = "value") -> None:
    """Switch a control or a panel on or off."""
    setattr(control, name, not getattr(control, name))
