"""Pose errors in crowds: of M-steps that know what is static, and of M-steps that do not.

python benchmarks/crowds.py [--worlds corridor hall-8m] [--people 0 10 20 40 80]
    [--logs NAME.clf.gz ...] [--seeds tuning|reporting] [--n-seeds 5] [--iterations 3]
    [--true-labels] [--set section.key=value ...] [--processes 2]

"e" is stillmap's loop: what the E-step before found weighs every beam in registration and in the
verification of loops. "prior" takes as many M-steps, robust kernel and loops included, but all hits
weigh the same in all of them. --true-labels adds M-steps that are told. The poses are those of the
last M-step. Relations are as in poses.py; those of a log lie beside it, see peers.py.
"""

import argparse
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cases import TRAJECTORY, Case, few_walls
from common import add_arguments, add_seed_arguments, make_parser, options_of, outcomes, seeds_of
from numpy.typing import NDArray
from pairs import known_relations, name_of, timed_poses
from poses import ABSOLUTE, RELATIONS, pose_scores
from tables import Column, Row, grouped, markdown

import stillmap
from stillmap import em, slam
from stillmap.results.eval.trajectory import compute_relation_errors
from stillmap.sim import simulate

Float = NDArray[np.float64]
Weights = NDArray[np.float32]

WORLDS: Mapping[str, tuple[str, Callable[[int], dict[str, Any]]]] = {
    "corridor": ("corridor", lambda people: {"crowd": {"people": people}}),
    "hall-8m": ("hall", few_walls),
}
PEOPLE = (0, 10, 20, 40, 80)
WEIGHTS = ("e", "prior", "true labels")
COLUMNS = (Column("dynamic", "hits on people, %", ".1f"), *RELATIONS, *ABSOLUTE)


@dataclass(frozen=True)
class Job:
    """A world with a crowd, or a recorded log, with every kind of weights.

    Attributes:
        place: of WORLDS, or what the log is called.
        log: its file; then people and seed mean nothing.
    """

    place: str
    weights: tuple[str, ...]
    iterations: int
    settings: tuple[str, ...]
    people: int = 0
    seed: int = 0
    log: Path | None = None


def main() -> None:
    p = make_parser(__doc__)
    add_arguments(p, [])
    add_seed_arguments(p)
    p.add_argument("--worlds", nargs="*", choices=WORLDS, default=list(WORLDS))
    p.add_argument("--people", nargs="+", type=int, default=list(PEOPLE))
    p.add_argument("--logs", nargs="+", type=Path, default=[])
    p.add_argument("--iterations", type=int, default=3, help="M-steps")
    p.add_argument("--true-labels", action="store_true", help="also with the truth as weights")
    args = p.parse_args()
    done = sorted(
        outcomes(rows_of, jobs_of(args), args.processes), key=lambda pair: _order(pair[0])
    )
    rows = [row for _, rows in done for row in rows]
    print(table(rows))


def jobs_of(args: argparse.Namespace) -> list[Job]:
    weights = WEIGHTS if args.true_labels else WEIGHTS[:2]
    what = (weights, args.iterations, tuple(args.set))
    options_of("stillmap", args.set)  # refuses before hours have passed
    worlds = itertools.product(args.worlds, args.people, seeds_of(args))
    return [
        *(Job(world, *what, people, seed) for world, people, seed in worlds),
        *(Job(name_of(log), (*weights[:2],), *what[1:], log=log) for log in args.logs),
    ]


def _order(job: Job) -> tuple[bool, str, int, int]:
    return job.log is not None, job.place, job.people, job.seed


def rows_of(job: Job) -> list[Row]:
    """A row of scores for every kind of weights."""
    options = options_of("stillmap", [f"em.max_iterations={job.iterations}", *job.settings])
    about = {"place": job.place, "people": job.people, "seed": job.seed}
    if job.log is not None:
        recording, static = stillmap.read(job.log, options.read), None
        scores = _log_scores(recording, job.log)
    else:
        scene, changes = WORLDS[job.place]
        sim = simulate(Case(job.place, TRAJECTORY, scene, changes(job.people)).build(), job.seed)
        recording, truth = sim.recording, sim.truth.T_world_base
        static = sim.truth.static.astype(np.float32)
        about["dynamic"] = 100 * float(np.mean(static[recording.hit] == 0))

        def scores(poses: Float) -> Row:
            return pose_scores(recording.stamp_ns, poses, truth)

    return [
        {**about, "weights": weights, **scores(poses_by(weights, recording, options, static))}
        for weights in job.weights
    ]


def _log_scores(recording: stillmap.Recording, log: Path) -> Callable[[Float], Row]:
    relations = known_relations(log, recording.stamp_ns)

    def scores(poses: Float) -> Row:
        errors = compute_relation_errors(timed_poses(recording.stamp_ns, poses), relations)
        t, r = errors.translation, errors.rotation
        means = {"translation": t.mean, "rotation": r.mean}
        return {**means, "translation_max": t.max, "rotation_max": r.max}

    return scores


def poses_by(
    weights: str,
    recording: stillmap.Recording,
    options: stillmap.Options,
    static: Weights | None,
) -> Float:
    """Poses (T, 3, 3) of the last M-step with these weights; static (M,) are the true labels."""
    if weights == "e":
        *_, last = stillmap.iterate(recording, options)
        return last.estimate.poses
    if weights == "true labels" and static is not None:
        return poses_with(recording, options, static)
    prior = em.initial_p_static(recording, options.estimator, options.em)
    return poses_with(recording, options, prior)


def poses_with(recording: stillmap.Recording, options: stillmap.Options, e: Weights) -> Float:
    """Poses (T, 3, 3) of the last M-step of `stillmap.iterate` if every E-step found e (M,)."""
    start: slam.MStepResult | None = None
    for number in range(1, options.em.max_iterations + 1):
        mapped = slam.m_step(
            recording, e, options.slam, None, options.threads, _silent, initial=start
        )
        start = mapped.without_grid() if number > 1 else None
    return mapped.poses


def _silent(_what: str, _done: int, _total: int) -> None:
    """Discards progress."""


def table(rows: Sequence[Row]) -> str:
    """A line per place, crowd and weights: means over seeds, in brackets the worst."""
    lines = [
        [place, "-" if "dynamic" not in some[0] else str(people), weights]
        + [column.mean_and_worst(some) for column in COLUMNS]
        for (place, people, weights), some in grouped(
            rows, lambda row: (row["place"], row["people"], row["weights"])
        ).items()
    ]
    return markdown(["place", "people", "weights", *(c.title for c in COLUMNS)], lines)


if __name__ == "__main__":
    main()
