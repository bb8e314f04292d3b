"""Long recordings in space: time per sweep and memory over their length, poses given.

python benchmarks/space_growth.py [--world drive] [--sweeps 100 1000 5000] [--lidar 64]
    [--columns 450] [--seed 0] [--threads 2] [--keep FOLDER]
    [--set section.key=value ...]

One recording is simulated, as long as the longest; the shorter ones are its beginnings. A robot
that comes to the end of its route turns back. With --keep the recording is looked for in a folder,
or put there: 1.3 MB a sweep of 64 channels and 900 columns. Each length has a process of its own,
which reads the recording, labels it and writes the result; its memory is the largest resident size,
in which mapped pages of files count. "m2 seen" are squares of a metre in which beams ended: memory
may grow with these, time per sweep not at all.
"""

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import in_fresh_process, make_parser
from long import first_scans
from numpy.typing import NDArray
from tables import markdown

import stillmap
from stillmap.core import config
from stillmap.core.profiling import StageTimer, peak_memory_bytes
from stillmap.io import stillmap_folder
from stillmap.pipeline.result import map_recording
from stillmap.results.writer import save
from stillmap.sim import SCENES, load_truth, scene_by_name, simulate, write_simulation

Float = NDArray[np.float64]

_POSES = "poses.npy"
_SHOWN = 0.03  # share of the time that a stage takes at least to be printed
_WIDE = 1 << 20  # m: no simulated world is wider


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("--world", choices=SCENES, default="drive")
    p.add_argument("--sweeps", nargs="+", type=int, default=[100, 1000, 5000])
    p.add_argument("--lidar", type=int, default=64, metavar="CHANNELS")
    p.add_argument("--columns", type=int, default=450, help="azimuths per turn")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--keep", type=Path, metavar="FOLDER")
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    args = p.parse_args()
    chosen = options_of(args.set, args.threads)  # refuses before hours have passed
    with tempfile.TemporaryDirectory() as work:
        whole = args.keep or Path(work, "whole")
        if not whole.exists():
            lidar = {"channels": args.lidar, "columns": args.columns}
            changes = {"lidar": lidar, "robot": {"scans": max(args.sweeps)}}
            in_fresh_process(write, whole, args.world, changes, args.seed)
        rows = []
        for sweeps in args.sweeps:
            first, out = Path(work, f"first-{sweeps}"), Path(work, f"out-{sweeps}")
            about = in_fresh_process(write_beginning, whole, sweeps, first)
            cost = in_fresh_process(cost_of, first, chosen, out)
            shutil.rmtree(first)
            shutil.rmtree(out)
            rows.append({"sweeps": sweeps, **about, **cost})
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    print(table(rows))


def options_of(settings: Sequence[str], threads: int) -> stillmap.Options:
    changes = config.merge_nested(*(config.parse_assignment(text) for text in settings))
    return config.override(stillmap.Options(), {"threads": threads, **changes})


def write(whole: Path, world: str, changes: dict[str, Any], seed: int) -> None:
    write_simulation(simulate(scene_by_name(world, changes), seed), whole)


def write_beginning(whole: Path, sweeps: int, first: Path) -> dict[str, float]:
    """Writes the first sweeps and their true poses; how far the robot went, how much it saw."""
    recording, poses = stillmap_folder.read(whole), load_truth(whole).T_world_base[:sweeps]
    part = first_scans(recording, sweeps).without_odometry()
    stillmap_folder.write(part, first)
    np.save(first / _POSES, poses)
    return size_of(part, poses)


def size_of(recording: stillmap.Recording, poses: Float) -> dict[str, float]:
    """Metres driven, squares of a metre in which beams ended, and beams per sweep."""
    seen = np.zeros(0, np.int64)
    for t in recording.iter_scans(range(recording.n_scans)):
        beams = recording.beams_of(t)
        points = recording.points[beams][recording.hit[beams]].astype(float)
        T = (poses[t] @ recording.T_base_sensor[recording.sensor[t]])[:2]
        x, y = np.floor(points @ T[:, :3].T + T[:, 3]).astype(np.int64).T
        seen = np.union1d(seen, x * _WIDE + y)
    metres = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum()
    beams_each = recording.n_beams / recording.n_scans
    return {"metres": float(metres), "area": float(len(seen)), "beams": beams_each}


def cost_of(first: Path, chosen: stillmap.Options, out: Path) -> dict[str, Any]:
    """Seconds per sweep and peak memory of the whole job, and of its stages."""
    recording, poses = stillmap_folder.read(first), np.load(first / _POSES)
    sweeps = recording.n_scans
    stages, wall, cpu = StageTimer(), time.perf_counter(), time.process_time()
    loaded = peak_memory_bytes()
    result = map_recording(recording, chosen, poses=poses, stages=stages)
    with stages.measure("writing"):
        save(result, out)
    took = {**result.stages, **stages.to_dict()}
    return {
        "seconds": (time.perf_counter() - wall) / sweeps,
        "cpu": (time.process_time() - cpu) / sweeps,
        "iterations": len(result.iterations),
        "loaded": loaded / 1e6,
        "peak": peak_memory_bytes() / 1e6,
        "stages": {name: one["seconds"] / sweeps for name, one in took.items()},
        "peaks": {name: one["peak_memory_bytes"] / 1e6 for name, one in took.items()},
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A line per length: ms per sweep of the stages that take any, and peaks once they ended."""
    last = rows[-1]["stages"]
    stages = [name for name in last if last[name] >= _SHOWN * rows[-1]["seconds"]]
    labelling = [name for name in ("m_step", "e_step", "surface", "movers") if name in last]
    lines = [
        [
            str(row["sweeps"]),
            f"{row['metres']:.0f}",
            f"{row['area']:.0f}",
            *(f"{1e3 * row['stages'][name]:.1f}" for name in stages),
            f"{1e3 * row['seconds']:.0f}",
            f"{1e3 * row['cpu']:.0f}",
            f"{row['loaded']:.0f}",
            *(f"{row['peaks'][name]:.0f}" for name in labelling),
            f"{row['peak']:.0f}",
            f"{1e3 * (row['peak'] - row['loaded']) / row['area']:.1f}",
        ]
        for row in rows
    ]
    titles = ["sweeps", "m driven", "m2 seen", *(f"{name}, ms per sweep" for name in stages)]
    titles += ["whole job, ms", "CPU, ms", "peak MB once read"]
    return markdown([*titles, *(f"{name}" for name in labelling), "job", "kB per m2"], lines)


if __name__ == "__main__":
    main()
