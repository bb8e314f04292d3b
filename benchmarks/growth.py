"""How time and memory grow with the recording: the whole job on ever longer drives in one world.

python benchmarks/growth.py [--world hall] [--scans 1000 10000 100000] [--seed 0]
    [--set section.key=value ...]

Steps are CPU ms per scan and iteration, of one thread. Every length has a process of its own, which
reads what another one simulated; its memory is that of reading and `stillmap.build`. Errors say
whether it is still a map: they are those of poses.py.
"""

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cases import TRAJECTORY, Case
from common import Scores, options_of, outcomes
from poses import LOOPS, RELATIONS, scores_and_cost, write
from sweep import in_fresh_process
from tables import Column, Row, markdown

import stillmap
from stillmap.core.profiling import peak_memory_bytes
from stillmap.sim import SCENES

COLUMNS = (
    Column("metres", "m driven", ".0f"),
    Column("iterations", "iterations", ".0f"),
    Column("m_step", "M-step, ms", ".3f"),
    Column("e_step", "E-step, ms", ".3f"),
    Column("cpu", "whole job, ms", ".2f"),
    Column("loaded", "peak MB once read", ".0f"),
    Column("peak", "peak MB", ".0f"),
    Column("per_scan", "peak kB per scan", ".1f"),
    RELATIONS[0],
    RELATIONS[1],
    *LOOPS,
)


@dataclass(frozen=True)
class Job:
    """A drive of so many scans."""

    world: str
    scans: int
    seed: int
    settings: tuple[str, ...]


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--world", choices=SCENES, default="hall")
    p.add_argument("--scans", nargs="+", type=int, default=[1_000, 10_000, 100_000])
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    args = p.parse_args()
    options_of("stillmap", args.set)  # refuses before hours have passed
    jobs = [Job(args.world, scans, args.seed, tuple(args.set)) for scans in args.scans]
    rows = [row for _, row in outcomes(row_of, jobs, 1)]
    print(table(rows))


def row_of(job: Job) -> Row:
    case = Case(job.world, TRAJECTORY, job.world, {"robot": {"scans": job.scans}})
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work, "recording")
        in_fresh_process(write, folder, case, job.seed)
        return in_fresh_process(measured, folder, job.settings)


def measured(folder: Path, settings: tuple[str, ...]) -> Scores:
    """Cost and errors of the whole job on a simulated folder."""
    options = options_of("stillmap", settings)
    recording = stillmap.read(folder, options.read)
    loaded = peak_memory_bytes()
    scores = scores_and_cost(recording, options, folder)
    T, peak_kb = recording.n_scans, 1e3 * scores["peak"]
    return {"scans": T, "loaded": loaded / 1e6, "per_scan": peak_kb / T, **scores}


def table(rows: Sequence[Row]) -> str:
    """A line per length."""
    lines = [[str(row["scans"]), *(c.mean_and_worst([row]) for c in COLUMNS)] for row in rows]
    return markdown(["scans", *(column.title for column in COLUMNS)], lines)


if __name__ == "__main__":
    main()
