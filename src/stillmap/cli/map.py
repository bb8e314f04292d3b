"""`stillmap map`: the main job, recording in, folder out."""

import argparse
import dataclasses
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.commands import COMMANDS
from stillmap.cli.options import add_option_flags, resolved_options
from stillmap.cli.printing import files_in, print_json
from stillmap.cli.progress import say, shown_progress
from stillmap.cli.reading import add_read_flags, read_changes
from stillmap.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.recording import Recording
    from stillmap.result import Result

_EPILOG = """examples:
  stillmap map log.clf.gz -o out
  stillmap map sim -o out --overwrite --resolution 0.1
  stillmap map log.clf.gz -o out --min-range 0.3 --set em.max_iterations=3
  stillmap map log.clf.gz -o out --poses poses.tum --config options.toml
  stillmap map log.clf.gz -o out --quiet --json
"""
_IN_SUMMARY = ("version", "converged", "best_iteration", "counts", "area", "seconds", "warnings")


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    p = commands.add_parser(
        "map",
        help=COMMANDS["map"],
        description="Map a recording: find out for every beam how likely it hit something that "
        "stands still, where the robot was at every scan, and what the map is without what moves. "
        "The result is a folder; open it with `stillmap view`.",
        epilog=_EPILOG,
    )
    p.add_argument(
        "input",
        metavar="INPUT",
        help="a CARMEN log, a ROS bag, a stillmap recording folder, ...: see docs/input.md",
    )
    p.add_argument("-o", "--output", metavar="DIR", required=True, help="where the result goes")
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument(
        "--threads", metavar="N", type=int, help="0: one per processor; same result (default: 0)"
    )
    p.add_argument("--json", action="store_true", help="a summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no progress, no summary")
    _add_method_flags(p.add_argument_group("method"))
    _add_map_flags(p.add_argument_group("map"))
    add_read_flags(p)
    add_option_flags(p)
    p.set_defaults(run=run)


def _add_method_flags(p: argparse._ArgumentGroup) -> None:
    p.add_argument("--paper", action="store_true", help="the method exactly as printed")
    p.add_argument(
        "--estimator",
        choices=("stillmap", "paper", "hit-ratio", "tracker"),
        help="what says which beams are static (default: stillmap)",
    )
    p.add_argument(
        "--poses",
        metavar="FILE.tum",
        help="keep these poses, estimate the rest; `recording`: those that the recording states",
    )
    p.add_argument("--no-odometry", action="store_true", help="ignore odometry in the recording")


def _add_map_flags(p: argparse._ArgumentGroup) -> None:
    p.add_argument(
        "--resolution", metavar="M", type=float, help="edge of a map cell in metres (default: 0.05)"
    )
    p.add_argument(
        "--map-mode",
        choices=("trinary", "scale", "raw"),
        help="pixels of map.pgm (default: trinary)",
    )
    p.add_argument(
        "--map-state",
        choices=("last", "majority"),
        help="which state of places that changed (default: last)",
    )


def run(args: argparse.Namespace) -> int:
    """Reads, maps, writes, says what came of it."""
    # these take long to load
    from stillmap import em
    from stillmap.output.atomic import require_new
    from stillmap.recording import read
    from stillmap.result import build
    from stillmap.stages import Stages

    options = resolved_options(args, read_changes(args), _changes(args))
    output = Path(args.output)
    require_new(output, args.overwrite)
    _require_writable(output)
    stages = Stages()
    with stages.measure("read"):
        recording = read(Path(args.input), options.read)
    recording = _usable(recording, args)
    poses = _given_poses(recording, args)
    with shown_progress(args.quiet, em.iterations(options.estimator, options.em)) as progress:
        result = build(recording, options, poses=poses, progress=progress, stages=stages)
    result.save(output, overwrite=args.overwrite)
    if not args.quiet:
        _say(result, output)
    if args.json:
        print_json(_summary(output))
    return 0


def _given_poses(recording: "Recording", args: argparse.Namespace) -> "NDArray[np.float64] | None":
    from stillmap.recording.poses import poses_from_tum

    if not args.poses:
        return None
    if args.poses != "recording":
        return poses_from_tum(Path(args.poses), recording)
    if recording.T_recorded_base is None:
        raise InputError(
            "states no poses",
            where=args.input,
            hint="--poses FILE.tum gives them; a file of the name `recording` is ./recording",
        )
    return recording.T_recorded_base


def _require_writable(output: Path) -> None:
    """Refuse a place that cannot be written to before the work is done, not after."""
    parent = Path(os.path.abspath(output)).parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"cannot be written: nothing can be put into {parent}", where=str(output))


def _usable(recording: "Recording", args: argparse.Namespace) -> "Recording":
    if recording.n_scans == 0:
        raise InputError("holds no scan that can be used", where=args.input)
    if recording.dimension != 2:
        raise InputError("is 3D: only 2D recordings can be mapped so far", where=args.input)
    recording = dataclasses.replace(recording, source=_found_at(recording.source, args.input))
    return recording.without_odometry() if args.no_odometry else recording


def _found_at(source: dict[str, Any], path: str) -> dict[str, Any]:
    """The source as run.json tells it: where the recording is now, and what it was made from."""
    made_from = source.get("path", path)
    return {**source, "path": path} | ({} if made_from == path else {"made_from": made_from})


def _changes(args: argparse.Namespace) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    if args.paper and args.estimator not in (None, "paper"):
        raise InputError(f"--paper and --estimator {args.estimator} exclude each other")
    if args.paper or args.estimator:
        changes["estimator"] = "paper" if args.paper else args.estimator
    if args.threads is not None:
        changes["threads"] = args.threads
    if args.resolution is not None:
        changes["slam"] = {"resolution": args.resolution}
    output = {"map_mode": args.map_mode, "map_state": args.map_state}
    if chosen := {name: value for name, value in output.items() if value}:
        changes["output"] = chosen
    return changes


def _summary(output: Path) -> dict[str, Any]:
    """What `run.json` says of the run, shorter, and which files there are."""
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    return {
        "output": str(output),
        "files": files_in(output),
        "iterations": len(record["iterations"]),
        **{key: record[key] for key in _IN_SUMMARY},
    }


def _say(result: "Result", output: Path) -> None:
    from stillmap.output.points import beam_counts

    counts = beam_counts(result.recording, result.p_static)
    end = "converged" if result.converged else "not converged"
    lines = [
        f"{result.recording.n_scans} scans, {counts['hits']} beams that hit something, "
        f"{100.0 * counts['dynamic'] / max(counts['hits'], 1):.1f} % of them dynamic",
        f"{len(result.iterations)} iterations, {end}, the best is {result.best_iteration}",
        *_changed(result),
        *(f"warning: {warning}" for warning in result.warnings),
        f"wrote {output}: open {output / 'report.html'}",
    ]
    for line in lines:
        say(line)


def _changed(result: "Result") -> list[str]:
    n = len(result.changes)
    if not n:
        return []
    state = "as it was last seen" if result.options.output.map_state == "last" else "as it was most"
    each = "it" if n == 1 else "each"
    return [f"{n} place{'s' * (n > 1)} changed meanwhile, the map shows {each} {state}"]
