"""Live mapping in 3D: poses and labels at the time beside batch, and how long a sweep takes.

python benchmarks/live_sweeps.py [--worlds street crossing hall] [--channels 64] [--scans 300]
    [--seed 11] [--no-batch] [--threads 2]
python benchmarks/live_sweeps.py --kitti drive0005_000-076.npz

Simulated worlds: error of the poses against the truth, F1 of "dynamic" over the hits after the
first 2 s, at the time and at the end, and the same of `stillmap.build`. Movers that stand still so
far cannot be known: recall of those that have moved by then is told apart. ms: of
`LiveMapper.push`, loops closed in another process, sweeps pushed at 10 Hz.
kitti: a pack with labels (1: moving, 0: static, -1: unknown), points from 2.5 to 50 m.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from tables import markdown

from stillmap import Scan, build
from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate

_WARM_UP = 20  # sweeps
_RATE = 10.0  # Hz
_MOVED = 1.0  # m from where it was first seen: a mover has moved
_TITLES = ("world", "sweeps", "beams", "m off: live", "batch", "F1 live", "at the end", "batch")
_FURTHER = ("precision", "recall of what has moved", "ms: median", "99 %", "max", "late", "loops")


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--worlds", nargs="+", default=["street", "crossing", "hall"])
    p.add_argument("--channels", type=int, default=64)
    p.add_argument("--columns", type=int, default=1024)
    p.add_argument("--scans", type=int, default=300)
    p.add_argument("--seed", type=int, default=11)
    p.add_argument("--no-batch", action="store_true")
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--kitti", type=Path)
    args = p.parse_args()
    if args.kitti:
        print(score_kitti(args.kitti, args.threads))
        return
    lines = []
    for world in args.worlds:
        lines.append([world, *map_world(world, args)])
        print(" | ".join(lines[-1]), flush=True)
    print(markdown([*_TITLES, *_FURTHER], lines))


def map_world(world: str, args: argparse.Namespace) -> list[str]:
    """A line of a simulated world."""
    lidar = {"channels": args.channels, "columns": args.columns}
    scene = scene_by_name(world, {"lidar": lidar, "robot": {"scans": args.scans}})
    simulation = simulate(scene, args.seed)
    recording, truth = simulation.recording, simulation.truth
    poses, at_once, later, ms, late, loops = _push(recording, args.threads)
    use = recording.hit.copy()
    use[: recording.offset[_WARM_UP]] = False
    moves = ~truth.static
    has_moved = use & moves & _has_moved(recording, truth)
    says = at_once < 0.5
    batch = ["", ""]
    if not args.no_batch:
        result = build(recording, {"threads": args.threads})
        batch = [f"{_off(result.poses, truth):.3f}", f"{_f1(result.p_static, moves, use):.3f}"]
    precision = (says & moves & use).sum() / max((says & use).sum(), 1)
    return [
        str(recording.n_scans),
        str(recording.n_beams // recording.n_scans),
        f"{_off(poses, truth):.3f}",
        batch[0],
        f"{_f1(at_once, moves, use):.3f}",
        f"{_f1(later, moves, use):.3f}",
        batch[1],
        f"{precision:.3f}",
        f"{says[has_moved].mean():.3f}",
        *(f"{x:.0f}" for x in (np.median(ms), np.quantile(ms, 0.99), ms.max())),
        str(late),
        str(loops),
    ]


def _push(recording, threads: int):
    """Poses and labels at the time, labels 5 s later, ms of each sweep, how many were late, and
    how often the map was corrected."""
    poses, ms, late, loops, offset = [], [], 0, 0, None
    at_once = np.full(recording.n_beams, np.nan, np.float32)
    later = at_once.copy()
    with LiveMapper({"threads": threads}, background=True) as mapper:
        kept = []
        start = time.perf_counter()
        for t, beams in enumerate(iter_beams(recording)):
            due = start + t / _RATE
            late += time.perf_counter() > due + 1.0 / _RATE
            time.sleep(max(due - time.perf_counter(), 0.0))
            began = time.perf_counter()
            update = mapper.push(beams)
            ms.append(1e3 * (time.perf_counter() - began))
            poses.append(update.pose)
            at_once[recording.beams_of(t)] = update.p_static
            moved = mapper._slam.frame.T_map_local
            loops += offset is not None and not np.array_equal(moved, offset)
            offset = moved
            kept.append(beams)
        for t, beams in enumerate(kept):
            later[recording.beams_of(t)] = mapper.label(beams, t)
    return np.array(poses), at_once, later, np.array(ms), late, loops


def _has_moved(recording, truth):
    """(M,) whether the mover that a beam met has moved since it was seen first."""
    mover, places = truth.mover, truth.movers
    out = np.zeros(recording.n_beams, bool)
    first = {}
    for t in range(recording.n_scans):
        beams = recording.beams_of(t)
        seen = np.unique(mover[beams][mover[beams] >= 0])
        for k in seen.tolist():
            here = places[t, k, :2]
            begin = first.setdefault(k, here)
            if np.hypot(*(here - begin)) >= _MOVED:
                out[beams] |= mover[beams] == k
    return out


def _off(poses, truth) -> float:
    """Mean distance from the truth, m, after the warm-up."""
    true = se2.inverse(truth.T_world_base[0]) @ truth.T_world_base
    off = (se2.inverse(poses[0]) @ poses - true)[_WARM_UP:, :3, 3]
    return float(np.linalg.norm(off, axis=1).mean())


def _f1(p_static, moves, use) -> float:
    says = (p_static < 0.5) & use
    return float(2 * (says & moves).sum() / max(says.sum() + (moves & use).sum(), 1))


def score_kitti(path: Path, threads: int) -> str:
    """SA and DA of the labels at the time and 5 s later, in per cent."""
    pack = np.load(path)
    points = pack["xyz_2p5mm"].astype(np.float32) * np.float32(0.0025)
    offset, label = pack["offset"], pack["label"]
    ms, at_once, later, scans = [], [], [], []
    with LiveMapper({"threads": threads}, background=True) as mapper:
        for t in range(len(offset) - 1):
            xyz = points[offset[t] : offset[t + 1]]
            scans.append(Scan(t / _RATE, points=xyz))
            began = time.perf_counter()
            at_once.append(mapper.push(scans[-1]).p_static)
            ms.append(1e3 * (time.perf_counter() - began))
        later = [mapper.label(scan, t) for t, scan in enumerate(scans)]
    range_ = np.linalg.norm(points.astype(np.float64), axis=1)
    use = (range_ >= 2.5) & (range_ < 50.0) & (label >= 0)
    lines = []
    for name, p in (("at the time", at_once), ("at the end", later)):
        says = np.concatenate(p) < 0.5
        sa = 100 * (~says[use & (label == 0)]).mean()
        da = 100 * says[use & (label == 1)].mean()
        lines.append([name, f"{sa:.1f}", f"{da:.1f}", f"{2 * sa * da / (sa + da):.1f}"])
    ms = np.array(ms)
    print(f"ms: median {np.median(ms):.0f}, 99 % {np.quantile(ms, 0.99):.0f}, max {ms.max():.0f}")
    return markdown(["labels", "SA", "DA", "HA"], lines)


if __name__ == "__main__":
    main()
