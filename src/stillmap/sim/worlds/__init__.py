"""The worlds by name: data files beside this module. Metres; x to the east, y to the north.

A file draws walls, kerbs and the faces of things from pieces of `walls.py`, one row each:
`["box", x, y, width, height]`. `extends` names a world of which it says only what differs;
`cleared` are rectangles x, y, width, height about a center, without walls of that world.
"""

import dataclasses
import tomllib
from collections.abc import Callable, Mapping
from functools import partial
from importlib import resources
from itertools import chain
from typing import Any, get_type_hints

import msgspec

from stillmap.core.config import override
from stillmap.core.errors import InputError, closest_match
from stillmap.sim.scene import Scene, Segment
from stillmap.sim.walls import PIECES

_EMPTY = "-empty"
_TYPES = get_type_hints(Scene)
_FOLDER = resources.files(__name__)
_WORLDS = sorted(f.name[:-5] for f in _FOLDER.iterdir() if f.name.endswith(".toml"))


def load_world(name: str) -> Scene:
    """The world of a data file."""
    tree = tomllib.loads((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    base, cleared = tree.pop("extends", None), tree.pop("cleared", [])
    sections = {key: tree.pop(key) for key in list(tree) if isinstance(tree[key], dict)}
    for part in (tree, *tree.get("things", [])):
        for key in part.keys() & {"walls", "kerbs", "faces"}:
            pieces = (PIECES[kind](*values) for kind, *values in part[key])
            part[key] = list(chain.from_iterable(pieces))
    values = {key: msgspec.convert(rows, _TYPES[key]) for key, rows in tree.items()}
    values["name"] = name
    scene = Scene(**values) if base is None else dataclasses.replace(load_world(base), **values)
    walls = (wall for wall in scene.walls if not any(_is_within(wall, *area) for area in cleared))
    scene = dataclasses.replace(scene, walls=tuple(walls))
    for section in sections.values():
        section.update({key: None for key, value in section.items() if value == "unset"})
    return override(scene, sections)


def _is_within(wall: Segment, x: float, y: float, width: float, height: float) -> bool:
    ends = (wall[:2], wall[2:])
    return all(abs(u - x) < width / 2 and abs(v - y) < height / 2 for u, v in ends)


def _empty(world: Callable[[], Scene]) -> Scene:
    """The world without people and moving vehicles, its doors open; objects are moved as before."""
    scene = world()
    return dataclasses.replace(
        scene,
        name=f"{scene.name}{_EMPTY}",
        walls=(*scene.walls, *(door.leaf(door.opened) for door in scene.leaves)),
        leaves=(),
        lanes=(),
        crowd=dataclasses.replace(scene.crowd, people=0),
        traffic=dataclasses.replace(scene.traffic, vehicles=0),
    )


SCENES: dict[str, Callable[[], Scene]] = {name: partial(load_world, name) for name in _WORLDS}
SCENES |= {
    f"{name}{_EMPTY}": partial(_empty, world)
    for name, world in SCENES.items()
    if not name.endswith("-crowd")
}


def scene_by_name(name: str, changes: Mapping[str, Any] | None = None) -> Scene:
    """The scene of that name, with `changes` such as `{"laser": {"beams": 360}}` applied.

    Raises:
        InputError: there is no such scene or option, or a value is out of range.
    """
    if name not in SCENES:
        known = f"scenes: {', '.join(SCENES)}"
        meant = closest_match(name, SCENES)
        hint = f"did you mean '{meant}'? {known}" if meant else known
        raise InputError(f"there is no scene '{name}'", hint=hint)
    return override(SCENES[name](), changes or {})
