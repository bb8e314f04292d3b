"""Cells per second of the kernels that walk along beams, at one and two threads, interleaved.

python benchmarks/kernels.py [--rounds 5]
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np

from stillmap import _core
from stillmap.simulation import scene_by_name, simulate

RESOLUTION = 0.05


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--rounds", type=int, default=5)
    rounds = p.parse_args().rounds
    sim = simulate(scene_by_name("hall", {"robot": {"scans": 4000}}), 100)
    recording, poses = sim.recording, sim.recording.T_map_sensor(sim.truth.T_world_base)
    beams = (recording.points, recording.hit)
    e = np.full(recording.n_beams, 0.9, np.float32)
    cells = cells_crossed(recording.points, recording.offset, poses)
    grid = _core.Grid2D(RESOLUTION)
    _core.add_beams(grid, *beams, e, recording.offset, poses, 1)
    kernels: dict[str, Callable[[int], object]] = {
        "add_beams": lambda n: _core.add_beams(
            _core.Grid2D(RESOLUTION), *beams, e, recording.offset, poses, n
        ),
        "log_likelihood": lambda n: _core.log_likelihood(
            grid, *beams, e, recording.offset, poses, 0.9, n
        ),
    }
    print(f"{recording.n_beams} beams, {cells / 1e6:.1f} M cells crossed, {RESOLUTION} m")
    for name, kernel in kernels.items():
        seconds: dict[int, list[float]] = {1: [], 2: []}
        for _ in range(rounds):
            for threads, times in seconds.items():
                started = time.perf_counter()
                kernel(threads)
                times.append(time.perf_counter() - started)
        one, two = (statistics.median(seconds[n]) for n in (1, 2))
        print(
            f"{name:15} 1 thread {cells / one / 1e9:.2f} G cells/s, "
            f"2 threads {cells / two / 1e9:.2f} G cells/s"
        )


def cells_crossed(points: np.ndarray, offset: np.ndarray, poses: np.ndarray) -> int:
    """Cells before the end cell, over all usable beams: borders crossed along each axis."""
    crossed = 0
    for t, T in enumerate(poses):
        p = points[offset[t] : offset[t + 1]].astype(float)
        end = np.floor((p @ T[:2, :2].T + T[:2, 2]) / RESOLUTION)
        crossed += int(np.nansum(np.abs(end - np.floor(T[:2, 2] / RESOLUTION))))
    return crossed


if __name__ == "__main__":
    main()
