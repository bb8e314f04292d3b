"""The legend, the scale bar and the keys as HTML, and their panels, one for each open page."""

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stillmap.results.colors import (
    BLUE,
    GREY,
    HEIGHT_COLORS,
    KIND_COLORS,
    ORANGE,
    STATIC_COLORS,
    TEAL,
    Rgb,
    color_by_id,
)
from stillmap.results.report.figures import UNKNOWN
from stillmap.results.viewer.layers import HEIGHT, PICTURES, Layers
from stillmap.results.viewer.nodes import TEXT_STYLE
from stillmap.results.viewer.server import Server

# W, A, S, D, Q, E and the vertical arrows move viser's camera
LAYER_KEYS = {
    "Map": "1",
    "Surface": "2",
    "Static points": "3",
    "Dynamic points": "4",
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
_KEYS = (
    "<b>Space</b> play or pause; <b>← →</b> one scan; <b>Home End</b> first, last scan; "
    "<b>1 to 0, N</b> layers; <b>M</b> measure; <b>Esc</b> clear; <b>V</b> default view; "
    "<b>L</b> legend; <b>W A S D Q E, ↑ ↓</b> move the camera; <b>Ctrl K</b> all commands"
)
_PLACE_KEYS = (
    "; <b>Page ↑ Page ↓</b> one session; "
    "<b>T, C, B</b> trajectories of sessions, changes, their labels"
)

_MAX_BAR = 0.25  # longest scale bar, as a share of the height of the view
_MARGIN, _WIDTH = 15, 215  # pixels: to the left and lower border of the page; of a panel
_DOT = "border-radius:50%;width:.7em;height:.7em;margin:0 .1em"
_LINE = "width:1.4em;height:.2em"
_SQUARE = "width:.8em;height:.8em;margin:0 .05em"
_FRAME = "width:1.1em;height:.6em;margin:0 .05em;border:.13em"
# borders of the boxes of changes, and what they mean
_CHANGES = {
    "appeared": ("solid", "A: appeared"),
    "gone": ("dashed", "G: gone"),
    "moved": ("solid", "M: moved, dotted where from"),
    "door": ("dotted", "D: door swung"),
}


def legend_html(layers: Layers, coloring: str, is_2d: bool) -> str:
    """A row for each meaning of a color in the visible layers.

    Args:
        layers: of the scene.
        coloring: what the points are colored by.
        is_2d: whether the map is all that shows static structure.
    """
    ids, area = color_by_id([0, 1, 2]).tolist(), f"{_SQUARE};border:1px solid #999"
    cells = [(0, 0, 0), (255, 255, 255), UNKNOWN][: 3 if is_2d else 2]
    dynamic = "likewise, orange without one" if coloring == PICTURES else "of all scans"
    rows = {
        "Map": [_row(area, cells, "map: occupied, free" + ", unknown" * is_2d)],
        "Surface": [_row("width:1.4em;height:.8em", [(150, 150, 150)], "static surface")],
        "Static points": _static_rows(layers, coloring),
        "Dynamic points": [_row(_DOT, [ORANGE], f"dynamic points {dynamic}")],
        "Robot": [_row(_LINE, [BLUE], "trajectory of the robot")],
        "Beams": [
            _row(_DOT, [ORANGE, GREY, BLUE], "beams of this scan: dynamic, undecided, static")
        ],
        "Rays": [_row(_LINE, [TEAL], "rays from the sensor")],
        "Objects": [_row(f"{_FRAME} solid", ids, "moving objects (click on one)", is_frame=True)],
        "Object tracks": [_row(_LINE, ids, "tracks of moving objects")],
        "Sessions": [_row(_LINE, ids, "trajectories of the sessions")],
        "Changes": _change_rows(),
    }
    content = "".join(row for name, of in rows.items() if layers.is_shown(name) for row in of)
    return f'<div style="{TEXT_STYLE};padding-top:.6em">{content}</div>'


def _static_rows(layers: Layers, coloring: str) -> list[str]:
    if coloring == PICTURES:
        return [_text_row("", "static points in the colors of the pictures")]
    if coloring != HEIGHT:
        return [_text_row(_ramp(STATIC_COLORS), "static points, lighter if higher")]
    low, high = layers.heights
    marks = "".join(f"<span>{low + n / 4 * (high - low):.1f}</span>" for n in range(5))
    return [
        _text_row(_ramp(HEIGHT_COLORS), "static points by height z in m"),
        f'<div style="display:flex;justify-content:space-between">{marks}</div>',
    ]


def _change_rows() -> list[str]:
    rows = [
        _row(f"{_FRAME} {border}", [KIND_COLORS[kind]], text, is_frame=True)
        for kind, (border, text) in _CHANGES.items()
    ]
    colors = [KIND_COLORS["appeared"], KIND_COLORS["gone"]]
    return [*rows, _row(_SQUARE, colors, "on the map: came, left since the session before")]


def _row(shape: str, colors: Sequence[Sequence[int]], text: str, is_frame: bool = False) -> str:
    swatches = (
        f'<span style="display:block;{shape}{" " if is_frame else ";background:"}'
        f'rgb{tuple(color)}"></span>'
        for color in colors
    )
    return _text_row("".join(swatches), text)


def _text_row(swatch: str, text: str) -> str:
    return (
        '<div style="display:flex;align-items:center;gap:.5em">'
        f'<span style="display:flex;align-items:center;flex:none">{swatch}</span>'
        f"<span>{html.escape(text)}</span></div>"
    )


def _ramp(colors: Sequence[Rgb]) -> str:
    stops = ",".join(f"rgb{color}" for color in colors)
    shape = "width:4em;height:.8em"
    return f'<span style="display:block;{shape};background:linear-gradient(90deg,{stops})"></span>'


def scale_html(distance: float, field_of_view: float) -> str:
    """A scale bar that is right at the center of the view.

    Args:
        distance: from the camera to the center of the view, in m.
        field_of_view: vertical, in rad.
    """
    height = 2.0 * distance * math.tan(0.5 * field_of_view)
    length = scale_length(_MAX_BAR * height)
    bar = f"width:{100.0 * length / height:.3f}vh;height:.5em;border:2px solid;border-top:0"
    text = f"{length:g} m" if length >= 1.0 else f"{100.0 * length:g} cm"
    return (
        f'<div style="{TEXT_STYLE};padding-top:.4em;padding-bottom:.3em" '
        f'title="at the center of the view"><div style="{bar}"></div>{text}</div>'
    )


def scale_length(longest: float) -> float:
    """The largest of 1, 2, 5 times a power of 10 up to `longest`, both in m."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(power * n for n in (1.0, 2.0, 5.0) if power * n <= longest * (1.0 + 1e-9))


def help_html(is_place: bool = False) -> str:
    """The line that lists the keys."""
    keys = _KEYS + _PLACE_KEYS * is_place
    return f'<div style="{TEXT_STYLE};padding-bottom:.6em">Keys: {keys}.</div>'


@dataclass
class _Panel:
    """The panel of a page: handles of viser, and when its camera last moved."""

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
        self._panels = {
            number: self._panels.get(number) or self._open(client)
            for number, client in clients.items()
        }
        for number, client in clients.items():
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
