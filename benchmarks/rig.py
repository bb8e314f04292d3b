"""A flat laser decides what moves in what a tilting one builds (Sect. 4.4, 4.5 of the paper).

python benchmarks/rig.py [--seeds tuning|reporting] [--n-seeds 3] [--worlds hall corridor office]
    [--set section.key=value ...] [--processes 1]

Simulated rigs for 80 s each; people walk, and every third stops now and then. Poses and labels of
the flat laser are estimated. Of the points of the tilting laser: SA, the share of the static ones
that is kept; DA, the share of the dynamic ones that is removed; HA, their harmonic mean; percent.
Beams on doors count in the last two columns only: one that is seen in one state stands still for
every laser.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from common import (
    Scores,
    add_arguments,
    add_seed_arguments,
    make_parser,
    options_of,
    outcomes_in_order,
    seeds_of,
)
from numpy.typing import NDArray
from tables import Column, means_and_worst

import stillmap
from stillmap.core import config
from stillmap.pipeline.tilting import PlanarResult, TiltingResult, build_tilting
from stillmap.results.eval.labels import score_labels
from stillmap.sim import scene_by_name, simulate
from stillmap.sim.simulator import Simulation

WORLDS: dict[str, dict[str, Any]] = {
    "hall": {"crowd": {"people": 30}},
    "corridor": {"crowd": {"people": 15}},
    "office": {"crowd": {"people": 12}},
}
# a SICK's scan in half of its turn
_COMMON: dict[str, Any] = {
    "rig": {"tilts": True},
    "robot": {"scans": 3000, "scan_rate": 37.5},
    "laser": {"sweep_time": 0.013},
}
WAYS = ("flat laser decides", "with 3D evidence", "3D evidence alone")
COLUMNS = (
    Column("sa", "SA, %", ".2f", True),
    Column("da", "DA, %", ".2f", True),
    Column("ha", "HA, %", ".2f", True),
    Column("f1", "F1", ".3f", True),
    Column("ap", "AP", ".3f", True),
    Column("brier", "Brier", ".4f"),
    Column("da_all", "DA with doors, %", ".2f", True),
    Column("ha_all", "HA with doors, %", ".2f", True),
)


@dataclass(frozen=True)
class Job:
    """One simulated rig."""

    world: str
    seed: int
    settings: tuple[str, ...]


def main() -> None:
    p = make_parser(__doc__)
    add_arguments(p, [])
    add_seed_arguments(p)
    p.add_argument("--worlds", nargs="+", choices=WORLDS, default=list(WORLDS))
    p.set_defaults(n_seeds=3, processes=1)
    args = p.parse_args()
    options_of("stillmap", args.set)  # refuses before hours have passed
    jobs = [Job(world, seed, tuple(args.set)) for world in args.worlds for seed in seeds_of(args)]
    done = outcomes_in_order(rows, jobs, args.processes)
    print("Means over worlds and seeds, in brackets the worst.")
    for way in WAYS:
        of_way = [{"case": job.world, **by_way[way]} for job, by_way in done]
        print(f"\n## {way}\n\n{means_and_worst(of_way, COLUMNS)}")


def rows(job: Job) -> dict[str, Scores]:
    """The scores of each way to decide."""
    rig, alone, built = run(job)
    labels = {way: one.p_static for way, one in built.items()} | {WAYS[2]: alone}
    return {way: scores(rig, p_static) for way, p_static in labels.items()}


def run(job: Job) -> tuple[Simulation, NDArray[np.float32], dict[str, TiltingResult]]:
    """A rig, P(static) of tilting beams by their own evidence alone, and with the flat laser."""
    scene = scene_by_name(job.world, config.merge_nested(WORLDS[job.world], _COMMON))
    rig = simulate(scene, job.seed)
    chosen = options_of("stillmap", job.settings)
    result = stillmap.build(rig.recording, chosen)
    flat = PlanarResult(result.deskewed, result.poses, result.p_static, result.objects)
    tilting = rig.tilting.recording
    built = {
        way: build_tilting(flat, tilting, chosen.em, use_evidence=way == WAYS[1])
        for way in WAYS[:2]
    }
    unlabelled = replace(flat, p_static=np.ones_like(flat.p_static), objects=[])
    alone = build_tilting(unlabelled, tilting, chosen.em)
    return rig, alone.p_static, built


def scores(rig: Simulation, p_static: NDArray[np.float32]) -> Scores:
    """Of the beams that hit something and whose place is known."""
    truth, hit = rig.tilting.truth, rig.tilting.recording.hit & ~np.isnan(p_static)
    kinds = np.array([*truth.scene["mover_kinds"], "none"])[truth.mover]
    some = hit & (kinds != "door")
    labels = score_labels(p_static, truth.static, some)
    sa, da, ha = kept_and_removed(p_static, truth.static, some)
    _, da_all, ha_all = kept_and_removed(p_static, truth.static, hit)
    return {
        **{"sa": sa, "da": da, "ha": ha, "da_all": da_all, "ha_all": ha_all},
        **{"f1": labels.f1, "ap": labels.average_precision, "brier": labels.brier},
    }


def kept_and_removed(
    p_static: NDArray[np.float32], static: NDArray[np.bool_], some: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Percent: of the static beams those kept, of the others those removed, the harmonic mean."""
    removed = p_static < 0.5
    sa = 100.0 * float(np.mean(~removed[some & static]))
    da = 100.0 * float(np.mean(removed[some & ~static]))
    return sa, da, 2.0 * sa * da / max(sa + da, 1e-9)


if __name__ == "__main__":
    main()
