"""What benchmarks share: methods, one run's scores, command line, workers."""

import argparse
import itertools
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from cases import Case, chosen
from numpy.typing import NDArray
from prepared import Prepared, grid_of
from seeds import REPORTING, TUNING

import stillmap
from stillmap import em
from stillmap.core import config
from stillmap.em import beam_counting
from stillmap.results.eval.labels import score_labels
from stillmap.results.eval.map import score_map
from stillmap.results.eval.trajectory import align, compute_absolute_errors

METHODS: dict[str, dict[str, Any]] = {
    "stillmap": {"estimator": "stillmap"},
    "paper": {"estimator": "paper"},
    "tracker": {"estimator": "tracker"},
    "tracker-0.1": {"estimator": "tracker"},
    # mappers that count: hits / (hits + passes) of the end cell against a threshold
    "hit-ratio-0.1": {"estimator": "hit-ratio"},
    "hit-ratio-0.25": {"estimator": "hit-ratio"},
}
MIN_HIT_RATIO = {"tracker-0.1": 0.1, "hit-ratio-0.1": 0.1}  # by method; 0.25 for the others

VEHICLES = ["car", "forklift"]
LASTING = ["door", "thing"]  # stand still for so long that they may be seen in one state only
_NAN = float("nan")

Job = TypeVar("Job")
Outcome = TypeVar("Outcome")
Scores = dict[str, float]


@dataclass(frozen=True)
class Run:
    """One simulated run, mapped with one method."""

    case: Case
    seed: int
    method: str
    settings: tuple[str, ...]
    true_poses: bool


def in_fresh_process(work: Callable[..., Outcome], *args: object) -> Outcome:
    """What `work` returns, from a process that has done nothing else."""
    # Linux hands the peak of a process down to the one that it starts, not to what that one forks
    with multiprocessing.get_context("forkserver").Pool(1) as pool:
        return pool.apply(work, args)


def make_parser(doc: str | None) -> argparse.ArgumentParser:
    """A parser whose help is the docstring of a script."""
    formatter = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=doc, formatter_class=formatter)


def add_arguments(p: argparse.ArgumentParser, methods: Iterable[str]) -> None:
    """What to run and how, the same for all benchmarks of estimators; no methods: no choice."""
    if methods := list(methods):
        p.add_argument("--methods", nargs="+", choices=METHODS, default=methods)
    p.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="on top of a method"
    )
    p.add_argument("--processes", type=int, default=2, help="runs at a time, one thread each")


def add_run_arguments(p: argparse.ArgumentParser, cases: Iterable[str]) -> None:
    """Which simulated runs, for `runs_of`."""
    add_seed_arguments(p)
    p.add_argument("--cases", nargs="+", default=list(cases), help="names or groups")
    p.add_argument("--true-poses", action="store_true")


def runs_of(args: argparse.Namespace, methods: Iterable[str]) -> list[Run]:
    """Every case with every seed and method."""
    triples = itertools.product(chosen(args.cases), seeds_of(args), methods)
    return [Run(*triple, tuple(args.set), args.true_poses) for triple in triples]


def rows_of(
    doc: str, cases: Iterable[str], scored: Callable[[Run], Scores]
) -> list[dict[str, Any]]:
    """The scores of the default estimator in the runs that the command line wants.

    Args:
        doc: what the program is about, for its help.
        cases: of these names or groups, if the command line names none.
        scored: of one run; a function of a module, as other processes call it.
    """
    p = make_parser(doc)
    add_run_arguments(p, cases)
    add_arguments(p, [])
    args = p.parse_args()
    options_of("stillmap", args.set)  # refuses before hours have passed
    runs = runs_of(args, ["stillmap"])
    done = outcomes_in_order(scored, runs, args.processes)
    return [{"case": run.case.name, **scores} for run, scores in done]


def add_seed_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("--seeds", choices=["tuning", "reporting"], default="tuning")
    p.add_argument("--n-seeds", type=int, default=len(TUNING), help="only so many")
    p.add_argument("--skip-seeds", type=int, default=0, help="leave out the first so many")


def seeds_of(args: argparse.Namespace) -> tuple[int, ...]:
    seeds = REPORTING if args.seeds == "reporting" else TUNING
    return seeds[args.skip_seeds :][: args.n_seeds]


def options_of(method: str, settings: Iterable[str]) -> stillmap.Options:
    """Options of a method with `section.key=value` laid over them, for one thread.

    Sets the threshold of the hit ratio, which is no option, for the whole process.

    Raises:
        InputError: an option that is not there or has another type.
    """
    beam_counting.MIN_HIT_RATIO = MIN_HIT_RATIO.get(method, 0.25)
    changes = config.merge_nested(METHODS[method], *(config.parse_assignment(s) for s in settings))
    return config.override(stillmap.Options(), {"threads": 1, **changes})


def built(
    recording: stillmap.Recording,
    chosen: stillmap.Options,
    poses: NDArray[np.float64] | None = None,
) -> tuple[stillmap.Result, float]:
    """What a user gets, and the CPU time in ms per scan that it took."""
    started = time.process_time()
    result = stillmap.build(recording, chosen, poses=poses)
    return result, 1e3 * (time.process_time() - started) / recording.n_scans


def result_scores(result: stillmap.Result, cpu_ms: float, run: Prepared) -> Scores:
    """Scores of what was kept, with what it cost and what the method itself says about it."""
    kept = result.iterations[result.best_iteration - 1]
    return {
        **scores(result.p_static, result.poses, result.map, run),
        "iterations": len(result.iterations),
        "best": result.best_iteration,
        "cpu": cpu_ms,
        "bound": kept.bound / max(result.recording.n_beams, 1),
        "held_out": _or_nan(kept.held_out_log_likelihood),
    }


def scores(
    p_static: NDArray[np.floating],
    poses: NDArray[np.float64],
    occupancy: em.OccupancyMap,
    run: Prepared,
) -> Scores:
    """Labels against the truth, the map against the true walls, poses against the true ones."""
    truth, hit = run.simulation.truth, run.simulation.recording.hit
    labels = score_labels(p_static, truth.static, hit)
    T_world_map, grid = align(poses, truth.T_world_base), grid_of(occupancy)
    on_map = score_map(grid, truth.walls, run.walls_without_people, T_world_map)
    at_best = score_map(grid, truth.walls, run.walls_at_best, T_world_map)
    return {
        **_by_mover(p_static, run),
        "ap": labels.average_precision,
        "f1": labels.f1,
        "precision": labels.precision,
        "recall": labels.recall,
        "brier": labels.brier,
        "ece": labels.ece,
        "ece_unsure": labels.ece_unsure,
        "log_loss": labels.log_loss,
        "ghosts": on_map.ghosts_per_100_m2,
        "ghost_cells": on_map.ghost_cells,
        "free_area": on_map.free_area,
        "walls": on_map.walls_kept,
        "walls_at_best": at_best.walls_kept,
        "ghosts_of_truth": run.of_truth.ghosts_per_100_m2,
        "walls_of_truth": run.of_truth.walls_kept,
        "ate": compute_absolute_errors(poses, truth.T_world_base).rmse,
        "called_dynamic": labels.share_called_dynamic,
        "dynamic": labels.dynamic / max(labels.hits, 1),
    }


def _by_mover(p_static: NDArray[np.floating], run: Prepared) -> Scores:
    """Recall by what moved, and scores without the beams on what stands still for long."""
    truth, hit = run.simulation.truth, run.simulation.recording.hit
    kinds = np.array([*truth.scene["mover_kinds"], "none"])[truth.mover]
    without = score_labels(p_static, truth.static, hit & ~np.isin(kinds, LASTING))
    found = p_static < 0.5
    named = {"people": ["person"], "doors": ["door"], "vehicles": VEHICLES, "things": ["thing"]}
    recall = {
        f"recall_{name}": float(found[of].mean()) if (of := np.isin(kinds, some)).any() else _NAN
        for name, some in named.items()
    }
    return {
        **recall,
        "ap_no_doors": without.average_precision,
        "f1_no_doors": without.f1,
        "brier_no_doors": without.brier,
        "ece_no_doors": without.ece,
        "ece_unsure_no_doors": without.ece_unsure,
    }


def outcomes(
    work: Callable[[Job], Outcome], jobs: list[Job], processes: int
) -> Iterator[tuple[Job, Outcome]]:
    """Each job with what came of it, in the order in which they are done; progress on stderr."""
    started = time.perf_counter()
    # a worker that dies ends the whole: a pool of multiprocessing would wait for it for ever
    with ProcessPoolExecutor(processes) as pool:
        waiting = {pool.submit(_named, work, job): job for job in jobs}
        for done, future in enumerate(as_completed(waiting), start=1):
            _tell(f"{done}/{len(jobs)}, {time.perf_counter() - started:.0f} s")
            yield waiting[future], future.result()
    print(f"{len(jobs)} runs, {time.perf_counter() - started:.0f} s", file=sys.stderr)


def outcomes_in_order(
    work: Callable[[Job], Outcome], jobs: list[Job], processes: int
) -> list[tuple[Job, Outcome]]:
    """Each job with what came of it, in the order of the jobs."""
    return sorted(outcomes(work, jobs, processes), key=lambda pair: jobs.index(pair[0]))


def timed(command: Sequence[str], **how: Any) -> tuple[str, float]:
    """What a command prints, and the CPU seconds of it and of what it starts.

    Raises:
        CalledProcessError: it did not end well.
    """
    before = os.times()
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, **how)
    after = os.times()
    cpu = after.children_user + after.children_system
    return done.stdout, cpu - before.children_user - before.children_system


def _tell(progress: str) -> None:
    if sys.stderr.isatty():
        print(progress, end="\r", file=sys.stderr, flush=True)


def _named(work: Callable[[Job], Outcome], job: Job) -> Outcome:
    """Work on a job; an error names it."""
    try:
        return work(job)
    except Exception as error:
        raise RuntimeError(f"{job}: {error}") from error


def _or_nan(value: float | None) -> float:
    return _NAN if value is None else float(value)


def finite(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row as JSON can hold it: None for NaN."""
    return {k: None if isinstance(v, float) and np.isnan(v) else v for k, v in row.items()}
