"""What is static in space: labels of sweeps, time and memory, beside other programs in one run.

python benchmarks/space.py [--worlds street ...] [--lidar 64 ...] [--scans 150]
    [--seeds tuning|reporting] [--n-seeds 1] [--folders DIR ...]
    [--methods stillmap paper ...] [--estimated-poses] [--peer-python PYTHON]
    [--set section.key=value ...] [--threads 2] [--rounds 1] [--json ROWS]

DIR holds `velodyne/*.bin`, `labels/*.label` (252 moving, 9 static, others not scored), `times.txt`
and `poses_lidar.txt`. PYTHON is an interpreter of its own, so that nothing else is touched:
    python3 -m venv peers && peers/bin/pip install dufomap==1.1.1 octomap-python
They are compared with, never needed. All are given the same beams at the same poses, the true ones
or those of the folder, without the motion during sweeps; --estimated-poses has stillmap once more
find its own. Others are given what is at least 2.5 m away, scored is what is nearer than 50 m.
SA, DA and HA are percentages: of the static beams called static, of the dynamic ones called
dynamic, and the harmonic mean. Recall by kind is in percent, too. Dynamic beams "met at rest only"
are of things that stood still from the first beam on them to the last.

Each method has a process of its own, one after the other, in an order that turns from round to
round; seconds are the medians of the rounds. "labels" are seconds until every beam has its label,
"job" those of the whole result without writing it.
"""

import argparse
import json
import shutil
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import Scores, add_seed_arguments, finite, in_fresh_process, make_parser, seeds_of
from space_cases import WORLDS, Case, prepare, simulated
from space_methods import CERTAIN, ESTIMATED, OURS, PEERS, of_ours, of_peer
from space_scores import scores_of
from tables import Column, Row, grouped, markdown

from stillmap.core import config

_COST = ("seconds", "label_seconds", "cpu", "peak", "label_peak")
LABELS = (
    Column("sa", "SA", ".2f", True),
    Column("da", "DA", ".2f", True),
    Column("ha", "HA", ".2f", True),
    Column("ha_without", "HA without doors", ".2f", True),
    Column("rested", "dynamic met at rest only, %", ".2f"),
    Column("ha_moved", "HA of the rest", ".2f", True),
    Column("ap", "AP", ".4f", True),
    Column("brier", "Brier", ".4f"),
    Column("ece", "ECE", ".4f"),
    Column("ece_unsure", "ECE unsure", ".3f"),
    Column("log_loss", "log loss", ".4f"),
)
COST = (
    Column("label_seconds", "labels, s per sweep", ".3f"),
    Column("seconds", "job, s per sweep", ".3f"),
    Column("cpu", "CPU s per sweep", ".3f"),
    Column("label_peak", "labels, peak MB", ".0f"),
    Column("peak", "job, peak MB", ".0f"),
    Column("iterations", "iterations", ".1f"),
)


def main() -> None:
    args = _arguments()
    print(tables(list(_run(args))))


def _arguments() -> argparse.Namespace:
    p = make_parser(__doc__)
    p.add_argument("--worlds", nargs="*", default=["street"], metavar="WORLD", help=f"{WORLDS}")
    p.add_argument("--lidar", nargs="+", type=int, default=[64], metavar="CHANNELS")
    p.add_argument("--columns", type=int, default=1875, help="azimuths per turn")
    p.add_argument("--scans", type=int, default=150, help="of a simulated run")
    add_seed_arguments(p)
    p.set_defaults(n_seeds=1)
    p.add_argument("--folders", nargs="+", type=Path, default=[], metavar="DIR")
    p.add_argument("--methods", nargs="+", choices=[*OURS, *PEERS], metavar="METHOD")
    p.add_argument("--estimated-poses", action="store_true")
    p.add_argument("--peer-python", metavar="PYTHON")
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--rounds", type=int, default=1)
    p.add_argument("--keep", type=Path, metavar="DIR", help="keep cases and labels there")
    p.add_argument("--json", type=Path, help="append rows to this file, one a line")
    return p.parse_args()


def _run(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for text in args.set:
        config.parse_assignment(text)  # refuses before hours have passed
    methods = chosen_methods(args.methods, args.peer_python is not None, args.estimated_poses)
    lidar = {"columns": args.columns}
    cases = simulated(args.worlds, args.lidar, seeds_of(args), args.scans, lidar)
    cases += [Case(path.name, None, 0, path) for path in args.folders]
    for case in cases:
        with tempfile.TemporaryDirectory() as scratch:
            work = Path(args.keep or scratch, f"{case.name}, {case.seed}".replace(", ", "-"))
            if work.exists():
                shutil.rmtree(work)
            about = {"case": case.name, "seed": case.seed, "set": args.set}
            about |= in_fresh_process(prepare, case, work)
            for row in rows_of(work, methods, args):
                row = finite({**about, **row})
                if args.json:
                    with args.json.open("a") as file:
                        file.write(json.dumps(row) + "\n")
                yield row


def chosen_methods(named: list[str] | None, has_peers: bool, estimated: bool) -> list[str]:
    """Those named, or all that there are.

    Raises:
        SystemExit: one that is named needs another Python.
    """
    methods = named or [*OURS, *(PEERS if has_peers else [])]
    if not has_peers and (lacking := [name for name in methods if name in PEERS]):
        raise SystemExit(f"{', '.join(lacking)}: no --peer-python")
    return [*methods, ESTIMATED] if estimated else methods


def rows_of(work: Path, methods: Sequence[str], args: argparse.Namespace) -> list[dict[str, Any]]:
    """What each method says and takes."""
    costs: dict[str, list[Scores]] = {method: [] for method in methods}
    for method in in_turns(methods, args.rounds):
        out = work / f"{method}.npy".replace(", ", "-").replace(" ", "-")
        if method in PEERS:
            cost = of_peer(work, method, args.peer_python, args.threads, out)
        else:
            cost = in_fresh_process(of_ours, work, method, tuple(args.set), args.threads, out)
        costs[method].append({**cost, "labels": str(out)})
    rows = []
    for method, of_rounds in costs.items():
        scored = in_fresh_process(scores_of, work, of_rounds[0]["labels"], method in CERTAIN)
        rows.append({"method": method, **scored, **typical(of_rounds)})
    return rows


def in_turns(methods: Sequence[str], rounds: int) -> Iterator[str]:
    """Every method once in each round, each round beginning with another one."""
    for k in range(rounds):
        first = k % len(methods)
        yield from (*methods[first:], *methods[:first])


def typical(costs: Sequence[Scores]) -> Scores:
    """Medians of what rounds cost; the rest is the same in all."""
    medians = {key: statistics.median(cost[key] for cost in costs) for key in _COST}
    return {**{key: v for key, v in costs[0].items() if key != "labels"}, **medians}


def tables(rows: Sequence[Row]) -> str:
    """Labels, recall of what moves, and cost: means over seeds, in brackets the worst."""
    kinds = dict.fromkeys(key for row in rows for key in row if key.startswith("recall_"))
    recall = [Column(key, key.removeprefix("recall_"), ".1f", True) for key in kinds]
    seeds = sorted({row["seed"] for row in rows})
    settings = sorted({s for row in rows for s in row["set"]})
    about = f"Seeds {seeds}; settings: {', '.join(settings) or 'defaults'}."
    sizes = [
        [case, *(f"{np.mean([row[key] for row in some]):.0f}" for key in _SIZES)]
        for case, some in grouped(rows, lambda row: row["case"]).items()
    ]
    parts = [about, markdown(["case", *_SIZES.values()], sizes)]
    parts += [_table(rows, columns) for columns in (LABELS, recall, COST)]
    return "\n\n".join(parts)


_SIZES = {
    "sweeps": "sweeps",
    "beams": "beams",
    "n_static": "scored: static",
    "n_dynamic": "dynamic",
}


def _table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    columns = [column for column in columns if column.values(rows)]
    lines = [
        [case, method, *(column.mean_and_worst(some) for column in columns)]
        for (case, method), some in grouped(rows, lambda r: (r["case"], r["method"])).items()
    ]
    return markdown(["case", "method", *(column.title for column in columns)], lines)


if __name__ == "__main__":
    main()
