"""stillmap and Karto on the same recordings, one after the other, in one run.

python benchmarks/peers.py LOG ... --karto-python PYTHON [--rounds 1] [--keep DIR]
    [-- FLAGS FOR stillmap map]

LOG is NAME.clf.gz with NAME.relations or NAME.pseudo.relations beside it, or a folder written by
`stillmap simulate`. Both have their defaults: `stillmap map` with one thread, Karto as karto.py
says. Relations are those with a pose within 0.1 s at both ends.

CPU is the median of the rounds, in each of which every method works on every recording. "poses" is
that of all M-steps, and what Karto takes for the scans; "process" is that of the whole command:
stillmap's also labels the beams, iterates, draws maps and writes the report.
"""

import itertools
import json
import statistics
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import karto
import numpy as np
from common import make_parser, timed
from numpy.typing import NDArray
from pairs import known_relations, name_of, timed_poses
from real_logs import split
from tables import markdown

import stillmap
from stillmap.results.eval.readers import read_planar_trajectory
from stillmap.results.eval.trajectory import RelationErrors, compute_relation_errors


@dataclass(frozen=True, eq=False)
class Found:
    """What a method made of a recording: (T, 4) t, x, y, theta, and CPU seconds."""

    trajectory: NDArray[np.float64]
    poses_cpu: float
    process_cpu: float


Method = Callable[[Path, Path], Found]  # of a recording and a folder for results


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    p.add_argument("--karto-python", metavar="PYTHON", help="an interpreter that has yag-slam")
    p.add_argument("--rounds", type=int, default=1)
    p.add_argument("--keep", type=Path, help="folder for stillmap's results")
    own, flags = split(sys.argv[1:])
    args = p.parse_args(own)
    with tempfile.TemporaryDirectory() as scratch:
        work = args.keep or Path(scratch)
        print(table(args.logs, methods(args.karto_python, flags), args.rounds, work))


def methods(karto_python: str | None, flags: Sequence[str]) -> dict[str, Method]:
    """By name; each raises KartoError where it has nothing to show."""

    def by_karto(recording: Path, _: Path) -> Found:
        given = stillmap.read(recording)
        found = karto.mapped(given, karto_python)
        return Found(timed_poses(given.stamp_ns, found.poses), found.cpu, found.process_cpu)

    return {
        "stillmap": lambda recording, out: by_stillmap(recording, out, flags),
        "Karto": by_karto,
    }


def by_stillmap(recording: Path, out: Path, flags: Sequence[str]) -> Found:
    command = [sys.executable, "-m", "stillmap", "map", str(recording), "-o", str(out)]
    _, cpu = timed([*command, "--overwrite", "--quiet", "--threads", "1", *flags])
    run = json.loads((out / "run.json").read_text())
    return Found(read_planar_trajectory(out / "trajectory.tum"), run["cpu_seconds"]["m_step"], cpu)


def table(logs: Sequence[Path], some: dict[str, Method], rounds: int, work: Path) -> str:
    """A line per recording and method."""
    found: dict[tuple[Path, str], list[Found | karto.KartoError]] = {}
    for _, log, (name, method) in itertools.product(range(rounds), logs, some.items()):
        try:
            one: Found | karto.KartoError = method(log, work / name_of(log))
        except karto.KartoError as error:
            one = error
        found.setdefault((log, name), []).append(one)
    lines = []
    for (log, name), of_rounds in found.items():
        stamp_ns = stillmap.read(log).stamp_ns
        about = [name_of(log), str(len(stamp_ns)), name]
        done = [one for one in of_rounds if isinstance(one, Found)]
        if len(done) < rounds:
            failed = next(one for one in of_rounds if not isinstance(one, Found))
            lines.append([*about, str(failed), *["-"] * (len(_HEADER) - 4)])
            continue
        errors = compute_relation_errors(done[0].trajectory, known_relations(log, stamp_ns))
        cpu = [[one.poses_cpu for one in done], [one.process_cpu for one in done]]
        per_scan = [f"{1e3 * statistics.median(s) / len(stamp_ns):.2f}" for s in cpu]
        lines.append([*about, *shown(errors), *per_scan])
    return markdown(_HEADER, lines)


_HEADER = (
    "log",
    "scans",
    "method",
    "translation, m: mean",
    "median",
    "max",
    "rotation, deg: mean",
    "relations used",
    "CPU ms per scan: poses",
    "process",
)


def shown(errors: RelationErrors) -> list[str]:
    """The columns of the errors, "-" where no relation could be used."""
    t, r = errors.translation, errors.rotation
    values = [f"{t.mean:.4f}", f"{t.median:.4f}", f"{t.max:.3f}", f"{r.mean:.3f}"]
    return [*(values if errors.used else ["-"] * 4), f"{errors.used} of {errors.relations}"]


if __name__ == "__main__":
    main()
