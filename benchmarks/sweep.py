"""Time and memory of one M-step and one E-step over a long recording, poses given.

python benchmarks/sweep.py [--scans 20000] [--beams 360] [--threads 2] [--rounds 3]

One process simulates the hall and writes a recording folder; for every round another one reads it,
adds up the map and runs the E-step. Its peak memory is that of a user's process: the simulator's
does not count.
"""

import argparse
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from kernels import (
    RESOLUTION,
    SEED,
    WANTED,
    add_recording_arguments,
    cells_crossed,
    wide_hall,
)
from tables import Column, Row, markdown
from wanted import judged

import stillmap
from stillmap import _core, em
from stillmap.core.profiling import peak_memory_bytes
from stillmap.io import stillmap_folder
from stillmap.sim import simulate

_POSES = "poses.npy"

# what is printed, and its limit
FIGURES: tuple[tuple[Column, float | None], ...] = (
    (Column("m_step", "M-step: sums of (10), s", ".2f"), None),
    (Column("e_step", "E-step, s", ".2f"), None),
    (Column("sweep", "both, s", ".2f"), 10.0),
    (Column("m_speed", "M-step, M cells/s", ".0f", True), WANTED),
    (Column("e_speed", "E-step, M cells/s", ".0f", True), WANTED),
    (Column("loaded", "peak memory once read, MB", ".0f"), None),
    (Column("peak", "peak memory, MB", ".0f"), 500.0),
)

Outcome = TypeVar("Outcome")


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_recording_arguments(p, scans=20_000)
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--rounds", type=int, default=3, help="processes measured, one after another")
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as work:
        cells = in_fresh_process(write, Path(work), args.scans, args.beams)
        rounds = [in_fresh_process(sweep, Path(work), args.threads) for _ in range(args.rounds)]
    print(f"{args.scans} scans x {args.beams} beams, {cells / 1e6:.0f} M cells crossed", end=", ")
    print(f"{RESOLUTION} m, {args.threads} threads, {args.rounds} processes\n")
    print(against_wanted([{**r, **speeds(r, cells)} for r in rounds]))


def in_fresh_process(work: Callable[..., Outcome], *args: object) -> Outcome:
    """What `work` returns, from a process that has done nothing else."""
    # Linux hands the peak of a process down to the one that it starts, not to what that one forks
    with multiprocessing.get_context("forkserver").Pool(1) as pool:
        return pool.apply(work, args)


def write(work: Path, scans: int, beams: int) -> int:
    """Writes a recording folder and the true poses into `work`; cells that the beams cross."""
    sim = simulate(wide_hall(scans, beams), SEED)
    recording, poses = sim.recording, sim.truth.T_world_base
    stillmap_folder.write(recording, work / "recording")
    np.save(work / _POSES, poses)
    return cells_crossed(recording.points, recording.offset, recording.T_map_sensor(poses))


def sweep(work: Path, threads: int) -> dict[str, float]:
    """Seconds of the two steps and the peak memory of this process in MB, before and after."""
    recording, poses = stillmap.read(work / "recording"), np.load(work / _POSES)
    options = stillmap.Options().em
    e = em.initial_p_static(recording, "stillmap", options)
    loaded, started = peak_memory_bytes(), time.perf_counter()
    grid = _core.OccupancyGrid2D(RESOLUTION)
    em.add_recording(grid, recording, poses, e, threads)
    summed = time.perf_counter()
    em.e_step(recording, poses, grid, "stillmap", options, threads)
    done = time.perf_counter()
    return {
        "m_step": summed - started,
        "e_step": done - summed,
        "sweep": done - started,
        "loaded": loaded / 1e6,
        "peak": peak_memory_bytes() / 1e6,
    }


def speeds(row: Row, cells: int) -> dict[str, float]:
    """M cells/s of the two steps."""
    return {f"{step}_speed": cells / row[f"{step}_step"] / 1e6 for step in ("m", "e")}


def against_wanted(rounds: Sequence[Row]) -> str:
    """Median and worst of the rounds; the median is what is judged, of memory the worst."""
    lines = []
    for column, limit in FIGURES:
        values = column.values(rounds)
        median, worst = statistics.median(values), column.worst(values)
        shown = [format(value, column.form) for value in (median, worst)]
        verdict = judged(column, worst if column.key == "peak" else median, limit)
        lines.append([column.title, *shown, *verdict])
    return markdown(["one sweep", "median", "worst", "wanted", ""], lines)


if __name__ == "__main__":
    main()
