"""Pose errors in crowds: of M-steps that know what is static, and of M-steps that do not.

python benchmarks/crowds.py [--worlds corridor hall-8m] [--people 0 10 20 40 80]
    [--seeds tuning|reporting] [--n-seeds 5] [--set section.key=value ...] [--processes 2]

"e" is stillmap's loop: what the E-step before found weighs every beam in registration and in the
verification of loops. "prior" takes as many M-steps, robust kernel and loops included, but all hits
weigh the same in all of them. The poses are those of the last M-step. Relations are as in poses.py.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from cases import TRAJECTORY, Case, few_walls
from common import (
    add_arguments,
    add_seed_arguments,
    make_parser,
    options_of,
    outcomes_in_order,
    seeds_of,
)
from numpy.typing import NDArray
from poses import ABSOLUTE, RELATIONS, pose_scores
from tables import Column, Row, grouped, markdown

import stillmap
from stillmap import em, slam
from stillmap.sim import simulate

Float = NDArray[np.float64]
Weights = NDArray[np.float32]

WORLDS: Mapping[str, tuple[str, Callable[[int], dict[str, Any]]]] = {
    "corridor": ("corridor", lambda people: {"crowd": {"people": people}}),
    "hall-8m": ("hall", few_walls),
}
PEOPLE = (0, 10, 20, 40, 80)
WEIGHTS = ("e", "prior")
M_STEPS = 3
COLUMNS = (Column("dynamic", "hits on people, %", ".1f"), *RELATIONS, *ABSOLUTE)


@dataclass(frozen=True)
class Job:
    """A world with a crowd, with every kind of weights."""

    world: str
    people: int
    seed: int
    settings: tuple[str, ...]


def main() -> None:
    p = make_parser(__doc__)
    add_arguments(p, [])
    add_seed_arguments(p)
    p.add_argument("--worlds", nargs="*", choices=WORLDS, default=list(WORLDS))
    p.add_argument("--people", nargs="+", type=int, default=list(PEOPLE))
    args = p.parse_args()
    options_of("stillmap", args.set)  # refuses before hours have passed
    jobs = [
        Job(world, people, seed, tuple(args.set))
        for world, people, seed in itertools.product(args.worlds, args.people, seeds_of(args))
    ]
    done = outcomes_in_order(rows_of, jobs, args.processes)
    print(table([row for _, rows in done for row in rows]))


def rows_of(job: Job) -> list[Row]:
    """A row of scores for every kind of weights."""
    options = options_of("stillmap", [f"em.max_iterations={M_STEPS}", *job.settings])
    scene, changes = WORLDS[job.world]
    sim = simulate(Case(job.world, TRAJECTORY, scene, changes(job.people)).build(), job.seed)
    recording, truth = sim.recording, sim.truth.T_world_base
    dynamic = 100 * float(np.mean(~sim.truth.static[recording.hit]))
    about = {"world": job.world, "people": job.people, "seed": job.seed, "dynamic": dynamic}
    rows = []
    for weights in WEIGHTS:
        if weights == "e":
            *_, last = stillmap.iterate(recording, options)
            poses = last.estimate.poses
        else:
            prior = em.initial_p_static(recording, options.estimator, options.em)
            poses = poses_with(recording, options, prior)
        scores = pose_scores(recording.stamp_ns, poses, truth)
        rows.append({**about, "weights": weights, **scores})
    return rows


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
    """A line per world, crowd and weights: means over seeds, in brackets the worst."""
    lines = [
        [world, str(people), weights, *(column.mean_and_worst(some) for column in COLUMNS)]
        for (world, people, weights), some in grouped(
            rows, lambda row: (row["world"], row["people"], row["weights"])
        ).items()
    ]
    return markdown(["world", "people", "weights", *(c.title for c in COLUMNS)], lines)


if __name__ == "__main__":
    main()
