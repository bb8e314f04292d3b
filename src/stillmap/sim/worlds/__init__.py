"""The worlds by name. Metres; x to the east, y to the north."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from stillmap.core.config import override
from stillmap.core.errors import InputError, closest_match
from stillmap.sim.scene import Scene
from stillmap.sim.worlds.changed import office_moved, street_moved, warehouse_moved
from stillmap.sim.worlds.crossing import crossing, street_turn
from stillmap.sim.worlds.drive import drive
from stillmap.sim.worlds.indoor import corridor, hall, warehouse
from stillmap.sim.worlds.large import building
from stillmap.sim.worlds.loops import rounds, ten_corridors
from stillmap.sim.worlds.office import office
from stillmap.sim.worlds.street import street, street_jam

_EMPTY = "-empty"

_WORLDS: dict[str, Callable[[], Scene]] = {
    "hall": hall,
    "corridor": corridor,
    "office": office,
    "warehouse": warehouse,
    "street": street,
    "street-turn": street_turn,
    "street-jam": street_jam,
    "crossing": crossing,
    "drive": drive,
    "building": building,
    "ten-corridors": ten_corridors,
    "rounds": rounds,
    "office-moved": office_moved,
    "street-moved": street_moved,
    "warehouse-moved": warehouse_moved,
}
_GROWING: dict[str, Callable[[int], Scene]] = {"building": building}  # given the number of scans


def _with_people(scene: Scene, people: int) -> Scene:
    crowd = dataclasses.replace(scene.crowd, people=people)
    return dataclasses.replace(scene, name=f"{scene.name}-crowd", crowd=crowd)


def _empty(scene: Scene) -> Scene:
    """The world without people and moving vehicles, its doors open; objects are moved as before."""
    return dataclasses.replace(
        scene,
        name=f"{scene.name}{_EMPTY}",
        walls=(*scene.walls, *(door.leaf(door.opened) for door in scene.leaves)),
        leaves=(),
        lanes=(),
        crowd=dataclasses.replace(scene.crowd, people=0),
        traffic=dataclasses.replace(scene.traffic, vehicles=0),
    )


def _make_empty(world: Callable[[], Scene]) -> Callable[[], Scene]:
    return lambda: _empty(world())


def _grow(name: str, scans: int) -> Scene | None:
    """The world in a size for this number of scans; None if its size is fixed."""
    grow = _GROWING.get(name.removesuffix(_EMPTY))
    if grow is None or scans < 1:
        return None
    return _empty(grow(scans)) if name.endswith(_EMPTY) else grow(scans)


SCENES: dict[str, Callable[[], Scene]] = {
    **_WORLDS,
    "hall-crowd": lambda: _with_people(hall(), 60),
    "corridor-crowd": lambda: _with_people(corridor(), 40),
    **{f"{name}{_EMPTY}": _make_empty(world) for name, world in _WORLDS.items()},
}


def scene_by_name(name: str, changes: Mapping[str, Any] | None = None) -> Scene:
    """The scene of that name, with `changes` such as `{"laser": {"beams": 360}}` applied.

    A building grows with the number of scans in `changes`.

    Raises:
        InputError: there is no such scene or option, or a value is out of range.
    """
    if name not in SCENES:
        known = f"scenes: {', '.join(SCENES)}"
        meant = closest_match(name, SCENES)
        hint = f"did you mean '{meant}'? {known}" if meant else known
        raise InputError(f"there is no scene '{name}'", hint=hint)
    robot = (changes or {}).get("robot")
    scans = robot.get("scans") if isinstance(robot, Mapping) else None
    scene = _grow(name, scans) if type(scans) is int else None
    return override(scene or SCENES[name](), changes or {})
