"""Labels, maps and poses in simulated worlds against the truth.

python benchmarks/worlds.py [--cases NAME|GROUP ...] [--methods stillmap paper ...]
    [--seeds tuning|reporting] [--n-seeds 5] [--true-poses] [--per-iteration]
    [--set section.key=value ...] [--processes 2] [--json ROWS] [--read ROWS ...] [--list]

Scores are those of the result that a user gets; --per-iteration scores every iteration instead.
Walls are those of the same run without people; "in reach" those that it shows with true
labels and true poses. What such a map of counts itself scores is "by true labels".
Figures of offices are also given without the beams on doors.
`--json` appends one row per run to a file as it ends, `--read` prints such files once more.
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
    iteration_scores,
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
    PER_ITERATION,
    Row,
    grouped,
    markdown,
    means_and_worst,
)

import stillmap

# what may get worse from one iteration to the next without meaning anything
_NOISE = {"brier": 2e-4, "log_loss": 2e-3, "f1": 2e-3, "ap": 1e-3}


@dataclass(frozen=True)
class Job:
    """One simulated run, mapped with several methods."""

    case: Case
    seed: int
    methods: tuple[str, ...]
    settings: tuple[str, ...]
    true_poses: bool
    per_iteration: bool


def main() -> None:
    args = _arguments()
    if args.list:
        print(markdown(["case", "group", "scene"], [(c.name, c.group, c.scene) for c in CASES]))
        return
    rows = [json.loads(line) for file in args.read for line in file.read_text().splitlines()]
    if not args.read:
        rows = list(_run(args))
    order = {case.name: k for k, case in enumerate(CASES)}
    rows.sort(key=lambda r: (r["method"], order[r["case"]], r["seed"], r.get("iteration", 0)))
    for method, of_method in grouped(rows, lambda row: row["method"]).items():
        print(f"\n## {method}\n\n{_about(of_method)}\n")
        print(_per_iteration(of_method) if "iteration" in of_method[0] else _results(of_method))


def _arguments() -> argparse.Namespace:
    p = make_parser(__doc__)
    add_arguments(p, ["stillmap"])
    add_seed_arguments(p)
    p.add_argument(
        "--cases", nargs="+", default=[], help="names or groups; default: those for labels"
    )
    p.add_argument("--true-poses", action="store_true")
    p.add_argument("--per-iteration", action="store_true")
    p.add_argument("--json", type=Path, help="append rows to this file, one a line")
    p.add_argument("--read", type=Path, nargs="+", default=[], help="rows to print: runs nothing")
    p.add_argument("--list", action="store_true", help="print the cases and stop")
    return p.parse_args()


def _run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for method in args.methods:
        options_of(method, args.set)  # refuses before hours have passed
    what = (tuple(args.methods), tuple(args.set), args.true_poses, args.per_iteration)
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
        finite({"method": method, **about, **scores})
        for method in job.methods
        for scores in _scores_of(run, job, options_of(method, job.settings))
    ]


def _scores_of(run: Prepared, job: Job, options: stillmap.Options) -> Iterator[dict[str, float]]:
    recording, truth = run.simulation.recording, run.simulation.truth
    poses = truth.T_world_base if job.true_poses else None
    if job.per_iteration:
        for iteration in stillmap.iterate(recording, options, poses=poses):
            yield iteration_scores(iteration, run)
    else:
        yield result_scores(*built(recording, options, poses), run)


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


def _per_iteration(rows: Sequence[Row]) -> str:
    columns = (*LABELS, *MAP, *PER_ITERATION)
    lines = [
        [case, str(iteration), *(column.mean_and_worst(some) for column in columns)]
        for (case, iteration), some in grouped(
            rows, lambda row: (row["case"], row["iteration"])
        ).items()
    ]
    table = markdown(["case", "iteration", *(column.title for column in columns)], lines)
    return f"{table}\n\n{_steps_that_worsen(rows)}"


def _steps_that_worsen(rows: Sequence[Row]) -> str:
    """How often an iteration is worse than the one before, and where most."""
    runs = grouped(rows, lambda row: (row["case"], row["seed"])).items()
    steps = [(run, *pair) for run, some in runs for pair in itertools.pairwise(some)]
    lines = []
    for key, noise in _NOISE.items():
        sign = 1.0 if BY_KEY[key].more_is_better else -1.0
        loss = {
            (*run, after["iteration"]): sign * (before[key] - after[key])
            for run, before, after in steps
            if before[key] is not None and after[key] is not None
        }
        worst = max(loss, key=lambda where: loss[where], default=None)
        worse = sum(step > noise for step in loss.values())
        most = f"{loss[worst]:.4f} in {worst}" if worst else "-"
        lines.append([BY_KEY[key].title, f"{worse} of {len(loss)}", f"{noise:g}", most])
    return markdown(["score", "iterations worse than before", "by more than", "most"], lines)


if __name__ == "__main__":
    main()
