"""The legend: what the colors of the visible layers mean, and a scale bar, as HTML."""

import html
import math
from collections.abc import Sequence

from stillmap.results.colors import (
    BLUE,
    GREY,
    HEIGHT_COLORS,
    ORANGE,
    STATIC_COLORS,
    TEAL,
    Rgb,
    color_by_id,
)
from stillmap.results.report.figures import UNKNOWN
from stillmap.results.report.place import KIND_COLORS
from stillmap.viewer.layers import HEIGHT, PICTURES, Layers
from stillmap.viewer.shortcuts import KEYS, PLACE_KEYS
from stillmap.viewer.text import TEXT_STYLE

_MAX_BAR = 0.25  # longest scale bar, as a share of the height of the view
_LENGTHS = (1.0, 2.0, 5.0)  # times a power of 10

_SPACE = "padding-top:.4em;padding-bottom:.3em"
_DOT = "border-radius:50%;width:.7em;height:.7em;margin:0 .1em"
_LINE = "width:1.4em;height:.2em"
_AREA = "width:1.4em;height:.8em"
_SQUARE = "width:.8em;height:.8em;margin:0 .05em"
_FRAME = "width:1.1em;height:.6em;margin:0 .05em;border:.13em"
# of the boxes of changes
_BORDERS = {"appeared": "solid", "gone": "dashed", "moved": "solid", "door": "dotted"}
_MEANINGS = {
    "appeared": "appeared",
    "gone": "gone",
    "moved": "moved, dotted where from",
    "door": "door, otherwise than before",
}


def legend_html(layers: Layers, coloring: str, is_2d: bool) -> str:
    """A row for each meaning of a color in the visible layers.

    Args:
        layers: of the scene.
        coloring: what the points are colored by.
        is_2d: whether the map is all that shows what stands still.
    """
    rows = list[str]()
    if layers.is_shown("Map"):
        rows.append(_map_row(is_2d))
    if layers.is_shown("Surface"):
        rows.append(_row(_swatch(_AREA, (150, 150, 150)), "static surface"))
    rows += _point_rows(layers, coloring)
    if layers.is_shown("Robot"):
        rows.append(_row(_swatch(_LINE, BLUE), "trajectory of the robot"))
    if layers.is_shown("Beams"):
        colors = ORANGE, GREY, BLUE
        dots = "".join(_swatch(_DOT, color) for color in colors)
        rows.append(_row(dots, "beams of this scan: dynamic, undecided, static"))
    if layers.is_shown("Rays"):
        rows.append(_row(_swatch(_LINE, TEAL), "rays from the sensor"))
    content = "".join(rows + _object_rows(layers) + _place_rows(layers))
    return f'<div style="{TEXT_STYLE};padding-top:.6em">{content}</div>'


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
        f'<div style="{TEXT_STYLE};{_SPACE}" title="at the center of the view">'
        f'<div style="{bar}"></div>{text}</div>'
    )


def scale_length(longest: float) -> float:
    """The largest of 1, 2, 5 times a power of 10 up to `longest`, both in m."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(power * n for n in _LENGTHS if power * n <= longest * (1.0 + 1e-9))


def help_html(is_place: bool = False) -> str:
    """The line that lists the keys.

    Args:
        is_place: whether there are sessions.
    """
    listed = (*KEYS, *PLACE_KEYS) if is_place else KEYS
    keys = "; ".join(f"<b>{html.escape(key)}</b> {html.escape(what)}" for key, what in listed)
    return f'<div style="{TEXT_STYLE};padding-bottom:.6em">Keys: {keys}.</div>'


def _map_row(is_2d: bool) -> str:
    area = f"{_SQUARE};border:1px solid #999"
    colors = [(0, 0, 0), (255, 255, 255), UNKNOWN][: 3 if is_2d else 2]
    squares = "".join(_swatch(area, color) for color in colors)
    return _row(squares, "map: occupied, free" + (", unknown" if is_2d else ""))


def _point_rows(layers: Layers, coloring: str) -> list[str]:
    rows = list[str]()
    if layers.is_shown("Static points"):
        if coloring == HEIGHT:
            low, high = layers.heights
            rows.append(_row(_ramp(HEIGHT_COLORS), "static points by height z in m"))
            marks = "".join(f"<span>{low + n / 4 * (high - low):.1f}</span>" for n in range(5))
            rows.append(f'<div style="display:flex;justify-content:space-between">{marks}</div>')
        elif coloring == PICTURES:
            rows.append(_row("", "static points in the colors of the pictures"))
        else:
            rows.append(_row(_ramp(STATIC_COLORS), "static points, lighter if higher"))
    if layers.is_shown("Dynamic points") and coloring != PICTURES:
        rows.append(_row(_swatch(_DOT, ORANGE), "dynamic points of all scans"))
    elif layers.is_shown("Dynamic points"):
        rows.append(_row(_swatch(_DOT, ORANGE), "dynamic points likewise, orange without one"))
    return rows


def _object_rows(layers: Layers) -> list[str]:
    colors = [tuple(color) for color in color_by_id([0, 1, 2]).tolist()]
    rows = list[str]()
    if layers.is_shown("Objects"):
        boxes = "".join(_outline(color) for color in colors)
        rows.append(_row(boxes, "moving objects (click on one)"))
    if layers.is_shown("Object tracks"):
        lines = "".join(_swatch(_LINE, color) for color in colors)
        rows.append(_row(lines, "tracks of moving objects"))
    return rows


def _place_rows(layers: Layers) -> list[str]:
    rows = list[str]()
    if layers.is_shown("Sessions"):
        lines = "".join(_swatch(_LINE, color) for color in color_by_id([0, 1, 2]).tolist())
        rows.append(_row(lines, "trajectories of the sessions"))
    if layers.is_shown("Changes"):
        rows += [
            _row(_outline(color, _BORDERS[kind]), f"{kind[0].upper()}: {_MEANINGS[kind]}")
            for kind, color in KIND_COLORS.items()
        ]
        squares = "".join(_swatch(_SQUARE, KIND_COLORS[kind]) for kind in ("appeared", "gone"))
        rows.append(_row(squares, "on the map: came, left since the session before"))
    return rows


def _row(swatch: str, text: str) -> str:
    return (
        '<div style="display:flex;align-items:center;gap:.5em">'
        f'<span style="display:flex;align-items:center;flex:none">{swatch}</span>'
        f"<span>{html.escape(text)}</span></div>"
    )


def _swatch(shape: str, color: Sequence[int]) -> str:
    return f'<span style="display:block;{shape};background:rgb{tuple(color)}"></span>'


def _outline(color: Sequence[int], border: str = "solid") -> str:
    return f'<span style="display:block;{_FRAME} {border} rgb{tuple(color)}"></span>'


def _ramp(colors: Sequence[Rgb]) -> str:
    stops = ",".join(f"rgb{color}" for color in colors)
    shape = "width:4em;height:.8em"
    return f'<span style="display:block;{shape};background:linear-gradient(90deg,{stops})"></span>'
