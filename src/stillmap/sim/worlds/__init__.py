"""The worlds by name. Metres; x to the east, y to the north."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from stillmap.core.config import override
from stillmap.core.errors import InputError, closest_match
from stillmap.sim.scene import Scene
from stillmap.sim.worlds.drive import drive, street_turn
from stillmap.sim.worlds.gallery import gallery
from stillmap.sim.worlds.indoor import corridor, hall, warehouse, warehouse_moved
from stillmap.sim.worlds.large import building
from stillmap.sim.worlds.loops import rounds, ten_corridors
from stillmap.sim.worlds.office import office, office_moved
from stillmap.sim.worlds.oncoming import street_oncoming
from stillmap.sim.worlds.street import crossing, street, street_jam, street_moved
from stillmap.sim.worlds.wings import lookalike, two_wings

_EMPTY = "-empty"

_WORLDS: dict[str, Callable[[], Scene]] = {
    "hall": hall,
    "corridor": corridor,
    "office": office,
    "warehouse": warehouse,
    "gallery": gallery,
    "street": street,
    "street-turn": street_turn,
    "street-jam": street_jam,
    "street-oncoming": street_oncoming,
    "crossing": crossing,
    "drive": drive,
    "building": building,
    "ten-corridors": ten_corridors,
    "rounds": rounds,
    "lookalike-1": partial(lookalike, 1),
    "lookalike-2": partial(lookalike, 2),
    "two-wings": two_wings,
    "office-moved": office_moved,
    "street-moved": street_moved,
    "warehouse-moved": warehouse_moved,
}


def _with_people(world: Callable[[], Scene], people: int) -> Scene:
    scene = world()
    crowd = dataclasses.replace(scene.crowd, people=people)
    return dataclasses.replace(scene, name=f"{scene.name}-crowd", crowd=crowd)


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


SCENES: dict[str, Callable[[], Scene]] = {
    **_WORLDS,
    "hall-crowd": partial(_with_people, hall, 60),
    "corridor-crowd": partial(_with_people, corridor, 40),
    **{f"{name}{_EMPTY}": partial(_empty, world) for name, world in _WORLDS.items()},
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
    world = SCENES[name]
    if name.removesuffix(_EMPTY) == "building" and type(scans) is int and scans >= 1:
        grown = partial(building, scans)
        world = partial(_empty, grown) if name.endswith(_EMPTY) else grown
    return override(world(), changes or {})
