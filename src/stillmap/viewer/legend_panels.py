"""The panels with legend and scale bar, one for each page that is open."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from stillmap.viewer.legend import scale_html
from stillmap.viewer.server import Server

_MARGIN, _WIDTH = 15, 215  # pixels: to the left and lower border of the page; of a panel


@dataclass
class _Panel:
    """The panel of a page.

    Attributes:
        panel, legend, scale: handles of viser.
        camera_time: when the camera last moved, as viser says it.
    """

    panel: Any
    legend: Any
    scale: Any
    camera_time: float = -1.0


class LegendPanels:
    """Legends and scale bars; the scale depends on the camera, which each page has of its own."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._panels: dict[int, _Panel] = {}
        self._visible = True

    def toggle(self) -> None:
        """Show or hide the panels."""
        self._visible = not self._visible
        for one in self._panels.values():
            one.panel.visible = self._visible

    def update(self, legend: str) -> list[Any]:
        """Follow the cameras, open panels on new pages, forget those of closed ones.

        Args:
            legend: HTML.

        Returns:
            The new pages, clients of viser.
        """
        clients = self._server.get_clients()
        new = [client for number, client in clients.items() if number not in self._panels]
        self._panels = {number: one for number, one in self._panels.items() if number in clients}
        for number, client in clients.items():
            if number not in self._panels:
                self._panels[number] = self._open(client)
            one, camera = self._panels[number], client.camera
            if one.legend.content != legend:
                one.legend.content = legend
            if one.camera_time != camera.update_timestamp:
                one.camera_time = camera.update_timestamp
                distance = float(np.linalg.norm(camera.look_at - camera.position))
                one.scale.content = scale_html(distance, camera.fov)
        return new

    def _open(self, client: Any) -> _Panel:
        panel = client.gui.add_panel(visible=self._visible)
        panel.float(x=_MARGIN, y=-_MARGIN, width=_WIDTH)
        with panel.add_tab("Legend"):
            return _Panel(panel, client.gui.add_html(""), client.gui.add_html(""))
