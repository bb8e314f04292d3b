"""The worlds by name. Metres; x to the east, y to the north."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from stillmap.errors import InputError
from stillmap.options import replaced
from stillmap.simulation.scene import Scene
from stillmap.simulation.worlds.corridor import corridor
from stillmap.simulation.worlds.drive import drive
from stillmap.simulation.worlds.hall import hall
from stillmap.simulation.worlds.office import office
from stillmap.simulation.worlds.street import street
from stillmap.simulation.worlds.street_turn import street_turn
from stillmap.simulation.worlds.warehouse import warehouse

_WORLDS: dict[str, Callable[[], Scene]] = {
    "hall": hall,
    "corridor": corridor,
    "office": office,
    "warehouse": warehouse,
    "street": street,
    "street-turn": street_turn,
    "drive": drive,
}


def _crowded(scene: Scene, people: int) -> Scene:
    crowd = dataclasses.replace(scene.crowd, people=people)
    return dataclasses.replace(scene, name=f"{scene.name}-crowd", crowd=crowd)


def _empty(world: Callable[[], Scene]) -> Callable[[], Scene]:
    """The world with nobody in it, all doors open for good, and no vehicles but the parked ones."""

    def build() -> Scene:
        scene = world()
        return dataclasses.replace(
            scene,
            name=f"{scene.name}-empty",
            walls=(*scene.walls, *(door.leaf(door.opened) for door in scene.leaves)),
            leaves=(),
            lanes=(),
            crowd=dataclasses.replace(scene.crowd, people=0),
            traffic=dataclasses.replace(scene.traffic, vehicles=0),
        )

    return build


SCENES: dict[str, Callable[[], Scene]] = {
    **_WORLDS,
    "hall-crowd": lambda: _crowded(hall(), 60),
    "corridor-crowd": lambda: _crowded(corridor(), 40),
    **{f"{name}-empty": _empty(world) for name, world in _WORLDS.items()},
}


def scene_by_name(name: str, changes: Mapping[str, Any] | None = None) -> Scene:
    """The scene of that name, with `changes` such as `{"laser": {"beams": 360}}` applied.

    Raises:
        InputError: there is no such scene or option, or a value is out of range.
    """
    if name not in SCENES:
        raise InputError(f"there is no scene '{name}'", hint=f"scenes: {', '.join(SCENES)}")
    return replaced(SCENES[name](), changes or {})
