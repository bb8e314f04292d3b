"""Do poses hold in worlds drawn at random: short ranges, narrow views, crowds, mishaps?

python benchmarks/holding.py [--seeds tuning|reporting] [--n-seeds 5] [--kinds drawn|carried]
    [--worlds-per-seed 4] [--ablation] [--set section.key=value ...] [--processes 2]

`drawn`: range 4 to 30 m, field of view 70 to 360 degrees, 60 to 1081 beams, 0 to 120 people,
odometry of .5 to 3 times the usual errors, and one mishap or none: floor seen over bumps, stalls,
slips, 30 s without a return. `carried`: the robot is carried 20 m, or to any other place.

A break is false if nobody carried the robot. "Sees walls" is the share of the scans of which at
least 20 hits and half of all hits end on what stands still. Worse than odometry: ATE above 1.2
times that of odometry alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cases import Case, scaled_odometry
from common import (
    Scores,
    add_arguments,
    add_seed_arguments,
    built,
    make_parser,
    options_of,
    outcomes_in_order,
    seeds_of,
)
from poses import Variant, loop_scores, rows_by_variant
from tables import Row, grouped, markdown

import stillmap
from stillmap.core.config import merge_nested
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import load_truth

SCANS = 1500
SCENES = {"hall": 1.0, "corridor": 0.4, "office": 0.3, "warehouse": 0.5}  # room for a crowd
MISHAPS = ("none", "none", "bumps", "stalls", "slips", "blind")
BAD_RATIO = 1.2
MIN_HITS = 20

ABLATION = (
    Variant("defaults"),
    Variant("odometry noise is not learned", constants={"motion_model._MIN_NOISE_SHARE": 1.0}),
    Variant(
        "one contradicting scan is a break",
        constants={"front_end._CARRIED_AFTER": 1.0},
    ),
    Variant(
        "a place elsewhere costs nothing",
        constants={
            "segment_placement._CARRIED_COST": 0.0,
        },
    ),
    Variant("views of single walls do not grow", constants={"loop_verification._MIN_ISOTROPY": 0}),
    Variant(
        "movers that stay long are not rare",
        constants={"stillmap.em.occupancy_hmm._LONG_TAU": math.inf},
    ),
    Variant("no loops", ("slam.loop_closure=false",)),
    Variant("one iteration", ("em.max_iterations=1",)),
)


@dataclass(frozen=True)
class Job:
    """One drawn world, mapped in several ways."""

    case: Case
    seed: int
    about: tuple[tuple[str, Any], ...]
    variants: tuple[Variant, ...]
    settings: tuple[str, ...]


def main() -> None:
    p = make_parser(__doc__)
    add_arguments(p, [])
    add_seed_arguments(p)
    p.add_argument("--kinds", nargs="+", choices=("drawn", "carried"), default=["drawn"])
    p.add_argument("--worlds-per-seed", type=int, default=4)
    p.add_argument("--ablation", action="store_true", help="also without parts of it")
    args = p.parse_args()
    some = ABLATION if args.ablation else ABLATION[:1]
    jobs = [
        Job(case, seed, about, some, tuple(args.set))
        for kind in args.kinds
        for seed in seeds_of(args)
        for case, about in drawn_worlds(kind, seed, args.worlds_per_seed)
    ]
    done = outcomes_in_order(rows_of, jobs, args.processes)
    print(report([row for _, rows in done for row in rows]))


def drawn_worlds(
    kind: str, seed: int, count: int
) -> list[tuple[Case, tuple[tuple[str, Any], ...]]]:
    """Worlds of a kind, and what is special about each."""
    rng = np.random.default_rng([seed, len(kind)])
    return [(_drawn if kind == "drawn" else _carried)(rng, k) for k in range(count)]


def _sensor(rng: np.random.Generator) -> dict[str, Any]:
    degrees = float(rng.choice([70, 90, 120, 180, 270, 360]))
    beams = int(np.clip(degrees / rng.choice([0.25, 0.5, 1.0, 1.5]), 60, 1081))
    metres = round(float(np.exp(rng.uniform(np.log(4.0), np.log(30.0)))), 1)
    noise = float(rng.choice([0.01, 0.02, 0.03, 0.05]))
    return {"beams": beams, "fov": math.radians(degrees), "max_range": metres, "range_noise": noise}


def _drawn(rng: np.random.Generator, number: int) -> tuple[Case, tuple[tuple[str, Any], ...]]:
    scene, laser = str(rng.choice(list(SCENES))), _sensor(rng)
    people = int(SCENES[scene] * rng.choice([0, 15, 30, 60, 120]))
    factor, mishap = float(rng.choice([0.5, 1.0, 2.0, 3.0])), str(rng.choice(MISHAPS))
    changes = merge_nested(
        {"laser": laser, "crowd": {"people": people}, "robot": {"scans": SCANS}},
        scaled_odometry(factor),
        _mishap(mishap),
    )
    about = (
        ("world", f"{scene}, {people} people"),
        ("sensor", f"{math.degrees(laser['fov']):.0f} deg, {laser['beams']}, "
                   f"{laser['max_range']} m, {100 * laser['range_noise']:.0f} cm"),
        ("odometry", f"x {factor:g}, {mishap}"),
    )  # fmt: skip
    return Case(f"drawn {number}", "drawn", scene, changes), about


def _mishap(name: str) -> dict[str, Any]:
    return {
        "none": {},
        "bumps": {"robot": {"bump_rate": 0.2}},
        "stalls": {"odometry": {"stall_rate": 1.0}},
        "slips": {"odometry": {"slip_rate": 0.05}},
        "blind": {"laser": {"blind_stretches": 1, "blind_time": 30.0}},
    }[name]


def _carried(rng: np.random.Generator, number: int) -> tuple[Case, tuple[tuple[str, Any], ...]]:
    scene, by = str(rng.choice(["warehouse", "office", "hall", "corridor"])), rng.random() < 0.5
    robot = {"scans": 2000, "carried_at": 0.5, **({"carried_by": 20.0} if by else {})}
    about = (("world", scene), ("sensor", "usual"), ("odometry", "20 m" if by else "anywhere"))
    return Case(f"carried {number}", "carried", scene, {"robot": robot}), about


def rows_of(job: Job) -> list[Row]:
    """A row of scores per variant."""
    return rows_by_variant(job, scored, **dict(job.about))


def scored(folder: Path, variant: Variant, job: Job) -> Scores:
    """Scores of one way to map a simulated folder."""
    options = options_of("stillmap", [*job.settings, *variant.settings])
    recording, truth = stillmap.read(folder, options.read), load_truth(folder)
    with variant.patched():
        result, cpu = built(recording, options)
    carried, breaks = truth.scene.get("carried_at_scan"), result.doubts.breaks
    of_odometry = compute_absolute_errors(recording.T_odom_base, truth.T_world_base).rmse
    noticed = carried in breaks or carried in result.doubts.ambiguous
    return {
        "odometry_ate": of_odometry,
        "ate": compute_absolute_errors(result.poses, truth.T_world_base).rmse,
        **loop_scores(result.loops, truth.T_world_base),
        "false_breaks": sum(t != carried for t in breaks),
        "unnoticed": float(carried is not None and not noticed),
        "sees_walls": float(np.mean(wall_scans(recording, truth.static))),
        "iterations": len(result.iterations),
        "best": result.best_iteration,
        "cpu": cpu,
    }


def wall_scans(recording: stillmap.Recording, static: Any) -> list[bool]:
    """Of each scan whether it sees enough of what stands still."""
    out = []
    for t in range(recording.n_scans):
        beams = recording.beams_of(t)
        hits = static[beams][recording.hit[beams]]
        out.append(bool(hits.sum() >= max(MIN_HITS, 0.5 * len(hits))))
    return out


def report(rows: Sequence[Row]) -> str:
    """Every run of the first variant, and the summary of each variant."""
    first = rows[0]["variant"]
    keys = ("seed", "world", "sensor", "odometry")
    titles = ["seed", "world", "sensor", "odometry", "odometry alone, m", "ATE, m", "loops",
              "false", "false breaks", "unnoticed", "sees walls", "kept of",
              "ms per scan"]  # fmt: skip
    lines = [
        [*(str(row[key]) for key in keys), f"{row['odometry_ate']:.3f}", f"{row['ate']:.3f}",
         f"{row['accepted']:.0f}", f"{row['false']:.0f}", f"{row['false_breaks']:.0f}",
         f"{row['unnoticed']:.0f}", f"{row['sees_walls']:.2f}",
         f"{row['best']:.0f} of {row['iterations']:.0f}", f"{row['cpu']:.1f}"]
        for row in rows if row["variant"] == first
    ]  # fmt: skip
    of_variants = grouped(rows, lambda row: row["variant"])
    summary = [[name, *_summary(some)] for name, some in of_variants.items()]
    titles_2 = ["variant", "runs", "median ATE where walls are seen", "worst ratio to odometry",
                "worse than odometry", "false loops", "false breaks", "unnoticed",
                "ms per scan"]  # fmt: skip
    return markdown(titles, lines) + "\n\n" + markdown(titles_2, summary)


def _summary(rows: Sequence[Row]) -> list[str]:
    ratio = np.array([row["ate"] / max(row["odometry_ate"], 1e-9) for row in rows])
    seen = [row["ate"] for row in rows if row["sees_walls"] >= 0.5]
    return [
        str(len(rows)),
        f"{np.median(seen):.3f} of {len(seen)}" if seen else "-",
        f"{ratio.max():.2f}",
        str(int((ratio > BAD_RATIO).sum())),
        *(f"{sum(row[key] for row in rows):.0f}" for key in ("false", "false_breaks", "unnoticed")),
        f"{np.mean([row['cpu'] for row in rows]):.1f}",
    ]


if __name__ == "__main__":
    main()
