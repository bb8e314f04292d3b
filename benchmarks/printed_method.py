"""Label and map scores of the printed method, per prior and iteration, in populated worlds.

python benchmarks/printed_method.py [--seeds reporting|tuning] [--scenes hall corridor]
    [--priors 0.5 0.8 0.9] [--iterations 5] [--true-poses] [--processes 2]

Poses come from odometry and registration unless --true-poses is given. Walls kept are counted
against the wall cells that the same run without people has when every hit counts.
"""

import argparse
import itertools
import multiprocessing
from dataclasses import dataclass

import numpy as np
from seeds import REPORTING, TUNING

import stillmap
from stillmap import _core, em, options
from stillmap.evaluation.labels import label_scores
from stillmap.evaluation.map import Grid, map_scores, wall_cells_of_map
from stillmap.evaluation.trajectory import absolute_errors, align
from stillmap.simulation import Simulation, scene_by_name, simulate

COLUMNS = ("AP", "F1", "Brier", "ECE", "ghosts", "walls", "ATE", "bound")


@dataclass(frozen=True)
class Case:
    """One simulated run, mapped with several priors."""

    scene: str
    seed: int
    priors: tuple[float, ...]
    iterations: int
    true_poses: bool


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--seeds", choices=["reporting", "tuning"], default="reporting")
    p.add_argument("--scenes", nargs="+", default=["hall", "corridor"])
    p.add_argument("--priors", nargs="+", type=float, default=[0.5, 0.8, 0.9])
    p.add_argument("--iterations", type=int, default=5)
    p.add_argument("--true-poses", action="store_true")
    p.add_argument("--processes", type=int, default=2)
    args = p.parse_args()
    seeds = REPORTING if args.seeds == "reporting" else TUNING
    cases = [
        Case(scene, seed, tuple(args.priors), args.iterations, args.true_poses)
        for scene, seed in itertools.product(args.scenes, seeds)
    ]
    with multiprocessing.Pool(args.processes) as pool:
        results = pool.map(scores_of, cases, chunksize=1)
    print(f"means over seeds {seeds} ({args.seeds}); in brackets the worst seed")
    print("scene    | p   | it |" + " | ".join(f"{c:>15}" for c in COLUMNS))
    for scene, p_static, it in itertools.product(
        args.scenes, args.priors, range(1, args.iterations + 1)
    ):
        rows = np.array(
            [r[p_static, it] for c, r in zip(cases, results, strict=True) if c.scene == scene]
        )
        worst = np.where(
            np.isin(COLUMNS, ["AP", "F1", "walls", "bound"]), rows.min(axis=0), rows.max(axis=0)
        )
        cells = [f"{m:.4g} ({w:.4g})" for m, w in zip(rows.mean(axis=0), worst, strict=True)]
        print(f"{scene:8} | {p_static:3} | {it:2} |" + " | ".join(f"{c:>15}" for c in cells))


def scores_of(case: Case) -> dict[tuple[float, int], list[float]]:
    """(prior, iteration) to one value per column."""
    sim = simulate(scene_by_name(case.scene), case.seed)
    reference = reference_walls(case)
    out: dict[tuple[float, int], list[float]] = {}
    for prior in case.priors:
        chosen = options.replaced(
            stillmap.Options(),
            {"threads": 1, "em": {"prior": prior, "max_iterations": case.iterations}},
        )
        poses = sim.truth.T_world_base if case.true_poses else None
        for iteration in stillmap.iterate(sim.recording, chosen, poses=poses):
            out[prior, iteration.number] = row_of(iteration, sim, reference)
    return out


def row_of(iteration: stillmap.Iteration, sim: Simulation, reference: np.ndarray) -> list[float]:
    labels = label_scores(iteration.p_static, sim.truth.static, sim.recording.hit)
    T_world_map = align(iteration.poses, sim.truth.T_world_base)
    grid = grid_of(iteration.grid)
    on_map = map_scores(grid, sim.truth.walls, reference, T_world_map)
    ate = absolute_errors(T_world_map @ iteration.poses, sim.truth.T_world_base).rmse
    return [
        labels.average_precision,
        labels.f1,
        labels.brier,
        labels.ece,
        on_map.ghosts_per_100_m2,
        on_map.walls_kept,
        ate,
        iteration.likelihood.bound,
    ]


def reference_walls(case: Case) -> np.ndarray:
    """Wall cells of the same run without people, every hit counted."""
    empty = simulate(scene_by_name(case.scene, {"crowd": {"people": 0}}), case.seed)
    recording, truth = empty.recording, empty.truth
    grid = _core.Grid2D(stillmap.Options().slam.resolution)
    em.add_recording(grid, recording, truth.T_world_base, None)
    return wall_cells_of_map(grid_of(grid), truth.walls, np.eye(3))


def grid_of(grid: _core.Grid2D) -> Grid:
    m = em.occupancy_map(grid)
    return Grid(m.p_occupied, m.origin, m.resolution)


if __name__ == "__main__":
    main()
