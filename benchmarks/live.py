"""Live mapping: poses and labels as they were given at the time, and how long that took.

python benchmarks/live.py logs LOGS [--names intel fr101] --data DIR [--finish]
    [--karto-python PYTHON] [--starts 0 30 60]
python benchmarks/live.py labels [--worlds hall corridor] [--first-seed 11] [--seeds 2]
python benchmarks/live.py localize --data DIR [--worlds hall office] [--starts 100] [--people N]
    [--scans 30]
python benchmarks/live.py latency [--world hall] [--seconds 600] [--rate 40] [--beams 1081]

logs: each NAME.clf.gz with NAME.exact.relations or NAME.pseudo.relations beside it: relation
errors of `stillmap live --replay`, of the poses at the time and at the end, beside those of
`stillmap map`, of `LiveMapper.finish()` and of Karto, see live_logs.py.
labels: F1 of "dynamic", average precision and calibration error (equal-mass bins) by the lag after
which a beam is labelled, seconds.
localize: the robot is put down at random places of a known map, and has some scans to find out
where it is: right within 0.3 m. Then it is localized for 30 scans more: the mean of its squared
errors by its covariance (NEES, of 3), and the share of them within the 95 % ellipsoid.
latency: scans pushed at their own pace, loops closed in another process.
"""

import argparse
import itertools
import math
import resource
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import live_logs
import numpy as np
from common import make_parser
from tables import markdown

from stillmap import build, load
from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.eval.labels import assign_equal_mass_bins, compute_calibration_error
from stillmap.results.eval.map import GHOST_DISTANCE, distance_to_walls
from stillmap.results.eval.trajectory import align, compute_absolute_errors
from stillmap.results.reader import Grid, moved
from stillmap.sim import scene_by_name, simulate

_MAP_SEED, _OTHER_SEED, _TRACKED = 11, 12, 30
_WITHIN_95 = 7.815  # quantile of chi square with 3 degrees of freedom
_LAGS = (0.0, 1.0, 5.0, 30.0, math.inf)  # s


def main() -> None:
    args = _parser().parse_args()
    print(args.run(args), flush=True)


def _parser() -> argparse.ArgumentParser:
    p = make_parser(__doc__)
    commands = p.add_subparsers(required=True)
    logs = commands.add_parser("logs")
    logs.set_defaults(run=live_logs.map_logs)
    live_logs.add_arguments(logs)
    labels = commands.add_parser("labels")
    labels.set_defaults(run=score_labels)
    labels.add_argument("--worlds", nargs="+", default=["hall", "corridor"])
    labels.add_argument("--first-seed", type=int, default=11)
    labels.add_argument("--seeds", type=int, default=2)
    localize = commands.add_parser("localize")
    localize.set_defaults(run=localize_globally)
    localize.add_argument(
        "--worlds", nargs="+", default=["hall", "office", "warehouse", "corridor"]
    )
    localize.add_argument("--starts", type=int, default=100)
    localize.add_argument("--scans", type=int, default=30, help="until it must be found")
    localize.add_argument("--seed", type=int, default=_MAP_SEED, help="of the map")
    localize.add_argument("--robot-in", metavar="WORLD", help="another one: found is wrong")
    localize.add_argument("--people", type=int, help="default: as many as the world has")
    localize.add_argument("--data", type=Path, required=True, help="folder for maps")
    latency = commands.add_parser("latency")
    latency.set_defaults(run=measure_latency)
    latency.add_argument("--world", default="hall")
    latency.add_argument("--seconds", type=float, default=600.0)
    latency.add_argument("--rate", type=float, default=40.0)
    latency.add_argument("--beams", type=int, default=1081)
    return p


def score_labels(args: argparse.Namespace) -> str:
    """A line per world and seed, F1 / AP / ECE for each lag."""
    lines = []
    for world in args.worlds:
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            simulation = simulate(scene_by_name(world), seed)
            recording, static = simulation.recording, simulation.truth.static
            hit = recording.hit
            by_lag, poses, ghosts = _label_by_lag(simulation)
            scores = [_score(p[hit], static[hit]) for p in by_lag]
            error = compute_absolute_errors(poses, simulation.truth.T_world_base)
            line = [f"{f1:.3f} / {ap:.3f} / {ece:.3f}" for f1, ap, ece in scores]
            lines.append([world, str(seed), *line, f"{error.rmse:.3f}", f"{ghosts:.1f}"])
            print(" | ".join(lines[-1]), flush=True)
    lags = [f"{lag:g} s" if math.isfinite(lag) else "end" for lag in _LAGS]
    return markdown(["world", "seed", *lags, "ATE m", "ghosts per 100 m2"], lines)


def _label_by_lag(simulation):
    """P(static) of all beams (M,) for each lag, the poses as they were given, and ghosts of the map
    per 100 m2 that stay for 10 s, the mean over time."""
    recording, walls = simulation.recording, simulation.truth.walls
    T_world_map = simulation.truth.T_world_base[0]
    mapper, poses, ghosts = LiveMapper(), [], []
    seen, due = set(), recording.stamp_ns[0]
    by_lag = [np.full(recording.n_beams, np.nan, np.float32) for _ in _LAGS]
    waiting = [deque() for _ in _LAGS]
    for t, beams in enumerate(iter_beams(recording)):
        odometry = None if recording.T_odom_base is None else recording.T_odom_base[t]
        update = mapper.push(beams, odometry)
        poses.append(update.pose)
        by_lag[0][recording.beams_of(t)] = update.p_static
        if beams.stamp_ns >= due:
            due, before = due + 10 * 10**9, seen
            seen, free = _find_ghosts(mapper.map, T_world_map, walls)
            ghosts.append(100.0 * len(seen & before) / max(free, 1.0))
        for lag, scans, out in zip(_LAGS[1:], waiting[1:], by_lag[1:], strict=True):
            scans.append((t, beams))
            while scans and beams.stamp_ns - scans[0][1].stamp_ns >= 1e9 * lag:
                s, earlier = scans.popleft()
                out[recording.beams_of(s)] = mapper.label(earlier, s)
    for scans, out in zip(waiting[1:], by_lag[1:], strict=True):
        for s, earlier in scans:
            out[recording.beams_of(s)] = mapper.label(earlier, s)
    mapper.close()
    return by_lag, np.array(poses), float(np.mean(ghosts))


def _find_ghosts(grid, T_world_map, walls):
    """Cells far from every wall that the map shows as occupied, and its free area in m2."""
    grid = Grid(grid.p_occupied, grid.origin, grid.resolution)
    rows = np.argwhere(grid.occupied)
    centres = grid.centres(rows)
    far = distance_to_walls(moved(T_world_map, centres), walls) > GHOST_DISTANCE * grid.resolution
    cells = np.floor(centres[far] / grid.resolution).astype(int)
    return set(map(tuple, cells.tolist())), float(grid.free.sum()) * grid.resolution**2


def _score(p_static, static) -> tuple[float, float, float]:
    """F1 of "dynamic", average precision, and expected calibration error of P(static)."""
    says, moves = p_static < 0.5, ~static
    f1 = 2 * np.count_nonzero(says & moves) / max(says.sum() + moves.sum(), 1)
    found = moves[np.argsort(p_static, kind="stable")]
    precision = np.cumsum(found) / np.arange(1, len(found) + 1)
    ap = float(precision[found].mean()) if found.any() else float("nan")
    p = p_static.astype(np.float64)
    return float(f1), ap, compute_calibration_error(p, static, assign_equal_mass_bins(p))


def localize_globally(args: argparse.Namespace) -> str:
    """A line per world."""
    lines = []
    for world in args.worlds:
        place = build_known_map(args.data / world, world, args.seed)
        crowd = {} if args.people is None else {"crowd": {"people": args.people}}
        simulation = simulate(scene_by_name(args.robot_in or world, crowd), args.seed + 1)
        rng = np.random.default_rng(0)
        last = simulation.recording.n_scans - args.scans - _TRACKED
        runs = [
            _localize_from(*place, simulation, int(first), args.scans)
            for first in rng.integers(0, last, args.starts)
        ]
        lines.append([world, str(args.starts), *_summarize(runs)])
        print(" | ".join(lines[-1]), flush=True)
    titles = ["world", "places", "right", "wrong", "ambiguous", "lost", "scans", "m off"]
    times = ["CPU s of a scan with a search: median", "at most"]
    return markdown([*titles, *times, "NEES", "within 95 %"], lines)


def _summarize(runs) -> list[str]:
    """Verdicts, medians of those that are right, times of all searches, and NEES."""
    verdicts = [one.verdict for one in runs]
    counts = [str(verdicts.count(v)) for v in ("right", "wrong", "ambiguous", "lost")]
    right = [one for one in runs if one.verdict == "right"]
    if not right:
        return counts
    medians = [
        f"{np.median([r.scans for r in right]):.0f}",
        f"{np.median([r.off for r in right]):.3f}",
    ]
    seconds = [s for one in runs for s in one.seconds]
    nees = np.concatenate([one.nees for one in right])
    times = [f"{np.median(seconds):.2f}", f"{max(seconds):.2f}"]
    within = f"{(nees < _WITHIN_95).mean():.2f}"
    return [*counts, *medians, *times, f"{nees.mean():.1f}", within]


def build_known_map(folder: Path, world: str, seed: int = _MAP_SEED):
    """The map of another run, and the pose of the world in it: by all poses of that run, since the
    first one alone is off by some hundredths of a radian."""
    simulation = simulate(scene_by_name(world), seed)
    if not (folder / "run.json").exists():
        build(simulation.recording, {"threads": 1}).save(folder)
    return folder, align(simulation.truth.T_world_base, load(folder).poses)


@dataclass
class _Start:
    """A robot put down somewhere: what was found, in how many scans, m off, s of each search, and
    the normalized squared errors from then on."""

    verdict: str
    scans: int
    off: float
    seconds: list[float]
    nees: list[float]


def _localize_from(known: Path, T_map_world, simulation, first: int, scans: int) -> _Start:
    out = _Start("lost", scans, math.inf, [], [])
    odometry = simulation.recording.T_odom_base
    with LiveMapper({"threads": 1}, place=known) as mapper:
        rest = itertools.islice(iter_beams(simulation.recording), first, None)
        for t, beams in enumerate(rest, first):
            start = time.process_time()
            update = mapper.push(beams, odometry[t])
            true = T_map_world @ simulation.truth.T_world_base[t]
            if out.verdict == "right":
                out.nees.append(normalized_error(update, true))
            else:
                out.seconds.append(time.process_time() - start)
            if "lost" not in update.doubts and out.verdict != "right":
                out.scans, out.off = t - first + 1, float(np.hypot(*(update.pose - true)[:2, 2]))
                out.verdict = "right" if out.off < 0.3 else "wrong"
            elif out.verdict == "lost" and t == first + scans - 1:
                out.verdict = "ambiguous" if "ambiguous" in update.doubts else "lost"
                break
            if out.verdict == "wrong" or len(out.nees) == _TRACKED:
                break
    return out


def normalized_error(update, true) -> float:
    """Squared error of a pose by its covariance."""
    d = se2.parameters(update.pose) - se2.parameters(true)
    d[2] = se2.wrap(d[2])
    return float(d @ np.linalg.solve(update.covariance, d))


def measure_latency(args: argparse.Namespace) -> str:
    """One line: latencies, memory and poses."""
    changes = {
        "laser": {"beams": args.beams, "fov": math.radians(270)},
        "robot": {"scans": round(args.seconds * args.rate), "scan_rate": args.rate},
    }
    simulation = simulate(scene_by_name(args.world, changes), 1)
    recording, before = simulation.recording, _peak_mb()
    mapper, poses, seconds, late = LiveMapper(background=True), [], [], 0
    start = time.perf_counter()
    for t, beams in enumerate(iter_beams(recording)):
        due = start + t / args.rate
        late += time.perf_counter() > due + 1.0 / args.rate
        time.sleep(max(due - time.perf_counter(), 0.0))
        began = time.perf_counter()
        poses.append(mapper.push(beams, recording.T_odom_base[t]).pose)
        seconds.append(time.perf_counter() - began)
        mapper.update_map()
    mapper.close()
    ms = 1e3 * np.array(seconds)
    error = compute_absolute_errors(np.array(poses), simulation.truth.T_world_base)
    line = [f"{np.median(ms):.1f}", f"{np.quantile(ms, 0.99):.1f}", f"{ms.max():.1f}", str(late)]
    line += [f"{_peak_mb() - before:.0f}", f"{error.rmse:.3f}"]
    return markdown(["median ms", "99 %", "max", "late", "MB more at peak", "ATE m"], [line])


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
