"""Textured models of simulated places and of what moved there, against the truth.

python benchmarks/models.py [--seeds tuning|reporting] [--n-seeds 3] [--worlds hall corridor street]
    [--set section.key=value ...] [--processes 1] [--keep DIR]

Each world is recorded for a minute with a camera: hall and corridor by a rig of two lasers, the
street by a spinning lidar. `stillmap map` makes the models, `model_scores.py` scores them.
Surface: mean and 95 % of how far it is off, cm, and the share of the places that the sensor saw, or
saw from within 10 m, that lie within 5 cm of it. Texture: the share that shows movers, the share of
what some picture sees without movers, or sees from within 10 m, that is textured, and CIEDE2000.
Movers: the share of those that were tracked of which there is a model, and of those of them that
100 beams met within a second; chamfer distance in cm, and the share of their textures that shows
anything else.
"""

import math
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
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
from model_scores import score_model
from tables import Column, means_and_worst

from stillmap.sim import scene_by_name, simulate, write_simulation
from stillmap.sim.camera import SKY
from stillmap.sim.truth import load_image_truth

_CAMERA: dict[str, Any] = {"enabled": True, "rate": 2.0}
# a SICK's scan in half of its turn, and a joint that goes up and down in 4 s
_RIG: dict[str, Any] = {
    "rig": {"tilts": True},
    "robot": {"scans": 2250, "scan_rate": 37.5},
    "laser": {"sweep_time": 0.013},
    "camera": _CAMERA,
}
WORLDS: dict[str, dict[str, Any]] = {
    "hall": {**_RIG, "crowd": {"people": 60}},
    "corridor": {**_RIG, "crowd": {"people": 30}},
    "street": {
        "lidar": {"channels": 64, "columns": 900},
        "robot": {"scans": 600},
        "camera": _CAMERA,
        "crowd": {"people": 30},
    },
}
WALKERS = 0.3  # share of pictures that show somebody, at least
_NEAR = 10.0  # m
_SEEN = 1e-3  # share of a picture's pixels
COLUMNS = (
    Column("walkers", "pictures with movers, %", ".0f", True),
    Column("mean", "off, cm", ".2f"),
    Column("p95", "95 %", ".2f"),
    Column("complete", "complete, %", ".1f", True),
    Column("complete_near", "within 10 m", ".1f", True),
    Column("mover", "shows movers, %", ".3f"),
    Column("covered", "covered, %", ".1f", True),
    Column("covered_near", "within 10 m", ".1f", True),
    Column("colour_median", "CIEDE2000", ".2f"),
    Column("colour_p95", "95 %", ".1f"),
    Column("tracked", "tracked", ".0f", True),
    Column("modelled", "with a model, %", ".0f", True),
    Column("seen_well", "seen well", ".0f", True),
    Column("modelled_well", "with a model, %", ".0f", True),
    Column("chamfer", "chamfer, cm", ".2f"),
    Column("good", "within 5 cm, %", ".0f", True),
    Column("background", "background, %", ".2f"),
    Column("nothing", "models of no mover", ".1f"),
    Column("seconds", "s", ".0f"),
)
_PERCENT = {"complete", "mover", "covered", "modelled", "modelled_well", "good", "background"}
_CENTIMETRES = {"mean", "p95", "chamfer"}


@dataclass(frozen=True)
class Job:
    """One simulated recording."""

    world: str
    seed: int
    settings: tuple[str, ...]
    keep: Path | None


def main() -> None:
    p = make_parser(__doc__)
    add_arguments(p, [])
    add_seed_arguments(p)
    p.add_argument("--worlds", nargs="+", choices=WORLDS, default=list(WORLDS))
    p.add_argument("--keep", type=Path, metavar="DIR", help="leave recordings and results there")
    p.set_defaults(n_seeds=3, processes=1)
    args = p.parse_args()
    options_of("stillmap", args.set)  # refuses before hours have passed
    jobs = [
        Job(world, seed, tuple(args.set), args.keep)
        for world in args.worlds
        for seed in seeds_of(args)
    ]
    done = outcomes_in_order(rows, jobs, args.processes)
    print("Means over seeds, in brackets the worst.")
    print(means_and_worst([{"case": job.world, **row} for job, row in done], COLUMNS))
    for job, row in done:
        if (share := row["walkers"]) < 100 * WALKERS:
            print(f"\n{job.world}, seed {job.seed}: movers in {share:.0f} % of the pictures only")


def rows(job: Job) -> Scores:
    """The scores of a job."""
    if job.keep:
        return _rows(job, job.keep / f"{job.world}-{job.seed}")
    with tempfile.TemporaryDirectory() as folder:
        return _rows(job, Path(folder))


def _rows(job: Job, folder: Path) -> Scores:
    folder.mkdir(parents=True, exist_ok=True)
    sim, recorded = folder / "sim", WORLDS[job.world]
    scene = scene_by_name(job.world, recorded)
    tilts = scene.rig.tilts
    if not sim.exists():
        if tilts:
            write_simulation(simulate(scene, job.seed), sim)
        else:
            write_simulation(simulate(scene, job.seed), sim)
    inputs = [sim / "horizontal", "--tilting", sim / "tilting"] if tilts else [sim]
    share = walkers(sim / "tilting" if tilts else sim)
    result = folder / "result-0"
    flags = [part for one in job.settings for part in ("--set", one)]
    started = time.monotonic()
    _stillmap("map", *inputs, "-o", result, "--mesh", "--overwrite", "--quiet", *flags)
    seconds = time.monotonic() - started
    near = score_model(result, sim, _NEAR)
    return {
        **flat(score_model(result, sim, math.inf)),
        "complete_near": flat(near)["complete"],
        "covered_near": flat(near)["covered"],
        "walkers": 100.0 * share,
        "seconds": seconds,
    }


def _stillmap(*args: object) -> None:
    subprocess.run([sys.executable, "-m", "stillmap", *map(str, args)], check=True)


def flat(found: dict[str, Any]) -> Scores:
    """What `score_model` says, in percent and centimetres; NaN for what it does not."""
    merged = {}
    for part in ("surface", "texture", "movers"):
        merged.update(found.get(part, {}))
    out = {}
    for column in COLUMNS:
        value = merged.get(column.key)
        factor = 100.0 if column.key in _PERCENT | _CENTIMETRES else 1.0
        out[column.key] = float("nan") if value is None else factor * value
    return out


def walkers(sim: Path) -> float:
    """The share of pictures of which movers cover a thousandth or more."""
    truth = load_image_truth(sim)
    masks = (truth.mask(image) for image in range(len(truth.T_world_camera)))
    return float(np.mean([np.mean((mask > 0) & (mask != SKY)) >= _SEEN for mask in masks]))


if __name__ == "__main__":
    main()
