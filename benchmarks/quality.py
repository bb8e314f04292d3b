"""Does the likelihood of held-out beams rank runs as the truth does?

python benchmarks/quality.py [--worlds hall corridor ...] [--seeds tuning|reporting]
    [--scans 800] [--processes 2] [--json ROWS]

Each world is mapped well and badly: other poses, options, odometry, noise, crowds. Printed are the
runs and Spearman's rank correlation of what a run says about itself with its scores, signed so
that 1 is full agreement: among runs on the very same beams, within a world, and over all.
"""

import argparse
import itertools
import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from cases import Case
from common import add_seed_arguments, built, finite, options_of, outcomes, result_scores, seeds_of
from numpy.typing import NDArray
from prepared import prepare
from scipy.stats import spearmanr
from tables import BY_KEY, Row, grouped, markdown

from stillmap.core import se2
from stillmap.core.config import merge_nested

TRUTHS = ("ap", "f1", "brier", "log_loss", "walls", "ghosts", "ate")
OWN_WORDS = ("held_out", "bound")


@dataclass(frozen=True)
class Variant:
    """A way to map a world well or badly.

    Attributes:
        settings: `section.key=value` on top of the method's options.
        changes: to the world.
        jitter: of each scan's true pose, in metres and radians; None: poses are estimated.
        same_beams: the recording's beams are those of the world as it is.
    """

    name: str
    method: str = "stillmap"
    settings: tuple[str, ...] = ()
    changes: Mapping[str, Any] = field(default_factory=dict)
    jitter: tuple[float, float] | None = None
    same_beams: bool = True


_BAD_WHEELS = {
    "odometry": {"drift_noise": 0.024, "rotation_noise": 0.06, "translation_noise": 0.03}
}
VARIANTS = (
    Variant("as it is"),
    Variant("true poses", jitter=(0.0, 0.0)),
    Variant("poses off by 1 cm, 0.2 deg", jitter=(0.01, 0.0035)),
    Variant("poses off by 3 cm, 0.6 deg", jitter=(0.03, 0.0105)),
    Variant("poses off by 10 cm, 2 deg", jitter=(0.1, 0.035)),
    Variant("odometry 3x worse", changes=_BAD_WHEELS),
    Variant("wheels slip", changes={"odometry": {"slip_rate": 0.1}}),
    Variant("one iteration", settings=("em.max_iterations=1",)),
    Variant("prior 0.5", settings=("em.prior=0.5",)),
    Variant("prior 0.999", settings=("em.prior=0.999",)),
    Variant("printed method", method="paper"),
    Variant("printed method, prior 0.5", method="paper", settings=("em.prior=0.5",)),
    Variant("hit ratio 0.1", method="hit-ratio-0.1"),
    Variant("hit ratio 0.25", method="hit-ratio-0.25"),
    Variant("noise 1 cm", changes={"laser": {"range_noise": 0.01}}, same_beams=False),
    Variant("noise 5 cm", changes={"laser": {"range_noise": 0.05}}, same_beams=False),
    Variant("5 people", changes={"crowd": {"people": 5}}, same_beams=False),
    Variant("40 people", changes={"crowd": {"people": 40}}, same_beams=False),
)


@dataclass(frozen=True)
class Job:
    """One variant of a world."""

    world: str
    seed: int
    scans: int
    variant: Variant


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_seed_arguments(p)
    p.set_defaults(n_seeds=1)
    p.add_argument("--worlds", nargs="+", default=["hall", "corridor", "office"])
    p.add_argument("--scans", type=int, default=800)
    p.add_argument("--processes", type=int, default=2)
    p.add_argument("--json", type=Path, help="append rows to this file, one a line")
    args = p.parse_args()
    jobs = [
        Job(world, seed, args.scans, variant)
        for world, seed, variant in itertools.product(args.worlds, seeds_of(args), VARIANTS)
    ]
    rows = [row for _, row in outcomes(_row_of, jobs, args.processes)]
    if args.json:
        with args.json.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
    order = [variant.name for variant in VARIANTS]
    rows.sort(key=lambda row: (args.worlds.index(row["world"]), order.index(row["variant"])))
    print(_runs(rows))
    for own in OWN_WORDS:
        print(f"\n## {BY_KEY[own].title}: rank correlation with the truth\n")
        print(correlations(rows, own))


def _row_of(job: Job) -> dict[str, Any]:
    variant = job.variant
    changes = merge_nested({"robot": {"scans": job.scans}}, variant.changes)
    run = prepare(Case(job.world, "", job.world, changes), job.seed)
    poses = None
    if variant.jitter is not None:
        rng = np.random.default_rng([job.seed, 2])
        poses = jittered(run.simulation.truth.T_world_base, variant.jitter, rng)
    options = options_of(variant.method, variant.settings)
    result, cpu_ms = built(run.simulation.recording, options, poses)
    about = {"world": job.world, "seed": job.seed, "variant": variant.name}
    about["same_beams"] = variant.same_beams
    return finite({**about, **result_scores(result, cpu_ms, run)})


def jittered(
    poses: NDArray[np.float64], jitter: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Poses (T, 3, 3), each moved on its own by normal errors of metres and radians."""
    off = rng.standard_normal((len(poses), 3)) * (jitter[0], jitter[0], jitter[1])
    return poses @ se2.matrix(*off.T)


def _runs(rows: Sequence[Row]) -> str:
    columns = [BY_KEY[key] for key in (*OWN_WORDS, *TRUTHS, "iterations")]
    lines = [
        [world, variant, *(column.mean_and_worst(some) for column in columns)]
        for (world, variant), some in grouped(
            rows, lambda row: (row["world"], row["variant"])
        ).items()
    ]
    return markdown(["world", "run", *(column.title for column in columns)], lines)


def correlations(rows: Sequence[Row], own: str) -> str:
    """One line per set of runs."""
    sets: list[tuple[str, Sequence[Row]]] = []
    for (world, seed), some in grouped(rows, lambda row: (row["world"], row["seed"])).items():
        same = [row for row in some if row["same_beams"]]
        sets += [(f"{world} {seed}, same beams", same), (f"{world} {seed}", some)]
    sets.append(("all", rows))
    lines = [
        [name, str(len(some)), *(_agreement(some, own, key) for key in TRUTHS)]
        for name, some in sets
    ]
    return markdown(["runs", "how many", *(BY_KEY[key].title for key in TRUTHS)], lines)


def _agreement(rows: Sequence[Row], own: str, key: str) -> str:
    pairs = [(row[own], row[key]) for row in rows if None not in (row[own], row[key])]
    if len(pairs) < 3:
        return "-"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # constant scores have no ranks: NaN says so
        rho = spearmanr(*zip(*pairs, strict=True)).statistic
    return f"{rho if BY_KEY[key].more_is_better else -rho:+.2f}"


if __name__ == "__main__":
    main()
