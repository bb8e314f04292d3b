"""The keys of layers and actions, and the legend, as HTML."""

import html
from collections.abc import Iterable, Sequence

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
from stillmap.results.viewer.layers import DYNAMIC, STATIC, Layers
from stillmap.results.viewer.nodes import TEXT_STYLE

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
_ARROWS = {"arrowleft": "←", "arrowright": "→", "pageup": "Page ↑", "pagedown": "Page ↓"}

# styles of a swatch; its color follows
_DOT = "border-radius:50%;width:.7em;height:.7em;margin:0 .1em;background:"
_LINE = "width:1.4em;height:.2em;background:"
_AREA = "width:.8em;height:.8em;margin:0 .05em;outline:1px solid #999;background:"
_FRAME = "width:1.1em;height:.6em;margin:0 .05em;border:.13em solid "
_RAMP = "width:4em;height:.8em;background:linear-gradient(90deg,"
_IDS = color_by_id([0, 1, 2]).tolist()


# meaning of colors in a layer: style of a swatch for each color, and words
_ROWS: list[tuple[str, str, Sequence[Sequence[int]], str]] = [
    ("Map", _AREA, [(0, 0, 0), (255, 255, 255), UNKNOWN], "map: occupied, free, unknown"),
    ("Surface", _LINE, [(150, 150, 150)], "static surface"),
    (DYNAMIC, _DOT, [ORANGE], "dynamic points"),
    ("Robot", _LINE, [BLUE], "trajectory of the robot"),
    ("Beams", _DOT, [ORANGE, GREY, BLUE], "beams of this scan: dynamic, undecided, static"),
    ("Rays", _LINE, [TEAL], "rays from the sensor"),
    ("Objects", _FRAME, _IDS, "moving objects (click on one)"),
    ("Object tracks", _LINE, _IDS, "tracks of moving objects"),
    ("Sessions", _LINE, _IDS, "trajectories of the sessions"),
    ("Changes", _FRAME, [KIND_COLORS["appeared"]], "A: appeared"),
    ("Changes", _FRAME, [KIND_COLORS["gone"]], "G: gone"),
    ("Changes", _FRAME, [KIND_COLORS["moved"]], "M: moved, from where the arrow begins"),
    ("Changes", _FRAME, [KIND_COLORS["door"]], "D: door swung"),
    (
        "Changes",
        _AREA,
        [KIND_COLORS["appeared"], KIND_COLORS["gone"]],
        "on the map: came, left since the session before",
    ),
]


def legend_html(layers: Layers) -> str:
    """A row for each meaning of a color in the layers."""
    low, high = layers.heights
    static: list[tuple[Sequence[Rgb], str]] = [
        (STATIC_COLORS, "static points, lighter if higher"),
        (HEIGHT_COLORS, f"static points by height z, {low:.1f} m to {high:.1f} m"),
    ]
    rows = [
        _row([_RAMP + ",".join(f"rgb{color}" for color in stops) + ")"], words)
        for stops, words in static
        if STATIC in layers.clouds
    ]
    rows += [
        _row([f"{style}rgb{tuple(color)}" for color in colors], meaning)
        for layer, style, colors, meaning in _ROWS
        if layer in layers.default_visibility
    ]
    return f'<div style="{TEXT_STYLE};padding-top:.6em">{"".join(rows)}</div>'


def _row(swatches: Sequence[str], words: str) -> str:
    shown = "".join(f'<span style="display:block;{style}"></span>' for style in swatches)
    return (
        '<div style="display:flex;align-items:center;gap:.5em">'
        f'<span style="display:flex;align-items:center;flex:none">{shown}</span>'
        f"<span>{html.escape(words)}</span></div>"
    )


def help_html(actions: Iterable[str]) -> str:
    """The line that lists the keys of actions; those of layers stand beside their boxes."""
    keys = {action: key for action, key in ACTION_KEYS.items() if action in actions}
    listed = [
        f"<b>{_ARROWS.get(key, key.capitalize())}</b> {action.lower()}"
        for action, key in keys.items()
    ]
    listed += ["<b>W A S D Q E, ↑ ↓</b> move the camera", "<b>Ctrl K</b> all commands"]
    return f'<div style="{TEXT_STYLE};padding-bottom:.6em">Keys: {"; ".join(listed)}.</div>'
