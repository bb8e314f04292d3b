"""The worlds by name: data files beside this module. Metres; x to the east, y to the north.

A file draws its world from pieces of `walls.py`, one row each: `["box", x, y, width, height]`.
`extends` names a world of which it says only what differs; `lifted` are objects made of walls of
that world.
"""

import dataclasses
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import resources
from typing import Any, get_type_hints

from pydantic import TypeAdapter

from stillmap.core.config import override
from stillmap.core.errors import InputError, closest_match
from stillmap.sim.scene import Scene, Segment, Stay, Thing
from stillmap.sim.walls import PIECES, Opening, leaf

_EMPTY = "-empty"
_TYPES = get_type_hints(Scene)
_FOLDER = resources.files(__name__)
_WORLDS = sorted(f.name[:-5] for f in _FOLDER.iterdir() if f.name.endswith(".toml"))


def load_world(name: str) -> Scene:
    """The world of a data file."""
    tree = tomllib.loads((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    base = tree.pop("extends", None)
    sections = {key: tree.pop(key) for key in list(tree) if isinstance(tree[key], dict)}
    lifted, brought = tree.pop("lifted", []), map(_read_thing, tree.pop("things", []))
    values = {"name": name, **{key: _read(key, rows) for key, rows in tree.items()}}
    scene = Scene(**values) if base is None else dataclasses.replace(load_world(base), **values)
    walls, things = scene.walls, []
    for moved in lifted:
        thing, walls = _lift(walls, **moved)
        things.append(thing)
    scene = dataclasses.replace(scene, walls=walls, things=(*things, *brought))
    for section in sections.values():
        section.update({key: None for key, value in section.items() if value == "unset"})
    return override(scene, sections)


def _draw(rows: list[list[Any]]) -> tuple[Segment, ...]:
    return tuple(segment for kind, *values in rows for segment in PIECES[kind](*values))


def _read(key: str, rows: Any) -> Any:
    """The value of a field of a scene."""
    if key in ("walls", "kerbs"):
        return _draw(rows)
    if key == "leaves":
        doors = ((start, side, Opening(*door), *swing) for start, side, door, *swing in rows)
        return tuple(leaf(*door) for door in doors)
    return TypeAdapter(_TYPES[key]).validate_python(rows)


def _read_thing(row: dict[str, Any]) -> Thing:
    return Thing(_draw(row["faces"]), tuple(Stay(**stay) for stay in row["stays"]))


def _lift(
    walls: Sequence[Segment],
    at: Sequence[float],
    size: Sequence[float],
    until: float,
    then: Sequence[dict[str, Any]] = (),
) -> tuple[Thing, tuple[Segment, ...]]:
    """The walls within a rectangle as an object, and all others.

    Args:
        walls: of the world that it stands in for good.
        at, size: metres, center and size of the rectangle.
        until: seconds, when it is taken away from there.
        then: stays afterwards.
    """
    (x, y), (width, height) = at, size

    def is_within(wall: Segment) -> bool:
        ends = (wall[:2], wall[2:])
        return all(abs(u - x) < width / 2 and abs(v - y) < height / 2 for u, v in ends)

    about = tuple((a - x, b - y, c - x, d - y) for a, b, c, d in filter(is_within, walls))
    stays = (Stay(x, y, until=until), *(Stay(**stay) for stay in then))
    return Thing(about, stays), tuple(wall for wall in walls if not is_within(wall))


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
