"""Keyboard shortcuts, as commands of viser's palette, and the line that lists them."""

from collections.abc import Callable
from typing import Any

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
}
PLACE_LAYER_KEYS = {"Sessions": "T", "Changes": "C", "Change labels": "B"}
_ACTION_KEYS = {
    "Play or pause": "space",
    "Next scan": "arrowright",
    "Previous scan": "arrowleft",
    "First scan": "home",
    "Last scan": "end",
    "Measure": "M",
    "Clear": "escape",
    "Default view": "V",
    "Legend": "L",
}
_PLACE_ACTION_KEYS = {"Next session": "pagedown", "Previous session": "pageup"}
# for the lines that list them
KEYS = (
    ("Space", "play or pause"),
    ("← →", "one scan"),
    ("Home End", "first, last scan"),
    ("1 to 0, N", "layers"),
    ("M", "measure"),
    ("Esc", "clear"),
    ("V", "default view"),
    ("L", "legend"),
    ("W A S D Q E, ↑ ↓", "move the camera"),
    ("Ctrl K", "all commands"),
)
PLACE_KEYS = (
    ("Page ↑ Page ↓", "one session"),
    ("T, C, B", "trajectories of sessions, changes, their labels"),
)


def add_shortcuts(gui: Any, actions: dict[str, Callable[[], None]]) -> None:
    """Register what keys do.

    Args:
        gui: of the server.
        actions: by name of the action or layer; called in a thread of viser.
    """
    acting = _ACTION_KEYS | _PLACE_ACTION_KEYS
    keys = acting | LAYER_KEYS | PLACE_LAYER_KEYS
    for name, act in actions.items():
        label = name if name in acting else f"Show or hide: {name.lower()}"
        command = gui.add_command(label, hotkey=keys[name])
        command.on_trigger(lambda _event, act=act: act())
