"""Long recordings: memory and time of `stillmap map` over the length, scans of 1081 beams at 40 Hz.

python benchmarks/long.py [--world hall] [--scans 5000 20000 80000 288000] [--seed 0]
    [--keep FOLDER] [--set section.key=value ...]

One recording is simulated, as long as the longest; the shorter ones are its beginnings. Neither it
nor its results need fit into memory. With --keep it is looked for in a folder, or put there. Each
length is mapped by a process of its own; its memory is the largest resident size, in which mapped
pages of files count. Steps are CPU ms per scan and iteration.
"""

import dataclasses
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import in_fresh_process, make_parser
from numpy.typing import NDArray
from tables import markdown

from stillmap.core import se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io import stillmap_folder
from stillmap.sim import SCENES, episode, laser, planar, scene_by_name
from stillmap.sim.dynamics import Motion, simulate_motion
from stillmap.sim.scene import Scene

LASER = {"beams": 1081, "fov": math.radians(270.0), "max_range": 30.0}
RATE = 40.0  # Hz
_CHUNK = 1000  # scans that are simulated together


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("--world", choices=SCENES, default="hall")
    p.add_argument("--scans", nargs="+", type=int, default=[5_000, 20_000, 80_000, 288_000])
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--keep", type=Path, metavar="FOLDER")
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as work:
        whole = args.keep or Path(work, "whole")
        if not whole.exists():
            in_fresh_process(write, whole, args.world, max(args.scans), args.seed, Path(work))
        rows = [row_of(whole, scans, args.set, Path(work)) for scans in args.scans]
    print(table(rows))


def write(whole: Path, world: str, scans: int, seed: int, work: Path) -> None:
    stillmap_folder.write(simulated(world, scans, seed, work), whole)


def simulated(world: str, scans: int, seed: int, work: Path) -> Recording:
    """A robot that drives its rounds for so many scans; what it sees goes to files in a folder."""
    scene = scene_by_name(world, {"laser": LASER, "robot": {"scan_rate": RATE, "scans": scans}})
    *rngs, laser_rng, odometry_rng = np.random.default_rng(seed).spawn(6)
    motion = simulate_motion(scene, (rngs[0], rngs[1], rngs[2], rngs[3]), lambda _: None)
    T_odom_base = episode.simulate_odometry(
        se2.matrix(*motion.robot.T), scene.odometry, odometry_rng
    )
    points, hit = ArrayBuilder(np.float32, (2,), work), ArrayBuilder(np.bool_, (), work)
    for first in range(0, scans, _CHUNK):
        seen, met = looked(scene, part_of(motion, slice(first, first + _CHUNK)), laser_rng)
        points.append(seen)
        hit.append(met)
    o = scene.laser
    return Recording(
        stamp_ns=10**18 + np.round(motion.seconds * 1e9).astype(np.int64),
        offset=np.arange(scans + 1, dtype=np.int64) * o.beams,
        points=points.finish(),
        hit=hit.finish(),
        T_base_sensor=se2.matrix(o.x, o.y, o.yaw)[None],
        sensor=np.zeros(scans, np.int32),
        T_odom_base=T_odom_base,
        source=Source(format="simulation", details={"scene": scene.name, "seed": seed}),
    )


def part_of(motion: Motion, scans: slice) -> Motion:
    """The same of some scans."""
    people, outlines, things = motion.people, motion.outlines, motion.things
    robot = motion.robot[scans]
    return dataclasses.replace(
        motion,
        seconds=motion.seconds[scans],
        carried=len(robot),
        paused=len(robot),
        robot=robot,
        poses=motion.poses[scans],
        people=dataclasses.replace(people, xy=people.xy[scans], heading=people.heading[scans]),
        outlines=dataclasses.replace(outlines, faces=outlines.faces[scans]),
        things=dataclasses.replace(things, faces=things.faces[scans]),
    )


def looked(
    scene: Scene, motion: Motion, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """End points (m, 2) in the sensor's frame, and whether something reflected each beam (m,)."""
    o, T = scene.laser, len(motion.robot)
    walls = np.array([*scene.walls, *scene.glass, *motion.still], float)
    exact = planar.cast_sweeps(motion, walls, np.tile(se2.matrix(o.x, o.y, o.yaw), (T, 1, 1)), o)
    is_glass = laser.find_glass(exact.wall, scene)
    ranges, hit = laser.simulate_measurement(exact.range, is_glass, o, rng)
    angles = laser.compute_beam_angles(o.beams, o.fov)
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return points.reshape(-1, 2).astype(np.float32), hit.ravel()


def row_of(whole: Path, scans: int, settings: list[str], work: Path) -> dict[str, Any]:
    """What mapping the first so many scans takes."""
    beginning, out = work / f"first-{scans}", work / f"out-{scans}"
    # a process begins with the peak of the one that starts it: this one has to stay small
    in_fresh_process(write_beginning, whole, scans, beginning)
    chosen = [word for setting in settings for word in ("--set", setting)]
    command = [sys.executable, "-m", "stillmap", "map", str(beginning), "-o", str(out), *chosen]
    process = subprocess.Popen([*command, "--quiet"])
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    run = json.loads((out / "run.json").read_text(encoding="utf-8"))
    row = {
        "scans": scans,
        "iterations": len(run["iterations"]),
        "cpu": used.ru_utime + used.ru_stime,
        "peak": used.ru_maxrss * 1024,
        "stages": run["cpu_seconds"],
        "peaks": run["peak_memory_bytes"],
    }
    print(json.dumps(row), file=sys.stderr, flush=True)
    return row


def write_beginning(whole: Path, scans: int, beginning: Path) -> None:
    stillmap_folder.write(first_scans(stillmap_folder.read(whole), scans), beginning)


def first_scans(recording: Recording, scans: int) -> Recording:
    """The beginning of a recording."""
    beams = slice(0, int(recording.offset[scans]))
    odometry, times = recording.T_odom_base, recording.beam_time
    return dataclasses.replace(
        recording,
        stamp_ns=recording.stamp_ns[:scans],
        offset=recording.offset[: scans + 1],
        points=recording.points[beams],
        hit=recording.hit[beams],
        sensor=recording.sensor[:scans],
        T_odom_base=None if odometry is None else odometry[:scans],
        beam_time=None if times is None else times[beams],
    )


def table(rows: list[dict[str, Any]]) -> str:
    """A line per length: CPU ms per scan, peak MB once each stage had ended."""
    stages = list(rows[0]["stages"])
    lines = []
    for row in rows:
        T, n = row["scans"], row["iterations"]
        steps = [f"{1e3 * row['stages'][name] / T / n:.2f}" for name in ("m_step", "e_step")]
        peaks = [f"{row['peaks'][name] / 1e6:.0f}" for name in stages]
        whole = f"{1e3 * row['cpu'] / T:.2f}"
        lines.append([str(T), str(n), *steps, whole, *peaks, f"{row['peak'] / 1e6:.0f}"])
    titles = ["scans", "iterations", "M-step, ms", "E-step, ms", "whole job, ms"]
    return markdown([*titles, *(f"MB {name}" for name in stages), "peak MB"], lines)


if __name__ == "__main__":
    main()
