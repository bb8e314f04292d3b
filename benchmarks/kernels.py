"""Cells per second of what walks along beams, at one and two threads, all of it interleaved.

python benchmarks/kernels.py [--scans 6000] [--beams 360] [--rounds 3]

Cells are those that the beams cross, the same for every line, whatever it does there. The hall is
seen all around and for long: map and elements outgrow caches, as they do in use.
"""

import argparse
import itertools
import math
import statistics
import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from tables import Column, markdown
from wanted import judged

import stillmap
from stillmap import _core
from stillmap.em import observations, occupancy_hmm
from stillmap.sim import Scene, scene_by_name, simulate

RESOLUTION = 0.05  # m
THREADS = (1, 2)
WANTED = 200.0  # M cells/s of M-step and E-step, each at two threads
SEED = 100

Kernel = Callable[[int], object]  # of a number of threads
Seconds = Mapping[tuple[str, int], float]  # by kernel and threads


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_recording_arguments(p, scans=6000)
    p.add_argument("--rounds", type=int, default=3, help="medians are of so many")
    args = p.parse_args()
    sim = simulate(wide_hall(args.scans, args.beams), SEED)
    recording, poses = sim.recording, sim.truth.T_world_base
    cells = cells_crossed(recording.points, recording.offset, recording.T_map_sensor(poses))
    print(f"{recording.n_beams} beams, {cells / 1e6:.1f} M cells crossed, {RESOLUTION} m\n")
    print(speeds(median_seconds(kernels_of(recording, poses), args.rounds), cells))


def add_recording_arguments(p: argparse.ArgumentParser, scans: int) -> None:
    """How much to simulate."""
    p.add_argument("--scans", type=int, default=scans)
    p.add_argument("--beams", type=int, default=360, help="per scan, over 359 degrees")


def wide_hall(scans: int, beams: int) -> Scene:
    """The populated hall, seen all around."""
    laser = {"beams": beams, "fov": math.radians(359)}
    return scene_by_name("hall", {"robot": {"scans": scans}, "laser": laser})


def kernels_of(recording: stillmap.Recording, poses: NDArray[np.float64]) -> dict[str, Kernel]:
    """What is measured, by its name, at true poses (T, 3, 3)."""
    T_map_sensor = recording.T_map_sensor(poses)
    options = stillmap.Options().em
    e = np.full(recording.n_beams, options.prior, np.float32)
    scans = (recording.points, recording.hit, e, recording.offset, T_map_sensor)
    grid = _core.OccupancyGrid2D(RESOLUTION)
    _core.add_beams(grid, *scans, 1)
    surface = observations.build_surfel_map(recording, poses, RESOLUTION)

    def elements(threads: int) -> object:
        seen = observations.make_hmm(surface, options, observations.LOOP_CLASSES)
        observations.add_observations(recording, poses, seen, options.time_bin, threads)
        return seen.likelihood()

    return {
        "M-step: sums of (10)": lambda n: _core.add_beams(
            _core.OccupancyGrid2D(RESOLUTION), *scans, n
        ),
        "likelihood (5)": lambda n: _core.log_likelihood(grid, *scans, options.prior, n),
        "E-step: element pass": elements,
        "E-step": lambda n: occupancy_hmm.e_step(recording, poses, RESOLUTION, options, n),
    }


def median_seconds(kernels: Mapping[str, Kernel], rounds: int) -> Seconds:
    """By name and threads; every kernel once before any runs again, so that all share the noise."""
    seconds: dict[tuple[str, int], list[float]] = {}
    for _, (name, kernel), threads in itertools.product(range(rounds), kernels.items(), THREADS):
        started = time.perf_counter()
        kernel(threads)
        seconds.setdefault((name, threads), []).append(time.perf_counter() - started)
    return {which: statistics.median(times) for which, times in seconds.items()}


def speeds(seconds: Seconds, cells: int) -> str:
    """A line per kernel; wanted is a speed at two threads."""
    lines = []
    for name in dict.fromkeys(name for name, _ in seconds):
        column = Column("", name, ".0f", more_is_better=True)
        speed = [cells / seconds[name, n] / 1e6 for n in THREADS]
        shown = (format(s, column.form) for s in speed)
        lines.append([name, *shown, *judged(column, speed[-1], WANTED)])
    return markdown(["M cells/s", *(f"threads: {n}" for n in THREADS), "wanted", ""], lines)


def cells_crossed(
    points: NDArray[np.float32], offset: NDArray[np.int64], poses: NDArray[np.float64]
) -> int:
    """Cells before the end cell, over all usable beams: borders crossed along each axis."""
    crossed = 0
    for t, T in enumerate(poses):
        p = points[offset[t] : offset[t + 1]].astype(float)
        end = np.floor((p @ T[:2, :2].T + T[:2, 2]) / RESOLUTION)
        crossed += int(np.nansum(np.abs(end - np.floor(T[:2, 2] / RESOLUTION))))
    return crossed


if __name__ == "__main__":
    main()
