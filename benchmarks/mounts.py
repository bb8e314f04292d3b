"""Wrong mounts and odometry errors that nobody told: ATE against that of the run that was told.

python benchmarks/mounts.py [--cases NAME|GROUP ...] [--errors NAME ...] [--factors 1 2]
    [--scans 800] [--seeds tuning|reporting] [--n-seeds 5] [--processes 2]

Every world is recorded with one error that the recording does not tell, mapped as it is ("found"),
and once more as one that tells the mount, or whose odometry has no such error ("told"). Factors are
on the noise and errors of the wheels. With the error "none" nothing is wrong: "applied" counts what
was calibrated nevertheless.
"""

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Sequence
from typing import Any
from unittest.mock import patch

import numpy as np
from cases import Case, chosen, scaled_odometry
from common import (
    Scores,
    add_seed_arguments,
    built,
    make_parser,
    options_of,
    outcomes_in_order,
    seeds_of,
)
from tables import Column, Row, grouped, markdown

from stillmap.core.config import merge_nested
from stillmap.pipeline import calibration
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import Simulation, scene_by_name, simulate
from stillmap.slam.mount_calibration import Calibration

CASES = ("hall-15", "office-10", "corridor-20")
NONE = "none"
_X = 0.08  # m, where the simulator's laser sits
# what is so and what is recorded
ERRORS: dict[str, dict[str, dict[str, Any]]] = {
    NONE: {},
    "turned by 180": {"laser": {"yaw": math.pi, "recorded_yaw": 0.0}},
    "upside down": {"laser": {"upside_down": "unknown"}},
    "0.3 m ahead": {"laser": {"x": _X + 0.3, "recorded_x": _X}},
    "0.3 m behind": {"laser": {"x": _X - 0.3, "recorded_x": _X}},
    "0.3 m left": {"laser": {"y": 0.3, "recorded_y": 0.0}},
    "0.3 m right": {"laser": {"y": -0.3, "recorded_y": 0.0}},
    "turned by 10": {"laser": {"yaw": math.radians(10), "recorded_yaw": 0.0}},
    "turned by -10": {"laser": {"yaw": -math.radians(10), "recorded_yaw": 0.0}},
    "200 ms late": {"odometry": {"latency": 0.2}},
    "scale 1.1": {"odometry": {"scale": 1.1}},
    "scale 0.9": {"odometry": {"scale": 0.9}},
    "rotation gain 0.85": {"odometry": {"rotation_gain": 0.85}},
}

COLUMNS = (
    Column("told", "told: ATE, m", ".4f"),
    Column("found", "found", ".4f"),
    Column("ratio", "found / told", ".2f"),
    Column("applied", "applied", ".1f"),
    Column("share", "CPU of the calibration, %", ".1f"),
)


@dataclasses.dataclass(frozen=True)
class Job:
    """One world with one error."""

    case: Case
    error: str
    factor: float
    seed: int
    scans: int


def main() -> None:
    p = make_parser(__doc__)
    add_seed_arguments(p)
    p.add_argument("--cases", nargs="+", default=list(CASES), help="names or groups")
    p.add_argument("--errors", nargs="+", choices=ERRORS, default=list(ERRORS))
    p.add_argument("--factors", nargs="+", type=float, default=[1.0])
    p.add_argument("--scans", type=int, default=800)
    p.add_argument("--processes", type=int, default=2)
    args = p.parse_args()
    jobs = [
        Job(case, error, factor, seed, args.scans)
        for case, error, factor, seed in itertools.product(
            chosen(args.cases), args.errors, args.factors, seeds_of(args)
        )
    ]
    done = outcomes_in_order(row_of, jobs, args.processes)
    print(report([row for _, row in done]))


def row_of(job: Job) -> Row:
    """ATE of the runs of one job."""
    truth = simulated(job.case.name, job.factor, job.seed, job.scans, ERRORS[job.error])
    told = told_ate(job.case.name, job.factor, job.seed, job.scans, json.dumps(told_of(job.error)))
    found, about = mapped(truth, calibrated=True)
    scores = {"told": told, "found": found, "ratio": found / told, **about}
    return {"case": job.case.name, "error": job.error, "factor": job.factor, **scores}


@functools.cache
def told_ate(name: str, factor: float, seed: int, scans: int, told: str) -> float:
    """ATE where the mount is told; of odometry's errors the same run without them."""
    run = simulated(name, factor, seed, scans, json.loads(told))
    return mapped(run, calibrated=False)[0]


def told_of(error: str) -> dict[str, dict[str, Any]]:
    """The same mount, recorded as it is; odometry's own errors cannot be told: without them."""
    changes = ERRORS[error].get("laser", {})
    laser = {k: v for k, v in changes.items() if not k.startswith("recorded")}
    if "upside_down" in laser:
        laser["upside_down"] = "known"
    return {"laser": laser} if laser else {}


def simulated(
    name: str, factor: float, seed: int, scans: int, error: dict[str, dict[str, Any]]
) -> Simulation:
    case = chosen([name])[0]
    robot = {"robot": {"scans": scans}}
    changes = merge_nested(case.changes, scaled_odometry(factor), robot, error)
    return simulate(scene_by_name(case.scene, changes), seed)


def mapped(run: Simulation, *, calibrated: bool) -> tuple[float, Scores]:
    """ATE in m, and what the calibration did."""
    options = options_of("stillmap", ())
    if calibrated:
        made, cpu = built(run.recording, options)
    else:
        with patch.object(calibration, "calibrate_recording", lambda r, _: (r, Calibration(), [])):
            made, cpu = built(run.recording, options)
    found = made.calibration
    named = [one for of in (*found.lasers, found.odometry) for one in of.values()]
    applied = sum(one.significant for one in named) + sum(found.upside_down)
    seconds = made.stages["calibration"]["cpu_seconds"]
    share = 100.0 * seconds / (1e-3 * cpu * run.recording.n_scans)
    ate = compute_absolute_errors(made.poses, run.truth.T_world_base).rmse
    return ate, {"applied": float(applied), "share": share}


def report(rows: Sequence[Row]) -> str:
    """By case and error, and by error over all."""

    def table(names: tuple[str, ...]) -> str:
        lines = [
            [*map(str, which), *(column.mean_and_worst(some) for column in COLUMNS)]
            for which, some in grouped(rows, lambda row: tuple(row[n] for n in names)).items()
        ]
        return markdown([*names, *(column.title for column in COLUMNS)], lines)

    over = float(np.mean([row["ratio"] > 1.5 for row in rows]))
    return "\n\n".join(
        [
            "Means over seeds, in brackets the worst.",
            table(("case", "factor", "error")),
            table(("error",)),
            f"{len(rows)} runs, {100 * over:.1f} % above 1.5 times the ATE of the told run",
        ]
    )


if __name__ == "__main__":
    main()
