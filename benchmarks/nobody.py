"""What is called dynamic in a recording in which nothing moves.

python benchmarks/nobody.py BAG [BAG ...] [--topics TOPIC ...] [--methods stillmap paper ...]
    [--set section.key=value ...]

Without --topics: the topic that is chosen where none is given. Beams are all readings, as a user
counts them, hits those that ended somewhere. Poses are estimated.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import add_arguments, built, make_parser, options_of, outcomes_in_order
from tables import grouped, markdown

from stillmap.io import read
from stillmap.prepare.options import ReadOptions

WANTED = 0.03  # of the beams, at most


@dataclass(frozen=True)
class Job:
    """The scans of one topic, mapped with one method."""

    path: Path
    topic: str | None
    method: str
    settings: tuple[str, ...]


@dataclass(frozen=True)
class Found:
    """What was called dynamic."""

    scans: int
    of_beams: float
    of_hits: float
    changes: int
    objects: int
    cpu_ms: float


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("bags", nargs="+", type=Path)
    p.add_argument("--topics", nargs="+", default=[None])
    add_arguments(p, ["stillmap"])
    args = p.parse_args()
    jobs = [
        Job(*words, tuple(args.set))
        for words in itertools.product(args.bags, args.topics, args.methods)
    ]
    done = outcomes_in_order(found, jobs, args.processes)
    for method, some in grouped(done, lambda pair: pair[0].method).items():
        print(f"\n## {method}\n\n{table(some)}")


def found(job: Job) -> Found:
    """One recording's shares."""
    recording = read(job.path, ReadOptions(topic=job.topic))
    result, cpu_ms = built(recording, options_of(job.method, job.settings))
    dynamic = recording.hit & (result.p_static < 0.5)
    return Found(
        scans=recording.n_scans,
        of_beams=float(np.mean(dynamic)),
        of_hits=float(np.mean(dynamic[recording.hit])),
        changes=len(result.mapping.changes),
        objects=len(result.objects),
        cpu_ms=cpu_ms,
    )


def table(some: list[tuple[Job, Found]]) -> str:
    """A line per recording and topic."""
    lines = [
        [
            job.path.stem,
            job.topic or "as chosen",
            str(f.scans),
            f"{100 * f.of_beams:.2f} %",
            "met" if f.of_beams <= WANTED else "MISSED",
            f"{100 * f.of_hits:.2f} %",
            str(f.changes),
            str(f.objects),
            f"{f.cpu_ms:.2f}",
        ]
        for job, f in some
    ]
    header = ["recording", "topic", "scans", "dynamic, of all beams", f"wanted <= {WANTED:.0%}"]
    return markdown([*header, "of hits", "changes", "objects", "CPU ms per scan"], lines)


if __name__ == "__main__":
    main()
