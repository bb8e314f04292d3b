"""The page of a result: its controls, and what happens when they are used."""

import time
from collections.abc import Callable
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.results.viewer.beams import Beams
from stillmap.results.viewer.layers import Layers
from stillmap.results.viewer.legend import (
    ACTION_KEYS,
    LAYER_KEYS,
    LegendPanels,
    help_html,
    legend_html,
)
from stillmap.results.viewer.measuring import Measuring
from stillmap.results.viewer.nodes import (
    FIELD_OF_VIEW,
    MIN_ASPECT,
    Nodes,
    default_view,
    escape_markdown,
    table_html,
)
from stillmap.results.viewer.objects import ObjectNodes, describe_object
from stillmap.results.viewer.scene import Scene
from stillmap.results.viewer.server import start_server, stop_server
from stillmap.results.viewer.sessions import SessionControls, SessionNodes

_FRAME_TIME = 0.1  # s between updates while playing
_IDLE_TIME = 0.05  # s between polls of the controls
_SPEEDS = {"1 x": 1.0, "3 x": 3.0, "10 x": 10.0, "30 x": 30.0, "100 x": 100.0}


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
        self._scans = range(len(scene.stamp_ns))  # of a place, those of the session that is shown
        self._seconds = self._measure_seconds()
        self.scan, self._at, self._playing, self._ticked = 0, 0.0, False, time.monotonic()
        self._events: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._server = start_server(port, f"{scene.name} - stillmap")
        try:
            camera = self._server.initial_camera
            camera.fov, camera.far, camera.near = FIELD_OF_VIEW, self._view.far, self._view.near
            camera.position, camera.look_at = self._view.position, self._view.look_at
            nodes = Nodes(self._server, scene, self._view.height)
            self._objects = ObjectNodes(nodes, self._click_object)
            place, self._sessions = scene.place, None
            if place is not None:
                self._sessions = SessionNodes(nodes, place)
            self._layers = Layers(nodes, beams, self._objects, self._sessions)
            self._legends = LegendPanels(self._server)
            self._add_controls(nodes)
            for action, act in self._actions().items():
                is_layer = action in LAYER_KEYS
                label = f"Show or hide: {action.lower()}" if is_layer else action
                key: Any = (LAYER_KEYS | ACTION_KEYS)[action]
                self._server.gui.add_command(label, hotkey=key).on_trigger(act)
            self.show(0)
            if place is not None:
                self.show_session(len(place) - 1)
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
            self._layers.update(self._scans[scan])
            self._show_facts()

    def show_session(self, session: int) -> None:
        """Show a session of a place from its first scan."""
        place, nodes, controls = self._scene.place, self._sessions, self._session_controls
        if place is None or nodes is None or controls is None:
            return
        nodes.session, self._scans = session, place.scans_of(session)
        self._seconds = self._measure_seconds()
        last = len(self._scans) - 1
        with self._server.atomic():
            self._slider.max, self._slider.disabled = max(last, 1), not last
            self._button.disabled = not last
            self._layers.show_session(session)
            controls.show()
            self._at = 0.0
            self.show(0)

    def _measure_seconds(self) -> NDArray[np.float64]:
        """When each scan was taken, since the first one."""
        stamps = self._scene.stamp_ns[self._scans.start : self._scans.stop]
        return np.asarray(1e-9 * (stamps - stamps[0]))

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
        self._handle_events()
        now = time.monotonic()
        passed, self._ticked = now - self._ticked, now
        controls = self._session_controls
        if controls and self._sessions and controls.wanted != self._sessions.session:
            self.show_session(controls.wanted)
        # a page may still name a scan of a longer session
        wanted = min(int(self._slider.value), len(self._scans) - 1)
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
        legend = legend_html(self._layers, self._coloring.value, self._scene.is_2d)
        for client in self._legends.update(legend):
            if client.camera.aspect < MIN_ASPECT:  # on a phone
                self._set_camera(client)

    def _advance(self, passed: float) -> int:
        """The scan after `passed` s of playback; the first one after the last."""
        self._at += passed * _SPEEDS[self._speed.value]
        if self._at > self._seconds[-1]:
            self._at = 0.0
        return int(np.searchsorted(self._seconds, self._at, side="right")) - 1

    def _handle_events(self) -> None:
        while True:
            try:
                event = self._events.get_nowait()
            except Empty:
                return
            event()

    def _defer(self, act: Callable[[], None]) -> Callable[..., None]:
        """A callback for viser that lets `step` act."""
        return lambda *_event: self._events.put(act)

    def _actions(self) -> dict[str, Callable[..., None]]:
        """The actions of keys, by name of the action or layer."""
        last = len(self._seconds) - 1
        actions: dict[str, Callable[[], None]] = {
            "Play or pause": lambda: self.play(not self._playing),
            # not from `scan`: keys may be pressed faster than scans are shown
            "Next scan": lambda: self._go_to(int(self._slider.value) + 1),
            "Previous scan": lambda: self._go_to(int(self._slider.value) - 1),
            "First scan": lambda: self._go_to(0),
            "Last scan": lambda: self._go_to(last),
            "Measure": self._measuring.toggle,
            "Clear": self._clear,
            "Default view": self._reset_cameras,
            "Legend": self._legends.toggle,
        }
        controls = self._session_controls
        if controls is not None:
            actions["Next session"] = lambda: controls.go_to(controls.wanted + 1)
            actions["Previous session"] = lambda: controls.go_to(controls.wanted - 1)
        for name, box in self._boxes.items():
            actions[name] = partial(_toggle, box)
        return {name: self._defer(act) for name, act in actions.items()}

    def _go_to(self, scan: int) -> None:
        """Pause at the scan that is nearest to an index."""
        self.play(False)
        self._slider.value = min(max(scan, 0), len(self._seconds) - 1)

    def _reset_cameras(self) -> None:
        for client in self._server.get_clients().values():
            self._set_camera(client)

    def _set_camera(self, client: Any) -> None:
        """Show a page the default view."""
        with client.atomic():
            client.camera.up_direction = np.array([0.0, 0.0, 1.0])
            client.camera.position = self._view.position_for(client.camera.aspect)
            client.camera.look_at = self._view.look_at

    def _click_object(self, number: int) -> None:
        """Called by viser."""
        self._events.put(lambda: self._select(number))

    def _select(self, number: int | None) -> None:
        """Show the facts of an object; None: of none."""
        if not self._measuring.active:
            self._objects.selected = number
            self.show(self.scan)

    def _show_facts(self) -> None:
        found = [one for one in self._scene.tracks if one.id == self._objects.selected]
        self._facts_folder.visible = bool(found)
        for track in found:
            now, start = (int(self._scene.stamp_ns[self._scans[n]]) for n in (self.scan, 0))
            self._facts_folder.label = f"Object {track.id}"
            self._facts.content = table_html(describe_object(track, now, start))

    def _clear(self) -> None:
        """Stop measuring, remove what was measured and selected."""
        if self._measuring.active:
            self._measuring.toggle()
        self._measuring.clear()
        self._select(None)

    def _add_controls(self, nodes: Nodes) -> None:
        gui, last, scene = self._server.gui, len(self._seconds) - 1, self._scene
        gui.set_panel_label("stillmap")
        gui.main_panel.dock_right()  # beside the scene, not over it
        name, folder = escape_markdown(scene.name), escape_markdown(scene.folder)
        gui.add_markdown(f"**{name}**" if name == folder else f"**{name}**, result {folder}")
        self._session_controls: SessionControls | None = None
        if scene.place is not None and self._sessions is not None:
            self._session_controls = SessionControls(gui, scene.place, self._sessions)
        # Any: viser's types do not allow setting values
        self._slider: Any = gui.add_slider("Scan", 0, max(last, 1), 1, 0, disabled=not last)
        self._clock: Any = gui.add_text("Time", "", disabled=True)
        self._speed = gui.add_dropdown("Speed", tuple(_SPEEDS))
        self._button = gui.add_button("Play", disabled=not last)
        self._button.on_click(self._defer(lambda: self.play(not self._playing)))
        self._measuring = Measuring(nodes, self._layers.pick, self._events)
        self._facts_folder: Any = gui.add_folder("Object", visible=False)
        with self._facts_folder:
            self._facts: Any = gui.add_html("")
            gui.add_button("Close").on_click(self._defer(lambda: self._select(None)))
        self._add_layer_controls()
        for note in scene.notes:
            gui.add_markdown(escape_markdown(note))
        gui.add_html(help_html(is_place=scene.place is not None))

    def _add_layer_controls(self) -> None:
        gui, visible = self._server.gui, self._layers.default_visibility
        with gui.add_folder("Show"):
            self._boxes: dict[str, Any] = {
                name: gui.add_checkbox(f"{LAYER_KEYS[name]} {name}", shown)
                for name, shown in visible.items()
            }
            colorings = self._layers.colorings
            self._coloring = gui.add_dropdown("Points by", colorings, visible=len(colorings) > 1)
            self._coloring.on_update(
                self._defer(lambda: self._layers.color_points(self._coloring.value))
            )
            self._size = gui.add_slider("Point size", 0.5, 5.0, 0.5, 1.0)
        self._notes = {
            name: gui.add_markdown(escape_markdown(note), visible=visible[name])
            for name, note in self._layers.notes.items()
        }


def _toggle(box: Any) -> None:
    box.value = not box.value
