"""Poses and loops in simulated worlds against the truth.

python benchmarks/poses.py [--cases NAME|GROUP ...] [--seeds tuning|reporting] [--n-seeds 5]
    [--no-odometry] [--ablation] [--set section.key=value ...] [--processes 2]

Relations are the displacements between 1000 pairs of scans at most 5 m apart, whenever they were
taken; "seen again" are those with more than 15 m of travel between the two. Drift is the error of
the last pose seen from the first, in percent of the way. A false loop is an accepted one whose
displacement is more than 0.5 m or 5 degrees off, and farther than its own covariance allows
(chi-square above 16): along a bare corridor a loop says little, and says so.

Every run has a process of its own, which reads what another one simulated: memory and CPU are
those of `stillmap.build` and of reading.
"""

import contextlib
import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from cases import TRAJECTORY, Case, chosen
from common import (
    Scores,
    add_arguments,
    add_seed_arguments,
    built,
    in_fresh_process,
    make_parser,
    options_of,
    outcomes_in_order,
    seeds_of,
)
from numpy.typing import NDArray
from pairs import errors_of, near_pairs
from tables import Column, Row, grouped, markdown

import stillmap
from stillmap import slam
from stillmap.core import se2
from stillmap.core.profiling import peak_memory_bytes
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import load_truth, simulate, write_simulation
from stillmap.slam import scan_hits
from stillmap.slam.local_map import travelled_distance

Float = NDArray[np.float64]

CASES = (
    "corridor-empty",
    "corridor-20",
    "corridor-40",
    "corridor-bad-odometry",
    "hall-empty",
    "hall-15",
    "hall-60",
    "office-empty",
    "office-10",
    "warehouse-empty",
    "warehouse-12",
    "street-empty",
    "street-16",
    TRAJECTORY,
)
AGAIN = 15.0  # m of travel after which a place is seen again
FALSE_METRES = 0.5
FALSE_DEGREES = 5.0
FALSE_CHI2 = 16.0

RELATIONS = (
    Column("translation", "relations, m: mean", ".4f"),
    Column("translation_max", "max", ".3f"),
    Column("again", "seen again", ".4f"),
    Column("rotation", "deg: mean", ".3f"),
    Column("rotation_max", "max", ".2f"),
)
ABSOLUTE = (Column("ate", "ATE, m", ".3f"), Column("drift", "drift, %", ".3f"))
LOOPS = (
    Column("accepted", "loops", ".0f"),
    Column("refused", "refused", ".0f"),
    Column("false", "false", ".0f"),
)
COST = (
    Column("m_step", "CPU ms per scan: one M-step", ".2f"),
    Column("cpu", "whole job", ".2f"),
    Column("peak", "peak MB", ".0f"),
)
COLUMNS = (*RELATIONS, *ABSOLUTE, *LOOPS, *COST)


@dataclass(frozen=True)
class Variant:
    """Options and constants of `stillmap.slam` ("module.NAME") that differ from the defaults."""

    name: str
    settings: tuple[str, ...] = ()
    odometry: bool = True
    constants: dict[str, Any] = field(default_factory=dict)

    @contextlib.contextmanager
    def patched(self) -> Iterator[None]:
        """Sets the constants."""
        with contextlib.ExitStack() as stack:
            for path, value in self.constants.items():
                module, _, name = full_path(path).rpartition(".")
                stack.enter_context(patch.object(import_module(module), name, value))
            yield


def full_path(constant: str) -> str:
    """The path of a constant of `stillmap.slam`, or of another package if it is named in full."""
    return constant if constant.startswith("stillmap.") else f"stillmap.slam.{constant}"


def keep_poses(*given: Any) -> Any:
    """The poses as they were, in place of `refine_poses`."""
    return given[3]


DEFAULTS = Variant("defaults")
NO_ODOMETRY = Variant("no odometry", odometry=False)
ABLATION = (
    DEFAULTS,
    Variant("no loops", ("slam.loop_closure=false",)),
    Variant("no e: the first M-step", ("em.max_iterations=1",)),
    Variant("loops nearby need not agree", constants={"loop_closure._MAX_AGREEMENT_CHI2": 1e9}),
    Variant("every loop is believed", constants={"loop_closure._MAX_CHI2": 1e9}),
    Variant("no annealing", constants={"pose_graph._ANNEALING_STEPS": 1}),
    Variant("no refinement pass", constants={"m_step.refine_poses": keep_poses}),
    Variant(
        "surfaces are not filled",
        constants={"scan_hits.INTERPOLATION": {**scan_hits.INTERPOLATION, "max_gap": 0.0}},
    ),
    Variant("loops from single scans", constants={"loop_verification._VIEW_TRAVEL": (0.0,)}),
    Variant(
        "beams count up to their end",
        constants={"FREE_SPACE_MARGIN": 0.0, "scan_hits.FREE_SPACE_MARGIN": 0.0},
    ),
)


@dataclass(frozen=True)
class Job:
    """One simulated run, mapped in several ways."""

    case: Case
    seed: int
    variants: tuple[Variant, ...]
    settings: tuple[str, ...]


def main() -> None:
    p = make_parser(__doc__)
    add_arguments(p, [])
    add_seed_arguments(p)
    p.add_argument("--cases", nargs="+", default=list(CASES), help="names or groups")
    p.add_argument("--no-odometry", action="store_true", help="also as if there was none")
    p.add_argument("--ablation", action="store_true", help="also without parts of the M-step")
    args = p.parse_args()
    some = variants(args.ablation, args.no_odometry)
    for variant in some:
        options_of("stillmap", [*args.set, *variant.settings])  # refuses before hours have passed
    pairs = itertools.product(chosen(args.cases), seeds_of(args))
    jobs = [Job(*pair, some, tuple(args.set)) for pair in pairs]
    done = outcomes_in_order(rows_of, jobs, args.processes)
    print(report([row for _, rows in done for row in rows]))


def variants(ablation: bool, no_odometry: bool) -> tuple[Variant, ...]:
    return (*(ABLATION if ablation else (DEFAULTS,)), *((NO_ODOMETRY,) if no_odometry else ()))


def rows_of(job: Job) -> list[Row]:
    """A row of scores per variant."""
    return rows_by_variant(job, scored)


def rows_by_variant(job: Any, scored: Callable[..., Scores], **about: Any) -> list[Row]:
    """Simulates the world of a job once; a row of `scored(folder, variant, job)` per variant."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work, "recording")
        in_fresh_process(write, folder, job.case, job.seed)
        about |= {"case": job.case.name, "seed": job.seed}
        return [
            {**about, "variant": variant.name, **in_fresh_process(scored, folder, variant, job)}
            for variant in job.variants
        ]


def write(folder: Path, case: Case, seed: int) -> None:
    """A recording folder with its truth."""
    write_simulation(simulate(case.build(), seed), folder)


def scored(folder: Path, variant: Variant, job: Job) -> Scores:
    """Scores and cost of one way to map a simulated folder."""
    options = options_of("stillmap", [*job.settings, *variant.settings])
    recording = stillmap.read(folder, options.read)
    if not variant.odometry:
        recording = recording.without_odometry()
    with variant.patched():
        return scores_and_cost(recording, options, folder)


def scores_and_cost(
    recording: stillmap.Recording, options: stillmap.Options, folder: Path
) -> Scores:
    """Of the whole job on a recording whose truth lies in a folder."""
    result, cpu = built(recording, options)
    peak, T = peak_memory_bytes() / 1e6, recording.n_scans
    steps = {
        step: 1e3 * result.stages[step]["cpu_seconds"] / len(result.iterations) / T
        for step in ("m_step", "e_step")
    }
    truth = load_truth(folder).T_world_base
    return {
        **pose_scores(recording.stamp_ns, result.poses, truth),
        **loop_scores(result.loops, truth),
        **steps,
        "iterations": len(result.iterations),
        "cpu": cpu,
        "peak": peak,
    }


def pose_scores(stamp_ns: NDArray[np.int64], poses: Float, truth: Float) -> Scores:
    """Relation errors, ATE and drift of poses (T, 3, 3)."""
    positions, travelled = truth[:, :2, 2], travelled_distance(truth)
    first, second = near_pairs(positions, np.random.default_rng(0))
    again = travelled[second] - travelled[first] > AGAIN
    ends = np.array([0]), np.array([len(truth) - 1])

    def errors(first: NDArray[np.intp], second: NDArray[np.intp]) -> Any:
        return errors_of(stamp_ns, poses, truth, first, second)

    near = errors(first, second)
    return {
        "translation": near.translation.mean,
        "translation_max": near.translation.max,
        "again": errors(first[again], second[again]).translation.mean,
        "rotation": near.rotation.mean,
        "rotation_max": near.rotation.max,
        "ate": compute_absolute_errors(poses, truth).rmse,
        "drift": 100 * errors(*ends).translation.max / max(travelled[-1], 1e-9),
        "metres": float(travelled[-1]),
    }


def loop_scores(loops: Sequence[slam.LoopClosure], truth: Float) -> Scores:
    """How many were accepted, how many rejected, and how many of the accepted are false."""
    accepted = [loop for loop in loops if not loop.rejected]
    return {
        "accepted": len(accepted),
        "refused": len(loops) - len(accepted),
        "false": sum(is_false(loop, truth) for loop in accepted),
    }


def is_false(loop: slam.LoopClosure, truth: Float) -> bool:
    true = se2.inverse(truth[loop.earlier]) @ truth[loop.later]
    d = se2.parameters(se2.inverse(true) @ loop.T)
    is_off = np.hypot(d[0], d[1]) > FALSE_METRES or abs(np.degrees(d[2])) > FALSE_DEGREES
    return bool(is_off and d @ np.linalg.solve(loop.covariance, d) > FALSE_CHI2)


def report(rows: Sequence[Row]) -> str:
    """By case and variant; and what the variants bring over all cases."""
    parts = [
        "Means over seeds, in brackets the worst.",
        _table(rows, ("case", "variant"), lambda row: (row["case"], row["variant"])),
    ]
    cases, some = ({row[key] for row in rows} for key in ("case", "variant"))
    if len(cases) > 1 and len(some) > 1:
        over_all = _table(rows, ("all cases",), lambda row: (row["variant"],))
        parts += ["Means over cases and seeds, in brackets the worst run.", over_all]
    return "\n\n".join(parts)


def _table(
    rows: Sequence[Row], names: tuple[str, ...], key: Callable[[Row], tuple[str, ...]]
) -> str:
    lines = [
        [*which, *(column.mean_and_worst(some) for column in COLUMNS)]
        for which, some in grouped(rows, key).items()
    ]
    return markdown([*names, *(column.title for column in COLUMNS)], lines)


if __name__ == "__main__":
    main()
