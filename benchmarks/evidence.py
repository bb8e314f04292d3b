"""Is the map wrong where it rests on thin evidence? In simulated worlds, with `stillmap map`.

python benchmarks/evidence.py [--cases NAME|GROUP ...] [--seeds tuning|reporting] [--n-seeds 5]
    [--true-poses] [--set section.key=value ...] [--processes 2]

A ghost is an occupied cell more than two cells from any wall, as `stillmap eval map` has it. A wall
cell is missed that the same run shows without people and vehicles, if none of its 8 neighbours and
not itself is occupied, while all the same it is known. Lift is the share of the ghosts by the share
of the known cells. Cost is the share of all CPU time of the job.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from common import Run, Scores, options_of, rows_of
from numpy.typing import NDArray
from prepared import Prepared, grid_of, prepare
from scipy.ndimage import binary_dilation
from tables import Row, grouped, markdown

from stillmap.core import se2
from stillmap.core.profiling import StageTimer
from stillmap.eval.map import GHOST_DISTANCE, distance_to_walls
from stillmap.eval.trajectory import align
from stillmap.pipeline.result import MappingResult, map_recording

CASES = ["hall-15", "corridor-40", "office-10", "street-16", "warehouse-12"]
_EDGES = (0, 1, 2, 3, 4, 5, 7, 10, 20, 50)  # of classes of clear looks
_COUNTED = ("known", "occupied", "ghosts", "walls", "missed")

Bool = NDArray[np.bool_]


def main() -> None:
    rows = rows_of(__doc__ or "", CASES, _scored)
    print(f"{by_case(rows)}\n\n{by_looks(rows)}")


def by_case(rows: Sequence[Row]) -> str:
    """How much of each world is thin, and how much of what is wrong lies there."""
    groups = {**grouped(rows, lambda row: row["case"]), "all": rows}
    lines = []
    for name, some in groups.items():
        known, thin, ghosts, caught, missed, found = (
            sum(float(row[key]) for row in some)
            for key in ("known", "thin", "ghosts", "thin ghosts", "missed", "thin missed")
        )
        lift = caught / ghosts / (thin / known) if ghosts and thin else float("nan")
        cost = np.mean([float(row["cost"]) for row in some])
        lines.append(
            [
                str(name),
                f"{100 * thin / known:.2f}",
                f"{caught:.0f} of {ghosts:.0f}",
                f"{lift:.1f}" if np.isfinite(lift) else "-",
                f"{found:.0f} of {missed:.0f}",
                f"{cost:.1f}",
            ]
        )
    return markdown(["case", "thin, %", "ghosts there", "lift", "missed there", "cost, %"], lines)


def by_looks(rows: Sequence[Row]) -> str:
    """How often cells are wrong, by the number of clear looks."""
    lines = []
    for first, end in _classes():
        known, occupied, ghosts, walls, missed = (
            sum(float(row[f"{what} {first}"]) for row in rows) for what in _COUNTED
        )
        lines.append(
            [
                f"{first}" if end == first + 1 else f"{first} and more",
                f"{known:.0f}",
                _share(ghosts, occupied),
                _share(missed, walls),
            ]
        )
    return markdown(["clear looks", "cells", "ghosts of the occupied", "missed of walls"], lines)


def _classes() -> list[tuple[int, int]]:
    return list(pairwise((*_EDGES, 1 << 16)))


def _share(some: float, of: float) -> str:
    return f"{some:.0f} of {of:.0f}, {100 * some / of:.2f} %" if of else "-"


def _scored(run: Run) -> Scores:
    prepared = prepare(run.case, run.seed)
    simulation, stages = prepared.simulation, StageTimer()
    poses = simulation.truth.T_world_base if run.true_poses else None
    options = options_of("stillmap", run.settings)
    result = map_recording(simulation.recording, options, poses=poses, stages=stages)
    spent = {name: float(stage["cpu_seconds"]) for name, stage in stages.to_dict().items()}
    cost = 100.0 * spent["evidence"] / sum(spent.values())
    return {**scores_of(result, prepared), "cost": cost}


def scores_of(result: MappingResult, prepared: Prepared) -> Scores:
    """Numbers of cells: known, thin, wrong, and what of these is thin; the same by clear looks."""
    evidence, ghosts = result.evidence, _ghosts(result, prepared)
    walls, missed = _walls(result, prepared)
    layers = {
        "known": evidence.observations > 0,
        "occupied": grid_of(result.map).occupied,
        "ghosts": ghosts,
        "walls": walls,
        "missed": missed,
    }
    scores = {what: float(np.count_nonzero(layers[what])) for what in _COUNTED}
    scores["thin"] = float(np.count_nonzero(evidence.thinly_observed))
    for what in ("ghosts", "missed"):
        scores[f"thin {what}"] = float(np.count_nonzero(layers[what] & evidence.thinly_observed))
    for first, end in _classes():
        among = (evidence.unobstructed >= first) & (evidence.unobstructed < end)
        for what, cells in layers.items():
            scores[f"{what} {first}"] = float(np.count_nonzero(cells & among))
    return scores


def _ghosts(result: MappingResult, prepared: Prepared) -> Bool:
    grid, truth = grid_of(result.map), prepared.simulation.truth
    T = align(result.poses, truth.T_world_base)
    cells = np.argwhere(grid.occupied)
    centres = grid.centres(cells) @ T[:2, :2].T + T[:2, 2]
    far = distance_to_walls(centres, truth.walls) > GHOST_DISTANCE * grid.resolution
    out = np.zeros(grid.occupied.shape, bool)
    out[tuple(cells[far].T)] = True
    return out


def _walls(result: MappingResult, prepared: Prepared) -> tuple[Bool, Bool]:
    """Known cells that should be wall, and those of them that are missed."""
    grid, truth = grid_of(result.map), prepared.simulation.truth
    T = se2.inverse(align(result.poses, truth.T_world_base))
    cells = grid.cells(prepared.walls_without_people @ T[:2, :2].T + T[:2, 2])
    cells = cells[np.all((cells >= 0) & (cells < grid.occupied.shape), axis=1)]
    walls = np.zeros(grid.occupied.shape, bool)
    walls[tuple(cells.T)] = True
    walls &= ~np.isnan(grid.p_occupied)
    return walls, walls & ~binary_dilation(grid.occupied, np.ones((3, 3), bool))


if __name__ == "__main__":
    main()
