"""Things that are moved, in simulated worlds: what does the map show, and when did it happen?

python benchmarks/changes.py [--cases NAME|GROUP ...] [--seeds tuning|reporting] [--n-seeds 5]
    [--true-poses] [--set section.key=value ...] [--processes 2]

New cells were hit three times on things that were brought, or moved there, and are still there:
kept if they or a neighbour are occupied. Old cells were hit three times on things that are gone,
lie more than two cells from walls and from what is there at the end, and were seen through again in
three scans: occupied if they are themselves. Of the changes whose place was looked at before and
afterwards, with three beams of a scan, those are found that have a change of their kind within
0.5 m of the thing; "off" is how far its time is from that between the change and the first look
afterwards. Changes where doors swing are true ones and are not counted.
"""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from cases import MOVED
from change_scores import (
    Beams,
    Stay,
    list_true_changes,
    score_change_times,
    score_changes,
    score_things,
)
from common import Run, Scores, options_of, rows_of
from numpy.typing import NDArray
from prepared import grid_of
from tables import Column, means_and_worst

import stillmap
from stillmap.mapping import Change
from stillmap.results.eval.trajectory import align, compute_absolute_errors
from stillmap.results.reader import moved
from stillmap.sim import Simulation, simulate
from stillmap.sim.dynamics import place_faces

_IN_TIME = 2.0  # s
_BESIDE_DOOR = 0.2  # m

COLUMNS = (
    Column("new_cells", "new cells", ".0f"),
    Column("new_kept", "kept", ".3f", True),
    Column("old_cells", "old cells", ".0f"),
    Column("old_occupied", "occupied", ".3f"),
    Column("seen", "changes seen", ".0f"),
    Column("found", "found", ".0f", True),
    Column("missed", "missed", ".0f"),
    Column("false", "false", ".0f"),
    Column("in_time", "within 2 s", ".3f", True),
    Column("largest_error", "off, most s", ".1f"),
    Column("things", "things", ".0f"),
    Column("one_state", "in one state", ".0f", True),
    Column("right", "the true one", ".0f", True),
    Column("ate", "ATE m", ".3f"),
)


def main() -> None:
    rows = rows_of(__doc__ or "", [MOVED], _scored)
    print("Means over seeds, in brackets the worst.\n")
    print(means_and_worst(rows, COLUMNS))


def _scored(run: Run) -> Scores:
    simulation = simulate(run.case.build(), run.seed)
    poses = simulation.truth.T_world_base if run.true_poses else None
    options = options_of("stillmap", run.settings)
    return scores_of(stillmap.build(simulation.recording, options, poses=poses), simulation)


def scores_of(result: stillmap.Result, simulation: Simulation) -> Scores:
    """Scores of the map and the changes of one result."""
    truth, stays, beams = simulation.truth, stays_of(simulation), beams_of(simulation)
    T_world_map = align(result.poses, truth.T_world_base)
    of_map = score_changes(grid_of(result.map), stays, beams, truth.walls, T_world_map)
    majority = result.options.output.map_state == "majority"
    things = score_things(
        grid_of(result.map), stays, beams, truth.walls, T_world_map, majority=majority
    )
    found = _of_things(result.mapping.changes, simulation, T_world_map)
    times = score_change_times(found, list_true_changes(stays, beams), T_world_map)
    off = np.array(times.errors)
    return {
        **asdict(of_map),
        **asdict(things),
        **{name: getattr(times, name) for name in ("seen", "found", "missed", "false")},
        "in_time": float(np.mean(off <= _IN_TIME)) if len(off) else float("nan"),
        "largest_error": float(off.max()) if len(off) else float("nan"),
        "ate": compute_absolute_errors(result.poses, truth.T_world_base).rmse,
    }


def _of_things(
    changes: Sequence[Change], simulation: Simulation, T_world_map: NDArray[np.float64]
) -> list[Change]:
    """Where something came or left, but for the leaves of doors."""
    once = [one for one in changes if one.kind in ("came", "left")]
    at = moved(T_world_map, np.array([(one.x, one.y) for one in once]).reshape(-1, 2))
    swings = np.zeros(len(once), bool)
    for door in simulation.scene.leaves:
        swings |= np.hypot(*(at - np.array(door.hinge)).T) <= door.width + _BESIDE_DOOR
    return [one for one, door in zip(once, swings.tolist(), strict=True) if not door]


def stays_of(simulation: Simulation) -> list[Stay]:
    """The stays of all things. No beam is on those that are walls, or come too late."""
    truth, things = simulation.truth, simulation.scene.things
    begin = int(simulation.recording.stamp_ns[0])
    first = truth.movers.shape[1] - len(things)
    return [
        Stay(
            mover=number,
            center=np.array([stay.x, stay.y]),
            faces=place_faces(thing, stay),
            since_ns=None if stay.since <= 0 else begin + round(1e9 * stay.since),
            until_ns=None if stay.until is None else begin + round(1e9 * stay.until),
        )
        for number, thing in enumerate(things, start=first)
        for stay in thing.stays
    ]


def beams_of(simulation: Simulation) -> Beams:
    """The beams at true poses."""
    recording, truth = simulation.recording, simulation.truth
    scan = np.repeat(np.arange(recording.n_scans), np.diff(recording.offset))
    T = recording.T_map_sensor(truth.T_world_base)
    end = np.einsum("nij,nj->ni", T[scan, :2, :2], recording.points) + T[scan, :2, 2]
    return Beams(T[scan, :2, 2], end, truth.mover, scan, recording.stamp_ns)


if __name__ == "__main__":
    main()
