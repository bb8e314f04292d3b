"""Simulated runs through a small room, or among other walls."""

from typing import Any

import numpy as np

from stillmap.core.config import override
from stillmap.sim import Scene, Simulation, simulate
from stillmap.sim.walls import box

ROOM = (*box(0, 0, 9, 7), *box(1.5, 1.6, 0.9, 0.6), *box(-2.6, 1.9, 1.0, 0.4))
ROUTE = ((-2.5, -1.5), (2.5, -1.5), (2.5, 1.5))


def drive(
    seed: Any, walls: Any = ROOM, route: Any = ROUTE, people: int = 0, **sections: Any
) -> Simulation:
    """A run along a route; `sections` change the options of the scene, as laser={...}."""
    scene = Scene("room", walls=tuple(walls), route=tuple(route))
    return simulate(override(scene, {"crowd": {"people": people}, **sections}), seed)


SMALL_ROOM = (*box(0, 0, 8, 6), *box(1.5, 1.5, 0.8, 0.6), *box(-2.0, 1.8, 1.0, 0.4))


def drive_small_room(seed: int, beams: int, scans: int) -> Simulation:
    """A run through a room of 8 x 6 m with two people."""
    laser = {"beams": beams, "range_noise": 0.01, "max_range": 7.0}
    return drive(seed, SMALL_ROOM, people=2, laser=laser, robot={"scans": scans})


def shown(result: Any, cells: Any) -> Any:
    """p_occupied of cells (K, 2) of the map frame."""
    first = np.round(np.array(result.map.origin[:2]) / result.map.resolution).astype(int)
    column, row = (cells - first).T
    return result.map.p_occupied[row, column]
