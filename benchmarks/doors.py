"""Doors that swing, in simulated worlds: which are found, where, and when were they open?

python benchmarks/doors.py [--cases NAME|GROUP ...] [--seeds tuning|reporting] [--n-seeds 5]
    [--true-poses] [--set section.key=value ...] [--processes 2]

A door counts as seen if 40 beams ended on its leaf while it was shut and 40 while it was open, or
on its way. It is found if a change of kind `door` has its hinge within 0.3 m of it; every other one
is false. State: share of the time in the states of found doors in which the leaf was where it is
said to be. Seen once: doors listed with one position, and those of them that are not at a door of
the world, by either end; passed: the same of those whose shut leaf beams passed. Ghosts: cells per
100 m2, all of them, and those farther than one cell from the leaf of a listed door.
"""

import itertools
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
from cases import chosen
from common import Run, Scores, options_of, rows_of
from numpy.typing import NDArray
from prepared import grid_of
from tables import Column, means_and_worst

import stillmap
from stillmap import mapping
from stillmap.core.square_box import cell_keys
from stillmap.mapping.doors import Door
from stillmap.results.eval.map import GHOST_DISTANCE, distance_to_walls
from stillmap.results.eval.trajectory import align
from stillmap.results.reader import moved
from stillmap.sim import Simulation, simulate

_MIN_BEAMS = 40
_NEAR = 0.3  # m between hinges
_SHUT = 0.1  # rad
_CASES = ("office-10", "office-stops", "office-moved", "hall-15", "corridor-40", "warehouse-12")

COLUMNS = (
    Column("doors", "doors", ".0f"),
    Column("seen", "seen in both states", ".0f"),
    Column("found", "found", ".0f", True),
    Column("false", "false", ".0f"),
    Column("hinge", "hinge off, m", ".2f"),
    Column("states", "states right", ".3f", True),
    Column("once", "seen once", ".0f"),
    Column("once_false", "false", ".0f"),
    Column("passed", "passed", ".0f"),
    Column("passed_false", "false", ".0f"),
    Column("ghosts", "ghosts", ".1f"),
    Column("besides", "besides doors", ".1f"),
    Column("cost", "cost, %", ".1f"),
)


def main() -> None:
    rows = rows_of(__doc__ or "", _CASES, _scored)
    print("Means over seeds, in brackets the worst.\n")
    print(means_and_worst(rows, COLUMNS))


def _scored(run: Run) -> Scores:
    (case,) = chosen([run.case.name])
    simulation = simulate(case.build(), run.seed)
    poses = simulation.truth.T_world_base if run.true_poses else None
    seconds = 0.0

    def timed(find: Callable[..., Any]) -> Callable[..., Any]:
        def found(*args: object) -> Any:
            nonlocal seconds
            begun = time.process_time()
            out = find(*args)
            seconds += time.process_time() - begun
            return out

        return found

    begun = time.process_time()
    with (
        mock.patch.object(mapping, "find_doors", timed(mapping.find_doors)),
        mock.patch.object(mapping, "find_lone_doors", timed(mapping.find_lone_doors)),
    ):
        result = stillmap.build(
            simulation.recording, options_of("stillmap", run.settings), poses=poses
        )
    whole = time.process_time() - begun
    return {**scores_of(result, simulation), "cost": 100.0 * seconds / (whole - seconds)}


def scores_of(result: stillmap.Result, simulation: Simulation) -> Scores:
    """Scores of the doors of one result."""
    doors = [one.door for one in result.mapping.changes if one.door is not None]
    leaves = simulation.scene.leaves
    T_world_map = align(result.poses, simulation.truth.T_world_base)
    hinges = moved(T_world_map, np.array([one.hinge for one in doors]).reshape(-1, 2))
    off = np.hypot(
        *(hinges[:, None] - np.array([one.hinge for one in leaves]).reshape(1, -1, 2)).T
    ).T
    pairs = [(k, int(row.argmin())) for k, row in enumerate(off) if row.min(initial=9.0) < _NEAR]
    right = [_state_is_right(doors[k], leaf, simulation) for k, leaf in pairs]
    looked = sum(len(one) for one in right)
    once = [one for one in result.doors if len(one.states) == 1]
    passed = [one for one in result.doors if len(one.states) > 1 and not len(one.open_cells)]
    listed = {
        name: [_is_at_leaf(one, simulation, T_world_map) for one in some]
        for name, some in (("once", once), ("passed", passed))
    }
    return {
        **{name: len(is_leaf) for name, is_leaf in listed.items()},
        **{f"{name}_false": len(is_leaf) - sum(is_leaf) for name, is_leaf in listed.items()},
        **_count_ghosts(result, simulation, T_world_map),
        "doors": len(leaves),
        "seen": sum(_is_seen(k, simulation) for k in range(len(leaves))),
        "found": len({leaf for _, leaf in pairs}),
        "false": len(doors) - len({leaf for _, leaf in pairs}),
        "hinge": float(np.mean([off[pair] for pair in pairs])) if pairs else float("nan"),
        "states": sum(int(one.sum()) for one in right) / looked if looked else float("nan"),
    }


def _is_at_leaf(door: Door, simulation: Simulation, T_world_map: NDArray[np.float64]) -> bool:
    """Whether either end of the doorway of a door is near a hinge of the world."""
    along = door.length * np.array([np.cos(door.shut), np.sin(door.shut)])
    ends = moved(T_world_map, np.array([door.hinge, door.hinge + along]))
    hinges = np.array([one.hinge for one in simulation.scene.leaves]).reshape(-1, 2)
    off = np.linalg.norm(ends[:, None] - hinges, axis=2)
    return bool(off.min(initial=9.0) < _NEAR)


def _count_ghosts(
    result: stillmap.Result, simulation: Simulation, T_world_map: NDArray[np.float64]
) -> Scores:
    """Ghosts per 100 m2 of free space: all, and those that no door of the result explains."""
    grid, truth = grid_of(result.map), simulation.truth
    occupied = np.argwhere(grid.occupied)
    off = distance_to_walls(moved(T_world_map, grid.centres(occupied)), truth.walls)
    ghosts = occupied[off > GHOST_DISTANCE * grid.resolution][:, ::-1]
    ghosts = ghosts + result.map.window.first_cell
    leaves = [np.concatenate([one.shut_cells, one.open_cells]) for one in result.doors]
    around = [cells + step for cells in leaves for step in itertools.product((-1, 0, 1), repeat=2)]
    keys = cell_keys(np.concatenate([np.empty((0, 2), np.int64), *around]))
    besides = np.count_nonzero(~np.isin(cell_keys(ghosts), keys))
    area = 1e-2 * float(np.count_nonzero(grid.free)) * grid.resolution**2
    return {"ghosts": len(ghosts) / area, "besides": besides / area}


def _turned(leaf: int, simulation: Simulation) -> NDArray[np.float64]:
    """(T,) rad between a leaf and its shut position."""
    truth = simulation.truth
    angle = truth.movers[:, truth.scene["mover_kinds"].index("door") + leaf, 2]
    off = angle - simulation.scene.leaves[leaf].closed
    return np.asarray(np.abs(np.angle(np.exp(1j * off))))


def _is_seen(leaf: int, simulation: Simulation) -> bool:
    truth, recording = simulation.truth, simulation.recording
    number = truth.scene["mover_kinds"].index("door") + leaf
    scan = recording.scans_of(np.flatnonzero((truth.mover == number) & recording.hit))
    shut = _turned(leaf, simulation)[scan] < _SHUT
    return min(np.count_nonzero(shut), np.count_nonzero(~shut)) >= _MIN_BEAMS


def _state_is_right(door: Door, leaf: int, simulation: Simulation) -> NDArray[np.bool_]:
    """Of every scan in a state: whether it is so."""
    stamp_ns, shut = simulation.recording.stamp_ns, _turned(leaf, simulation) < _SHUT
    out = [
        shut[(stamp_ns >= one.since_ns) & (stamp_ns <= one.until_ns)] == (one.position == "shut")
        for one in door.states
    ]
    return np.concatenate(out)


if __name__ == "__main__":
    main()
