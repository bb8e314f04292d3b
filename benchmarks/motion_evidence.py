"""Labels, map and objects with and without motion evidence, of the same estimate.

python benchmarks/motion_evidence.py [--cases NAME|GROUP ...] [--seeds tuning|reporting]
    [--n-seeds 1] [--processes 2]

Each case is mapped once, its final labels are made twice. F1 without the beams on doors; ghosts per
100 m2 of free space.
"""

import argparse
import itertools
from dataclasses import dataclass
from typing import Any
from unittest import mock

from cases import Case, chosen
from common import add_seed_arguments, options_of, outcomes, result_scores, seeds_of
from prepared import prepare
from tables import markdown

import stillmap
from stillmap.pipeline import result as pipeline_result

_KEYS = ("f1_no_doors", "ap", "brier", "ghosts", "walls")
_DIGITS = (4, 4, 5, 2, 4)


@dataclass(frozen=True)
class Job:
    """One simulated run."""

    case: Case
    seed: int


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_seed_arguments(p)
    p.add_argument("--cases", nargs="+", default=[], help="names or groups")
    p.add_argument("--processes", type=int, default=2)
    args = p.parse_args()
    jobs = [Job(case, seed) for seed, case in itertools.product(seeds_of(args), chosen(args.cases))]
    done = {
        (job.case.name, job.seed): found for job, found in outcomes(_compare, jobs, args.processes)
    }
    lines = []
    for job in jobs:
        cells = [
            [f"{scores[key]:.{n}f}" for scores in done[job.case.name, job.seed]]
            for key, n in zip((*_KEYS, "changes", "objects"), (*_DIGITS, 0, 0), strict=True)
        ]
        lines.append([job.case.name, str(job.seed), *(" -> ".join(pair) for pair in cells)])
    titles = ["case", "seed", "F1", "AP", "Brier", "ghosts", "walls", "changes", "objects"]
    print(markdown(titles, lines))


def _compare(job: Job) -> list[dict[str, Any]]:
    """The scores without and with motion evidence."""
    run, found = prepare(job.case, job.seed), []
    finish = pipeline_result._finish

    def finish_twice(*args: Any) -> Any:
        skip = mock.patch(
            "stillmap.pipeline.final_map._add_motion_evidence",
            lambda deskewed, best, courses, threads: (best, None),  # noqa: ARG005
        )
        with skip:
            found.append(finish(*args))
        found.append(finish(*args))
        return found[-1]

    with mock.patch.object(pipeline_result, "_finish", finish_twice):
        stillmap.build(run.simulation.recording, options_of("stillmap", ()))
    return [
        result_scores(one, 0.0, run) | {"changes": len(one.changes), "objects": len(one.objects)}
        for one in found
    ]


if __name__ == "__main__":
    main()
