"""The controls of measuring: while it lasts, clicks are ends of distances."""

import math
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np

from stillmap.viewer.layers import Layers
from stillmap.viewer.picking import Ray
from stillmap.viewer.ruler import Ruler, format_length
from stillmap.viewer.server import Server
from stillmap.viewer.text import escape_markdown

_CLICK_RADIUS = 0.01  # of a click on a point, as a share of the height of the view
_MEASURE, _STOP = "Measure", "Stop measuring"


class Measuring:
    """Buttons, distances and clicks.

    Attributes:
        ruler: what was measured.
        active: whether clicks are points.
    """

    def __init__(
        self, server: Server, layers: Layers, ruler: Ruler, events: SimpleQueue[Callable[[], None]]
    ) -> None:
        """Add the controls.

        Args:
            server: the page.
            layers: on which points are.
            ruler: measures.
            events: takes what is to be done, in place of viser's threads.
        """
        self._server, self._layers, self.ruler, self._events = server, layers, ruler, events
        self.active = False
        self._button = server.gui.add_button(_MEASURE)
        self._button.on_click(lambda _event: events.put(self.toggle))
        self._text: Any = server.gui.add_markdown("", visible=False)
        self._clear_button = server.gui.add_button("Clear", visible=False)
        self._clear_button.on_click(lambda _event: events.put(self.clear))

    def toggle(self) -> None:
        """Start or stop measuring; what was measured stays."""
        self.active = not self.active
        if self.active:
            self._server.scene.on_click()(self._click)
        else:
            self._server.scene.remove_click_callback(self._click)
        self._button.label = _STOP if self.active else _MEASURE
        self._show()

    def clear(self) -> None:
        """Remove what was measured."""
        self.ruler.clear()
        self._show()

    def add(self, ray: Ray, tangent: float) -> None:
        """Add the visible point that a ray meets; see `Layers.pick`."""
        if not self.active:
            return
        point = self._layers.pick(ray, tangent)
        if point is not None:
            self.ruler.add(point)
        self._show("" if point is not None else "There is no point there. ")

    def _click(self, event: Any) -> None:
        """Called by viser, in one of its threads."""
        ray = Ray(np.array(event.ray_origin), np.array(event.ray_direction))
        tangent = _CLICK_RADIUS * 2.0 * math.tan(0.5 * float(event.client.camera.fov))
        self._events.put(lambda: self.add(ray, tangent))

    def _show(self, message: str = "") -> None:
        """Show the distances, and what the next click will be."""
        lines = [format_length(length) for length in self.ruler.distances]
        if self.active:
            wanted = ("first", "second")[len(self.ruler.points) % 2]
            lines.append(f"{message}Click on the {wanted} point.")
        self._text.content = "  \n".join(escape_markdown(line) for line in lines)
        self._text.visible = bool(lines)
        self._clear_button.visible = bool(self.ruler.points)
