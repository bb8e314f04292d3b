"""Labels, maps and poses in simulated worlds against the truth.

python benchmarks/worlds.py [--cases NAME|GROUP ...] [--methods stillmap paper ...]
    [--seeds tuning|reporting] [--n-seeds 5] [--true-poses]
    [--set section.key=value ...] [--processes 2] [--json ROWS]

Scores are those of the result that a user gets.
Walls are those of the same run without people; "in reach" those that it shows with true
labels and true poses. What such a map of counts itself scores is "by true labels".
Figures of offices are also given without the beams on doors.
`--json` appends one row per run to a file as it ends.
"""

import argparse
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cases import CASES, Case, chosen
from common import (
    add_arguments,
    add_seed_arguments,
    built,
    finite,
    make_parser,
    options_of,
    outcomes,
    result_scores,
    seeds_of,
)
from prepared import Prepared, prepare
from tables import (
    BY_KEY,
    COST,
    LABELS,
    MAP,
    MOVERS,
    Row,
    grouped,
    means_and_worst,
)

import stillmap


@dataclass(frozen=True)
class Job:
    """One simulated run, mapped with several methods."""

    case: Case
    seed: int
    methods: tuple[str, ...]
    settings: tuple[str, ...]
    true_poses: bool


def main() -> None:
    args = _arguments()
    rows = list(_run(args))
    order = {case.name: k for k, case in enumerate(CASES)}
    rows.sort(key=lambda r: (r["method"], order[r["case"]], r["seed"]))
    for method, of_method in grouped(rows, lambda row: row["method"]).items():
        print(f"\n## {method}\n\n{_about(of_method)}\n")
        print(_results(of_method))


def _arguments() -> argparse.Namespace:
    p = make_parser(__doc__)
    add_arguments(p, ["stillmap"])
    add_seed_arguments(p)
    p.add_argument(
        "--cases", nargs="+", default=[], help="names or groups; default: those for labels"
    )
    p.add_argument("--true-poses", action="store_true")
    p.add_argument("--json", type=Path, help="append rows to this file, one a line")
    return p.parse_args()


def _run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for method in args.methods:
        options_of(method, args.set)  # refuses before hours have passed
    what = (tuple(args.methods), tuple(args.set), args.true_poses)
    pairs = itertools.product(seeds_of(args), chosen(args.cases))
    jobs = [Job(case, seed, *what) for seed, case in pairs]
    for _, rows in outcomes(_rows_of, jobs, args.processes):
        if args.json:
            with args.json.open("a") as file:
                file.writelines(json.dumps(row) + "\n" for row in rows)
        yield from rows


def _rows_of(job: Job) -> list[dict[str, Any]]:
    run = prepare(job.case, job.seed)
    about = {"case": job.case.name, "group": job.case.group, "seed": job.seed}
    about |= {"set": list(job.settings), "true_poses": job.true_poses}
    return [
        finite({"method": method, **about, **_scored(run, job, options_of(method, job.settings))})
        for method in job.methods
    ]


def _scored(run: Prepared, job: Job, options: stillmap.Options) -> dict[str, float]:
    poses = run.simulation.truth.T_world_base if job.true_poses else None
    return result_scores(*built(run.simulation.recording, options, poses), run)


def _about(rows: Sequence[Row]) -> str:
    settings = {s for row in rows for s in row["set"]}
    poses = "true poses" if rows[0]["true_poses"] else "poses estimated from odometry and scans"
    seeds = sorted({row["seed"] for row in rows})
    return f"Seeds {seeds}, {poses}; settings: {', '.join(sorted(settings)) or 'defaults'}."


def _results(rows: Sequence[Row]) -> str:
    parts = ["Means over seeds, in brackets the worst."]
    for group, of_group in grouped(rows, lambda row: row["group"]).items():
        parts += [f"### {group}", means_and_worst(of_group, LABELS)]
        if BY_KEY["recall_doors"].values(of_group) or BY_KEY["recall_vehicles"].values(of_group):
            parts.append(means_and_worst(of_group, MOVERS))
        parts.append(means_and_worst(of_group, (*MAP, *COST)))
    return "\n\n".join(parts)


if __name__ == "__main__":
    main()
