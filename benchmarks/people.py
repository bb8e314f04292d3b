"""Recall of legs marked by hand in scans of a standing laser.

python benchmarks/people.py DIR [--methods stillmap paper ...] [--set section.key=value ...]

DIR holds people_N.bag and people_N.npz: the same scans, with `label` (T, n) 1 = leg. Only the
walker inside a marked area is marked, so there is no fair precision: instead, the share of all
beams that is called dynamic. "With objects": the share of marked beams that ended on an object,
and of the scans with marks in which half of them did; by default 9 of 10 scans are wanted.
Objects counts those that any marked beam is with.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import add_arguments, built, make_parser, options_of, outcomes
from numpy.typing import NDArray
from tables import grouped, markdown

from stillmap.core.recording import Recording
from stillmap.io import read

WANTED_RECALL, WANTED_COVERED = 0.95, 0.9


@dataclass(frozen=True)
class Job:
    """One recording, mapped with one method."""

    path: Path
    method: str
    settings: tuple[str, ...]


@dataclass(frozen=True)
class Found:
    """What a method made of a recording."""

    scans: int
    legs: int
    recall: float
    mean_p: float
    called_dynamic: float
    beams_covered: float
    scans_covered: float
    objects: int
    cpu_ms: float


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("folder", type=Path)
    add_arguments(p, ["stillmap"])
    args = p.parse_args()
    files = sorted(args.folder.glob("people_*.npz"))
    if not files:
        raise SystemExit(f"{args.folder}: no people_*.npz")
    jobs = [Job(*pair, tuple(args.set)) for pair in itertools.product(files, args.methods)]
    done = sorted(outcomes(_found, jobs, args.processes), key=lambda pair: pair[0].path)
    for method, some in grouped(done, lambda pair: pair[0].method).items():
        print(f"\n## {method}\n\n{_table(some)}")


def recording_of(path: Path) -> tuple[Recording, NDArray[np.bool_]]:
    """The recording, and which of its beams (M,) are marked as leg."""
    leg = np.load(path)["label"] == 1
    recording = read(path.with_suffix(".bag"))
    if np.any(np.diff(recording.offset) != leg.shape[1]) or recording.n_scans != len(leg):
        raise SystemExit(f"{path}: marks of other scans than those in the bag")
    return recording, leg.ravel()


def _found(job: Job) -> Found:
    recording, leg = recording_of(job.path)
    stands = np.tile(np.eye(3), (recording.n_scans, 1, 1))
    result, cpu_ms = built(recording, options_of(job.method, job.settings), stands)
    owner = np.full(recording.n_beams, -1)
    for one in result.objects:
        owner[one.beams] = one.id
    marked = leg & recording.hit
    scan = np.searchsorted(recording.offset, np.flatnonzero(marked), side="right") - 1
    covered = owner[marked] >= 0
    of_scan = np.bincount(scan, covered)[np.unique(scan)] / np.unique(scan, return_counts=True)[1]
    p, leg = result.p_static[recording.hit], leg[recording.hit]
    return Found(
        scans=recording.n_scans,
        legs=int(leg.sum()),
        recall=float(np.mean(p[leg] < 0.5)),
        mean_p=float(np.mean(p[leg])),
        called_dynamic=float(np.mean(p < 0.5)),
        beams_covered=float(np.mean(covered)),
        scans_covered=float(np.mean(of_scan >= 0.5)),
        objects=len(np.unique(owner[marked][covered])),
        cpu_ms=cpu_ms,
    )


def _table(some: list[tuple[Job, Found]]) -> str:
    lines = [
        [
            job.path.stem,
            str(f.scans),
            str(f.legs),
            f"{f.recall:.4f}",
            f"{f.mean_p:.4f}",
            f"{f.called_dynamic:.4f}",
            f"{f.beams_covered:.4f}",
            f"{f.scans_covered:.4f}",
            str(f.objects),
            f"{f.cpu_ms:.2f}",
        ]
        for job, f in some
    ]
    header = ["recording", "scans", "marked beams", "recall", "mean P(static) of them"]
    header += ["called dynamic", "beams with objects", "scans", "objects", "CPU ms per scan"]
    table = markdown(header, lines)
    covered = float(np.mean([f.scans_covered for _, f in some]))
    kept = "met" if covered >= WANTED_COVERED else "MISSED"
    mean = float(np.mean([f.recall for _, f in some]))
    verdict = "met" if mean >= WANTED_RECALL else "MISSED"
    return (
        f"{table}\n\nMean recall {mean:.4f}, wanted >= {WANTED_RECALL:g}: {verdict}. "
        f"Scans with objects {covered:.4f}, wanted >= {WANTED_COVERED:g}: {kept}."
    )


if __name__ == "__main__":
    main()
