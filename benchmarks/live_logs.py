"""Relation errors of live mapping on real logs, beside batch and Karto: `live.py logs`.

Karto (see karto.py) answers when a scan has been processed, with the loops that it closed; the
scans that it does not take are carried by odometry. Live mapping answers before it closes loops.
"""

import argparse
from pathlib import Path

import karto
import numpy as np
import session_merging as merging
from numpy.typing import NDArray
from pairs import timed_poses
from tables import markdown

import stillmap
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams, replay
from stillmap.results.eval.readers import read_planar_trajectory, read_relations
from stillmap.results.eval.trajectory import compute_relation_errors

Float = NDArray[np.float64]
_LOGS = ("intel", "aces", "belgioioso", "edmonton", "fr101", "seattle")
_TITLES = ("log", "batch: m / deg", "live, at the time", "ratio", "live, at the end")
_FURTHER = ("finish()", "Karto, at the time", "ratio", "Karto, at the end", "CPU s live", "Karto")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `live.py logs`."""
    parser.add_argument("folder", type=Path)
    parser.add_argument("--names", nargs="+", default=list(_LOGS))
    parser.add_argument("--data", type=Path, required=True, help="folder for results")
    parser.add_argument("--finish", action="store_true", help="LiveMapper.finish(), too")
    parser.add_argument("--karto-python", metavar="PYTHON", help="an interpreter with yag-slam")
    parser.add_argument(
        "--starts",
        type=int,
        nargs="+",
        help="instead of all: only poses at the time, of drives that begin so many scans later",
    )


def map_logs(args: argparse.Namespace) -> str:
    """A line per log."""
    lines = []
    for name in args.names:
        log = args.folder / f"{name}.clf.gz"
        relations = _find_relations(args.folder, name)
        batch, live = args.data / f"batch-{name}", args.data / f"live-{name}"
        if not (batch / "run.json").exists():
            merging.build_map(log, batch)
        if args.starts:
            lines += _start_later(log, batch, relations, args.starts)
            continue
        done = merging.call("live", "--replay", log, "--threads", 1, "-o", live)
        runs = (batch / "trajectory.tum", live / "live/trajectory.tum", live / "trajectory.tum")
        wanted, answered, known = (_errors(read_planar_trajectory(run), relations) for run in runs)
        finished = _errors(_finish(log), relations) if args.finish else None
        peer = _errors_of_karto(log, relations, args.karto_python)
        line = [name, _shown(wanted), _shown(answered), _ratio(answered, wanted), _shown(known)]
        line += [_shown(finished), _shown(peer[0]), _ratio(peer[0], wanted), _shown(peer[1])]
        lines.append([*line, f"{done.cpu:.0f}", peer[2]])
        print(" | ".join(lines[-1]), flush=True)
    return markdown(
        ["log", "start", *_TITLES[2:4]] if args.starts else [*_TITLES, *_FURTHER], lines
    )


def _start_later(log: Path, batch: Path, relations: Float, starts: list[int]) -> list[list[str]]:
    """A line for each start, and the mean: the drift of the first round is another one."""
    recording = stillmap.read(log)
    odometry, beams = recording.T_odom_base, list(iter_beams(recording))
    wanted = _errors(read_planar_trajectory(batch / "trajectory.tum"), relations)
    lines, found = [], []
    for start in starts:
        with LiveMapper({"threads": 1}) as mapper:
            poses = [
                mapper.push(scan, None if odometry is None else odometry[t]).pose
                for t, scan in enumerate(beams[start:], start)
            ]
        run = timed_poses(recording.stamp_ns[start:], np.array(poses))
        found.append(_errors(run, relations))
        lines.append([log.name, str(start), _shown(found[-1]), _ratio(found[-1], wanted)])
        print(" | ".join(lines[-1]), flush=True)
    mean = (float(np.mean([one[0] for one in found])), float(np.mean([one[1] for one in found])))
    return [*lines, [log.name, "mean", _shown(mean), _ratio(mean, wanted)]]


def _find_relations(folder: Path, name: str) -> Float:
    kinds = ("exact.relations", "pseudo.relations")
    return read_relations(
        next(path for kind in kinds if (path := folder / f"{name}.{kind}").exists())
    )


def _errors(trajectory: Float, relations: Float) -> tuple[float, float]:
    """Mean translational (m) and rotational (degrees) error of (T, 4) t, x, y, theta."""
    errors = compute_relation_errors(trajectory, relations, None, 0.1, False)
    return errors.translation.mean, errors.rotation.mean


def _finish(log: Path) -> Float:
    recording = stillmap.read(log)
    with LiveMapper({"threads": 1}) as mapper:
        replay(recording, mapper)
        return timed_poses(recording.stamp_ns, mapper.finish().poses)


def _errors_of_karto(log: Path, relations: Float, python: str | None):
    """At the time and at the end, and CPU seconds of the scans; None: there are none."""
    if python is None:
        return None, None, ""
    recording = stillmap.read(log)
    found = karto.mapped(recording, python)
    runs = (timed_poses(recording.stamp_ns, poses) for poses in (found.answers, found.poses))
    return *(_errors(run, relations) for run in runs), f"{found.cpu:.0f}"


def _shown(errors: tuple[float, float] | None) -> str:
    return "" if errors is None else f"{errors[0]:.4f} / {errors[1]:.3f}"


def _ratio(errors: tuple[float, float] | None, wanted: tuple[float, float]) -> str:
    return "" if errors is None else f"{errors[0] / wanted[0]:.2f}"
