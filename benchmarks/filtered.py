"""What other mappers gain from a recording without what moved: before and after `stillmap filter`.

python benchmarks/filtered.py [--cases NAME|GROUP ...] [--seeds tuning|reporting] [--n-seeds 5]
    [--karto-python PYTHON] [--set section.key=value ...] [--processes 2]

Each world is mapped by stillmap, its dynamic beams are blanked, and both recordings are given to
Karto (see karto.py) and to `stillmap map --estimator hit-ratio`. The map counts: a cell is occupied
where a tenth of the beams that reach it end in it, at the poses that were found; Karto's map is
counted like that at Karto's poses. Relations are those of poses.py, ghosts and walls of worlds.py.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import karto
import numpy as np
from cases import Case, chosen
from common import (
    Scores,
    add_arguments,
    add_seed_arguments,
    make_parser,
    options_of,
    outcomes_in_order,
    seeds_of,
)
from numpy.typing import NDArray
from poses import pose_scores
from prepared import Prepared, grid_of, prepare
from tables import Column, Row, grouped, markdown

import stillmap
from stillmap.results.eval.map import score_map
from stillmap.results.eval.trajectory import align

COLUMNS = (
    Column("translation", "relations, m: mean", ".4f"),
    Column("translation_max", "largest", ".3f"),
    Column("ate", "ATE, m", ".3f"),
    Column("ghosts", "ghosts per 100 m2", ".2f"),
    Column("walls", "walls kept", ".4f", True),
)
_COUNTING = "hit-ratio-0.1"


@dataclass(frozen=True)
class Job:
    """One simulated run."""

    case: Case
    seed: int
    python: str | None
    settings: tuple[str, ...]


def main() -> None:
    p = make_parser(__doc__)
    add_arguments(p, [])
    add_seed_arguments(p)
    p.add_argument("--cases", nargs="+", default=["corridor-40", "hall-60"])
    p.add_argument("--karto-python", metavar="PYTHON", help="an interpreter that has yag-slam")
    args = p.parse_args()
    options_of("stillmap", args.set)  # refuses before hours have passed
    what = (args.karto_python, tuple(args.set))
    jobs = [Job(case, seed, *what) for case in chosen(args.cases) for seed in seeds_of(args)]
    done = outcomes_in_order(_rows, jobs, args.processes)
    print("Means over seeds, in brackets the worst.\n")
    print(table([row for _, rows in done for row in rows]))


def table(rows: list[Row]) -> str:
    """A row for every world, method and recording."""
    lines = [
        [*key, *(column.mean_and_worst(some) for column in COLUMNS)]
        for key, some in grouped(
            rows, lambda row: (str(row["case"]), str(row["method"]), str(row["given"]))
        ).items()
    ]
    return markdown(["world", "method", "recording", *(c.title for c in COLUMNS)], lines)


def _rows(job: Job) -> list[Row]:
    run = prepare(job.case, job.seed)
    recording = run.simulation.recording
    cleaned = stillmap.build(recording, options_of("stillmap", job.settings))
    given = {"raw": recording, "filtered": without_dynamic(recording, cleaned.p_static)}
    about = {"case": job.case.name, "seed": job.seed}
    return [
        {**about, "method": method, "given": name, **scores}
        for name, one in given.items()
        for method, scores in _mapped(one, run, job)
    ]


def without_dynamic(
    recording: stillmap.Recording, p_static: NDArray[np.float32]
) -> stillmap.Recording:
    """As `stillmap filter` writes it."""
    return dataclasses.replace(recording, hit=recording.hit & ~(p_static < 0.5))


def _mapped(recording: stillmap.Recording, run: Prepared, job: Job) -> Iterator[tuple[str, Scores]]:
    counting = options_of(_COUNTING, job.settings)
    if job.python is not None:
        poses = karto.mapped(recording, job.python).poses
        yield "Karto", _scores(stillmap.build(recording, counting, poses=poses), run)
    yield "hit ratio", _scores(stillmap.build(recording, counting), run)


def _scores(result: stillmap.Result, run: Prepared) -> Scores:
    truth = run.simulation.truth
    T_world_map = align(result.poses, truth.T_world_base)
    grid = grid_of(result.map)
    on_map = score_map(grid, truth.walls, run.walls_without_people, T_world_map)
    stamps = run.simulation.recording.stamp_ns
    return {
        **pose_scores(stamps, result.poses, truth.T_world_base),
        "ghosts": on_map.ghosts_per_100_m2,
        "walls": on_map.walls_kept,
    }


if __name__ == "__main__":
    main()
