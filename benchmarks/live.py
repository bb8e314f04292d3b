"""Live mapping: poses and labels as they were given at the time, and how long that took.

python benchmarks/live.py logs LOGS [--names intel fr101] --data DIR
python benchmarks/live.py labels [--worlds hall corridor] [--first-seed 11] [--seeds 2]
python benchmarks/live.py localize --data DIR [--worlds hall office] [--starts 25] [--people N]
python benchmarks/live.py crowds --data DIR [--world hall] [--people 0 30 60 120] [--runs 5]
python benchmarks/live.py latency [--world hall] [--seconds 600] [--rate 40] [--beams 1081]

logs: each NAME.clf.gz with NAME.exact.relations or NAME.pseudo.relations beside it: relation
errors of `stillmap live --replay`, of the poses at the time and at the end, beside those of
`stillmap map`.
labels: F1 of "dynamic" and average precision by the lag after which a beam is labelled, seconds.
localize: the robot is put down at random places of a known map, and has 30 scans to find out where
it is: right within 0.3 m.
crowds: runs of 400 scans through a known map among people: localized with P(static) and without,
and by a particle filter with a likelihood field that is told where it starts. Lost: the last 50
poses are more than 0.5 m off on average.
latency: scans pushed at their own pace, loops closed in another process.
"""

import argparse
import itertools
import math
import resource
import time
from collections import deque
from pathlib import Path

import numpy as np
import session_merging as merging
from particle_filter import ParticleFilter
from tables import markdown

from stillmap import build, load
from stillmap.core import se2
from stillmap.eval.map import GHOST_DISTANCE, distance_to_walls
from stillmap.eval.readers import read_planar_trajectory, read_relations
from stillmap.eval.relations import compute_relation_errors
from stillmap.eval.trajectory import align, compute_absolute_errors
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.reader import Grid, moved, read_grid
from stillmap.sim import scene_by_name, simulate

_LOGS = ("intel", "aces", "belgioioso", "edmonton", "fr101", "seattle")
_MAP_SEED, _OTHER_SEED, _SCANS_TO_LOCALIZE = 11, 12, 30
_SCANS_IN_CROWDS = 400
_LAGS = (0.0, 1.0, 5.0, 30.0, math.inf)  # s


def main() -> None:
    args = _parser().parse_args()
    print(args.run(args), flush=True)


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = p.add_subparsers(required=True)
    logs = commands.add_parser("logs")
    logs.set_defaults(run=map_logs)
    logs.add_argument("folder", type=Path)
    logs.add_argument("--names", nargs="+", default=list(_LOGS))
    logs.add_argument("--data", type=Path, required=True, help="folder for results")
    logs.add_argument("--program", nargs="+", default=merging.default_program())
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
    localize.add_argument("--starts", type=int, default=25)
    localize.add_argument("--people", type=int, help="default: as many as the world has")
    localize.add_argument("--data", type=Path, required=True, help="folder for maps")
    crowds = commands.add_parser("crowds")
    crowds.set_defaults(run=localize_in_crowds)
    crowds.add_argument("--world", default="hall")
    crowds.add_argument("--people", nargs="+", type=int, default=[0, 30, 60, 120])
    crowds.add_argument("--runs", type=int, default=5)
    crowds.add_argument("--data", type=Path, required=True, help="folder for maps")
    latency = commands.add_parser("latency")
    latency.set_defaults(run=measure_latency)
    latency.add_argument("--world", default="hall")
    latency.add_argument("--seconds", type=float, default=600.0)
    latency.add_argument("--rate", type=float, default=40.0)
    latency.add_argument("--beams", type=int, default=1081)
    return p


def map_logs(args: argparse.Namespace) -> str:
    """A line per log."""
    lines = []
    for name in args.names:
        log = args.folder / f"{name}.clf.gz"
        kinds = ("exact.relations", "pseudo.relations")
        relations = next(p for kind in kinds if (p := args.folder / f"{name}.{kind}").exists())
        batch, live = args.data / f"batch-{name}", args.data / f"live-{name}"
        if not (batch / "run.json").exists():
            merging.build_map(args.program, log, batch)
        done = merging.call(args.program, "live", "--replay", log, "--threads", 1, "-o", live)
        runs = [batch / "trajectory.tum", live / "live/trajectory.tum", live / "trajectory.tum"]
        errors = [_relation_error(run, relations) for run in runs]
        line = [f"{t:.4f} / {r:.3f}" for t, r in errors]
        lines.append([name, *line, f"{errors[1][0] / errors[0][0]:.2f}", f"{done.cpu:.0f}"])
        print(" | ".join(lines[-1]), flush=True)
    titles = ["log", "batch: m / deg", "live, at the time", "live, at the end", "ratio", "CPU s"]
    return markdown(titles, lines)


def _relation_error(trajectory: Path, relations: Path) -> tuple[float, float]:
    """Mean translational (m) and rotational (degrees) error."""
    errors = compute_relation_errors(
        read_planar_trajectory(trajectory), read_relations(relations), None, 0.1, False
    )
    return errors.translation.mean, errors.rotation.mean


def score_labels(args: argparse.Namespace) -> str:
    """A line per world and seed, F1 / AP for each lag."""
    lines = []
    for world in args.worlds:
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            simulation = simulate(scene_by_name(world), seed)
            recording, static = simulation.recording, simulation.truth.static
            hit = recording.hit
            by_lag, poses, ghosts = _label_by_lag(simulation)
            scores = [_score(p[hit], static[hit]) for p in by_lag]
            error = compute_absolute_errors(poses, simulation.truth.T_world_base)
            line = [f"{f1:.3f} / {ap:.3f}" for f1, ap in scores]
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


def _score(p_static, static) -> tuple[float, float]:
    """F1 of "dynamic" and average precision."""
    says, moves = p_static < 0.5, ~static
    f1 = 2 * np.count_nonzero(says & moves) / max(says.sum() + moves.sum(), 1)
    found = moves[np.argsort(p_static, kind="stable")]
    precision = np.cumsum(found) / np.arange(1, len(found) + 1)
    return float(f1), float(precision[found].mean()) if found.any() else float("nan")


def localize_globally(args: argparse.Namespace) -> str:
    """A line per world."""
    lines = []
    for world in args.worlds:
        known, T_map_world = build_known_map(args.data / world, world)
        crowd = {} if args.people is None else {"crowd": {"people": args.people}}
        simulation = simulate(scene_by_name(world, crowd), _OTHER_SEED)
        rng = np.random.default_rng(0)
        last = simulation.recording.n_scans - _SCANS_TO_LOCALIZE
        runs = [
            _localize_from(known, T_map_world, simulation, int(first))
            for first in rng.integers(0, last, args.starts)
        ]
        verdicts = [verdict for verdict, *_ in runs]
        found = [one[1:] for one in runs if one[0] == "right"]
        counts = [str(verdicts.count(v)) for v in ("right", "wrong", "ambiguous", "lost")]
        medians = [
            f"{np.median(v):.{d}f}"
            for v, d in zip(zip(*found, strict=True), (0, 3, 2), strict=True)
        ]
        lines.append(
            [world, str(args.starts), *counts, *medians, f"{max(f[2] for f in found):.2f}"]
        )
        print(" | ".join(lines[-1]), flush=True)
    titles = ["world", "places", "right", "wrong", "ambiguous", "lost", "scans", "m off"]
    return markdown([*titles, "s of the last search", "at most"], lines)


def build_known_map(folder: Path, world: str, seed: int = _MAP_SEED):
    """The map of another run, and the pose of the world in it: by all poses of that run, since the
    first one alone is off by some hundredths of a radian."""
    simulation = simulate(scene_by_name(world), seed)
    if not (folder / "run.json").exists():
        build(simulation.recording, {"threads": 1}).save(folder)
    return folder, align(simulation.truth.T_world_base, load(folder).poses)


def _localize_from(known: Path, T_map_world, simulation, first: int):
    """Verdict, scans until then, m off, and s that the last push took."""
    recording, doubts = simulation.recording, ()
    with LiveMapper({"threads": 1}, place=known) as mapper:
        scans = itertools.islice(iter_beams(recording), first, first + _SCANS_TO_LOCALIZE)
        for t, beams in enumerate(scans, first):
            start = time.perf_counter()
            update = mapper.push(beams, recording.T_odom_base[t])
            seconds, doubts = time.perf_counter() - start, update.doubts
            if "lost" in doubts:
                continue
            true = T_map_world @ simulation.truth.T_world_base[t]
            off = float(np.hypot(*(update.pose - true)[:2, 2]))
            return "right" if off < 0.3 else "wrong", t - first + 1, off, seconds
    return "ambiguous" if "ambiguous" in doubts else "lost", _SCANS_TO_LOCALIZE, math.inf, 0.0


class _EveryBeamCounts(LiveMapper):
    """Without P(static): all beams count alike in matching."""

    def _weigh(self, hits, prior):  # noqa: ARG002
        return hits


def localize_in_crowds(args: argparse.Namespace) -> str:
    """A line per number of people: lost runs, and ATE of the others."""
    known, T_map_world = build_known_map(args.data / args.world, args.world)
    lines = []
    for people in args.people:
        errors = {"with": [], "without": [], "filter": []}
        for run in range(args.runs):
            changes = {"crowd": {"people": people}, "robot": {"scans": _SCANS_IN_CROWDS}}
            simulation = simulate(scene_by_name(args.world, changes), 100 + run)
            true = T_map_world @ simulation.truth.T_world_base
            for name, kind in (("with", LiveMapper), ("without", _EveryBeamCounts)):
                errors[name].append(_track(kind, known, simulation.recording, true))
            errors["filter"].append(_filter_particles(known, simulation.recording, true, run))
        line = [f"{_count_lost(e)} / {_ate_of_others(e):.3f}" for e in errors.values()]
        lines.append([str(people), *line])
        print(" | ".join(lines[-1]), flush=True)
    titles = ["people", "with P(static)", "without", "particle filter"]
    return markdown([*titles[:1], *(f"{t}: lost / ATE m" for t in titles[1:])], lines)


def _track(kind, known, recording, true):
    """(T,) m off; infinite while lost."""
    off = np.full(recording.n_scans, math.inf)
    with kind({"threads": 1}, place=known) as mapper:
        for t, beams in enumerate(iter_beams(recording)):
            update = mapper.push(beams, recording.T_odom_base[t])
            if "lost" not in update.doubts:
                off[t] = np.hypot(*(update.pose - true[t])[:2, 2])
    return off


def _filter_particles(known, recording, true, seed: int):
    filter_ = ParticleFilter(read_grid(known), true[0], np.random.default_rng(seed))
    odometry = recording.T_odom_base
    off = np.zeros(recording.n_scans)
    for t, beams in enumerate(iter_beams(recording)):
        increment = np.eye(3) if t == 0 else se2.inverse(odometry[t - 1]) @ odometry[t]
        pose = filter_.push(beams.points, beams.hit, beams.T_base_sensor, increment)
        off[t] = np.hypot(*(pose - true[t])[:2, 2])
    return off


def _is_lost(off) -> bool:
    return bool(off[-50:].mean() > 0.5)


def _count_lost(runs) -> int:
    return sum(map(_is_lost, runs))


def _ate_of_others(runs) -> float:
    kept = [off[np.isfinite(off)] for off in runs if not _is_lost(off)]
    return float(np.sqrt(np.mean(np.square(np.concatenate(kept))))) if kept else math.nan


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
