"""`stillmap map`: parse, read, build, save."""

import argparse
import errno
import json
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.cli.arguments import add_read_flags, read_changes, require_apart
from stillmap.cli.config import add_option_flags, options_from_args
from stillmap.cli.console import list_files, print_json, say, show_progress
from stillmap.core.advice import split_advice
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.core.profiling import StageTimer
    from stillmap.core.recording import Recording
    from stillmap.io.input_groups import InputGroup
    from stillmap.mesh.build import Models
    from stillmap.pipeline.checkpoint import CheckpointFolder
    from stillmap.pipeline.options import Options
    from stillmap.pipeline.result import MappingResult
    from stillmap.rig.build import TiltingResult

DESCRIPTION = (
    "Map a recording: estimate the pose of every scan, the probability of every "
    "beam to have hit something static, and the map of what is static. The result is a folder; "
    "open it with `stillmap view`. Several inputs are joined where they are parts of one run."
)
EPILOG = """examples:
  stillmap map log.clf.gz -o out
  stillmap map sim -o out --overwrite --resolution 0.1
  stillmap map log.clf.gz -o out --min-range 0.3 --set em.max_iterations=3
  stillmap map log.clf.gz -o out --poses poses.tum --config options.toml
  stillmap map log.bag -o out --resume
  stillmap map run_0.bag run_1.bag run_2.bag -o out
  stillmap map sim/horizontal -o out --tilting sim/tilting
  stillmap map log.clf.gz -o out --quiet --json
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    p.add_argument(
        "input",
        metavar="INPUT",
        nargs="+",
        help="a CARMEN log, a ROS bag, a stillmap recording folder, ...: see docs/input.md; "
        "several: the parts of one run, in any order (docs/input/parts.md)",
    )
    p.add_argument(
        "--tilting",
        metavar="RECORDING",
        help="recording of a tilting laser on the same robot, mapped in 3D: INPUT, of the planar "
        "laser, decides what moves (docs/rig.md)",
    )
    p.add_argument(
        "--tilting-topic",
        metavar="TOPIC",
        help="the same for a topic of the bag INPUT; its transforms give the laser's motion",
    )
    p.add_argument("-o", "--output", metavar="DIR", required=True, help="result folder")
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument(
        "--resume", action="store_true", help="continue an interrupted run from its last checkpoint"
    )
    p.add_argument(
        "--threads", metavar="N", type=int, help="0: one per processor; same result (default: 0)"
    )
    p.add_argument("--json", action="store_true", help="a summary as one JSON object on stdout")
    p.add_argument("--quiet", action="store_true", help="no progress, no summary")
    add_method_flags(p.add_argument_group("method"))
    add_map_flags(p.add_argument_group("map"))
    add_read_flags(p)
    add_option_flags(p)


def add_method_flags(p: argparse._ArgumentGroup) -> None:
    """Add the flags that choose how poses and labels are estimated."""
    p.add_argument("--paper", action="store_true", help="the method exactly as printed")
    p.add_argument(
        "--estimator",
        choices=("stillmap", "paper", "hit-ratio", "tracker"),
        help="how beams are labelled (default: stillmap)",
    )
    p.add_argument(
        "--poses",
        metavar="FILE.tum",
        help="keep these poses; `recording`: the poses stored in the recording",
    )
    p.add_argument("--no-odometry", action="store_true", help="ignore odometry in the recording")


def add_map_flags(p: argparse._ArgumentGroup) -> None:
    """Add the flags of the map that is written."""
    p.add_argument(
        "--mesh",
        action=argparse.BooleanOptionalAction,
        help="surface and models of 3D recordings (default: where there are pictures)",
    )
    p.add_argument(
        "--resolution",
        metavar="M",
        type=float,
        help="edge of a map cell in metres (default: 0.05); of a voxel in 3D (0.15, of depth "
        "cameras 0.05)",
    )
    p.add_argument(
        "--map-mode",
        choices=("trinary", "scale", "raw"),
        help="pixels of map.pgm (default: trinary)",
    )
    p.add_argument(
        "--region",
        type=float,
        nargs=4,
        metavar=("X0", "Y0", "X1", "Y1"),
        help="write this part of the map frame alone, in metres; poses are of all scans",
    )
    p.add_argument(
        "--map-state", choices=("last", "majority"), help="state of changed places (default: last)"
    )


_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_IN_SUMMARY = ("version", "converged", "best_iteration", "counts", "area", "seconds", "warnings")


def run(args: argparse.Namespace) -> int:
    """Map a recording into a folder."""
    from stillmap.cli.groups import merge_sessions
    from stillmap.cli.map_run import build_all, read_inputs
    from stillmap.core.profiling import StageTimer
    from stillmap.pipeline.checkpoint import lock_checkpoints
    from stillmap.results.save import save

    options = options_from_args(args, read_changes(args), option_changes(args))
    output, stages = Path(args.output), StageTimer()
    _require_usable_output(args, output)
    groups = _find_groups(args, options, output, stages)
    if len(groups) > 1:
        return merge_sessions(args, groups)
    with lock_checkpoints(output) as checkpoints, _explain_failure(args, checkpoints):
        inputs = read_inputs(args, groups[0], options, checkpoints.folder, stages)
        with show_progress(args.quiet, options.em.max_iterations) as progress:
            result, tilting, models = build_all(args, inputs, checkpoints, progress, stages)
            progress("writing", 0, 0, 0)
            save(
                result,
                output,
                args.overwrite or args.resume,
                staging_folder=checkpoints.folder,
                tilting=tilting,
                models=models,
            )
        checkpoints.clear()
    if not args.quiet:
        _print_summary(result, tilting, models, output)
    if args.json:
        print_json(_summarize(output))
    return 0


def _find_groups(
    args: argparse.Namespace, options: "Options", output: Path, stages: "StageTimer"
) -> "list[InputGroup]":
    """Group the inputs and tell how; what is large lies beside the output meanwhile."""
    from stillmap.cli.groups import describe_group, find_groups
    from stillmap.pipeline.checkpoint import lock_checkpoints

    if len(args.input) == 1:
        return find_groups(args, options.read, None)
    with (
        lock_checkpoints(output) as checkpoints,
        _explain_failure(args, checkpoints),
        stages.measure("read"),
    ):
        groups = find_groups(args, options.read, checkpoints.folder)
    if not args.quiet:
        for group in groups:
            say(describe_group(group))
    return groups


def option_changes(args: argparse.Namespace) -> dict[str, Any]:
    """The options that flags of this command set."""
    changes: dict[str, Any] = {}
    if args.paper and args.estimator not in (None, "paper"):
        raise InputError(f"--paper and --estimator {args.estimator} exclude each other")
    if args.paper or args.estimator:
        changes["estimator"] = "paper" if args.paper else args.estimator
    if args.threads is not None:
        changes["threads"] = args.threads
    if args.resolution is not None:
        changes["slam"] = {"resolution": args.resolution, "voxel_size": args.resolution}
    if args.mesh is not None:
        changes["mesh"] = {"enabled": args.mesh}
    if args.tilting_topic is not None:
        changes["read"] = {"tilting_topic": args.tilting_topic}
    output = {"map_mode": args.map_mode, "map_state": args.map_state, "region": args.region}
    if chosen := {name: value for name, value in output.items() if value}:
        changes["output"] = chosen
    return changes


def _require_usable_output(args: argparse.Namespace, output: Path) -> None:
    """Refuse an output that is taken, holds an input or cannot be written, before any work."""
    from stillmap.core.files import require_new
    from stillmap.results.run_json import RECORD

    require_new(output, RECORD, args.overwrite or args.resume)
    for source in filter(None, (*args.input, args.tilting)):
        require_apart(output, Path(source))
    parent = Path(os.path.abspath(output)).parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"cannot be written: {parent} is not writable", where=str(output))


@contextmanager
def _explain_failure(args: argparse.Namespace, checkpoints: "CheckpointFolder") -> Iterator[None]:
    """Report a full disk in one line, and after an interruption how to go on."""
    try:
        yield
    except OSError as error:
        if error.errno not in _DISK_FULL:
            raise
        where = str(checkpoints.folder)
        raise InputError(f"cannot continue: {error.strerror}", where=where) from error
    except (KeyboardInterrupt, SystemExit):
        if not args.quiet:
            say(_describe_interruption(args.words, checkpoints))
        raise


def _describe_interruption(words: list[str], checkpoints: "CheckpointFolder") -> str:
    """How to continue an interrupted run with these words on its command line."""
    if checkpoints.newest is None:
        return "no iteration was finished: nothing was written, and there is nothing to resume"
    given = [word for word in words if word not in ("--resume", "--overwrite")]
    number = checkpoints.newest.name.rpartition("-")[2]
    command = shlex.join(["stillmap", *given, "--resume"])
    return f"continue after iteration {number}: {command}"


def _summarize(output: Path) -> dict[str, Any]:
    """The main entries of `run.json`, and the files of the result."""
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    return {
        "output": str(output),
        "files": list_files(output),
        "iterations": len(record["iterations"]),
        **{key: record[key] for key in (*_IN_SUMMARY, "tilting") if key in record},
    }


def _describe_quality(result: "MappingResult") -> list[str]:
    """One line; none where quality cannot be told."""
    quality = result.quality
    parts = {"labels": quality.labels, "geometry": quality.geometry}
    told = [f"{name} {value:.0f}" for name, value in parts.items() if value is not None]
    if quality.overall is None:
        return []
    return [f"quality {quality.overall:.0f} of 100: {', '.join(told)}"]


def _print_summary(
    result: "MappingResult", tilting: "TiltingResult | None", models: "Models | None", output: Path
) -> None:
    lines = [
        f"{result.recording.n_scans} scans, {_describe_hits(result.recording, result.p_static)}",
        _describe_iterations(result),
        *_describe_quality(result),
        *_describe_changes(result),
        *([] if tilting is None else [_describe_tilting(tilting)]),
        *(f"{_kind_of(warning)}: {warning}" for warning in result.warnings),
        *_describe_lack_of_models(result, tilting, models),
        f"wrote {output}: open {output / 'report.html'}",
        f"see it over time: stillmap view {shlex.quote(str(output))}",
    ]
    for line in lines:
        say(line)


def _describe_lack_of_models(
    result: "MappingResult", tilting: "TiltingResult | None", models: "Models | None"
) -> list[str]:
    """How to get models of a 3D recording that has no pictures."""
    is_2d = tilting is None and result.recording.dimension == 2
    if is_2d or models is not None or result.options.mesh.enabled is not None:
        return []
    return ["no surface model: the recording has no pictures, --mesh makes a grey one"]


def _describe_iterations(result: "MappingResult") -> str:
    """Which iteration was kept, and whether the loop stopped by itself."""
    n = len(result.iterations)
    if n == 1 and result.converged:
        return "converged after one iteration"
    ending = "" if result.converged else ", which had not converged"
    return f"kept iteration {result.best_iteration} of {n}{ending}"


def _kind_of(warning: str) -> str:
    """`warning` where the user can do something, else `note`."""
    return "warning" if split_advice(warning)[1] else "note"


def _describe_changes(result: "MappingResult") -> list[str]:
    n, last = len(result.changes), result.options.output.map_state == "last"
    if not n:
        return []
    state = "in its last state" if last else "in the state that it was in for longest"
    return [f"{n} place{'s' * (n > 1)} changed, the map shows {'it' if n == 1 else 'each'} {state}"]


def _describe_hits(recording: "Recording", p_static: "NDArray[np.float32]") -> str:
    from stillmap.mapping.beam_statistics import count_beams

    counts = count_beams(recording, p_static)
    share = 100.0 * counts["dynamic"] / max(counts["hits"], 1)
    return f"{counts['hits']} beams that hit something, {share:.1f} % of them dynamic"


def _describe_tilting(tilting: "TiltingResult") -> str:
    out = f"in 3D {_describe_hits(tilting.deskewed, tilting.p_static)}"
    if tilting.unposed_beams:
        out += f"; {tilting.unposed_beams} left out: the robot's pose is not known there"
    return out
