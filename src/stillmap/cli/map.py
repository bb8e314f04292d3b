"""`stillmap map`: the main job: parse, read, build, save.

Imports that take long are made inside the functions, so that `--help` and completion are quick.
"""

import argparse
import dataclasses
import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stillmap.cli.arguments import add_read_flags, read_changes, require_apart
from stillmap.cli.config import add_option_flags, options_from_args
from stillmap.cli.console import files_in, print_json, say, shown_progress, shown_share
from stillmap.cli.parser import COMMANDS
from stillmap.core.errors import InputError, MissingExtra

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stillmap.core.profiling import Progress, StageTimer
    from stillmap.core.recording import Recording
    from stillmap.mesh.build import Models
    from stillmap.pipeline.checkpoint import CheckpointFolder
    from stillmap.pipeline.estimate import EmState
    from stillmap.pipeline.options import Options
    from stillmap.results.result import Result
    from stillmap.rig.build import TiltingResult

_EPILOG = """examples:
  stillmap map log.clf.gz -o out
  stillmap map sim -o out --overwrite --resolution 0.1
  stillmap map log.clf.gz -o out --min-range 0.3 --set em.max_iterations=3
  stillmap map log.clf.gz -o out --poses poses.tum --config options.toml
  stillmap map log.bag -o out --resume
  stillmap map sim/horizontal -o out --tilting sim/tilting
  stillmap map log.clf.gz -o out --quiet --json
"""


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
    p.add_argument(
        "--tilting",
        metavar="RECORDING",
        help="of the same robot and time, a laser that tilts or pans, in 3D: INPUT, which lies "
        "flat, tells what moves in it (docs/rig.md)",
    )
    p.add_argument(
        "--tilting-topic",
        metavar="TOPIC",
        help="the same, of scans in the bag INPUT, whose transforms say how their laser moves",
    )
    p.add_argument("-o", "--output", metavar="DIR", required=True, help="where the result goes")
    p.add_argument("--overwrite", action="store_true", help="replace what is in DIR")
    p.add_argument(
        "--resume", action="store_true", help="go on where an interrupted run of the same stopped"
    )
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
        "--map-state",
        choices=("last", "majority"),
        help="which state of places that changed (default: last)",
    )


_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_IN_SUMMARY = ("version", "converged", "best_iteration", "counts", "area", "seconds", "warnings")


class _Inputs(NamedTuple):
    """What is mapped: the recording, poses to keep, and the second laser of a rig."""

    recording: "Recording"
    poses: "NDArray[np.float64] | None"
    tilting: "Recording | None"


class _Built(NamedTuple):
    """The result, with the 3D data of a rig's second laser and the meshes where there are any."""

    result: "Result"
    tilting: "TiltingResult | None"
    models: "Models | None"


def run(args: argparse.Namespace) -> int:
    """Maps a recording into a folder."""
    from stillmap.core.profiling import StageTimer
    from stillmap.pipeline.checkpoint import lock_checkpoints
    from stillmap.results.save import save

    options = options_from_args(args, read_changes(args), _option_changes(args))
    output, replace = Path(args.output), args.overwrite or args.resume
    _require_usable_output(args, output, replace)
    stages = StageTimer()
    with lock_checkpoints(output) as checkpoints, _explain_failure(args, checkpoints):
        inputs, options = _read(args, options, checkpoints.folder, stages)
        with shown_progress(args.quiet, options.em.max_iterations) as progress:
            built = _build(args, inputs, options, checkpoints, progress, stages)
            progress("writing", 0, 0, 0)
            save(
                built.result,
                output,
                replace,
                staging_folder=checkpoints.folder,
                tilting=built.tilting,
                models=built.models,
            )
        checkpoints.clear()
    if not args.quiet:
        _print_summary(built, output)
    if args.json:
        print_json(_summary(output))
    return 0


def _option_changes(args: argparse.Namespace) -> dict[str, Any]:
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
    if args.tilting_topic is not None:
        changes["read"] = {"tilting_topic": args.tilting_topic}
    output = {"map_mode": args.map_mode, "map_state": args.map_state}
    if chosen := {name: value for name, value in output.items() if value}:
        changes["output"] = chosen
    return changes


def _require_usable_output(args: argparse.Namespace, output: Path, replace: bool) -> None:
    """Refuses an output that is taken, holds an input or cannot be written, before any work."""
    from stillmap.core.files import require_new
    from stillmap.results.run_json import RECORD

    require_new(output, RECORD, replace)
    for source in filter(None, (args.input, args.tilting)):
        require_apart(output, Path(source))
    parent = Path(os.path.abspath(output)).parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"cannot be written: {parent} is not writable", where=str(output))


@contextmanager
def _explain_failure(args: argparse.Namespace, checkpoints: "CheckpointFolder") -> Iterator[None]:
    """A full disk becomes one line; an interruption names the checkpoint to resume from."""
    try:
        yield
    except OSError as error:
        if error.errno not in _DISK_FULL:
            raise
        where = str(checkpoints.folder)
        raise InputError(f"cannot continue: {error.strerror}", where=where) from error
    except (KeyboardInterrupt, SystemExit):
        if checkpoints.newest is not None:
            _tell(args, f"{checkpoints.folder} has the last checkpoint: --resume continues there")
        raise


def _read(
    args: argparse.Namespace, options: "Options", scratch: Path, stages: "StageTimer"
) -> "tuple[_Inputs, Options]":
    """The inputs, and the options resolved for them."""
    from stillmap.cli.rig import read_tilting
    from stillmap.io import read
    from stillmap.pipeline.options import resolve_options

    with stages.measure("read"):
        with shown_share(args.quiet, "reading") as tell:
            recording = read(Path(args.input), options.read, progress=tell, scratch=scratch)
        recording = _prepare(recording, options, args)
        poses = _given_poses(recording, args)
        tilting = read_tilting(args, recording, options, scratch)
        return _Inputs(recording, poses, tilting), resolve_options(options, recording)


def _prepare(recording: "Recording", options: "Options", args: argparse.Namespace) -> "Recording":
    """Refuses what cannot be mapped; notes where the recording is; drops odometry if asked to."""
    from stillmap import em

    if recording.n_scans == 0:
        raise InputError("holds no scan that can be used", where=args.input)
    if recording.dimension == 3 and options.estimator not in em.ESTIMATORS_3D:
        raise InputError(
            f"is 3D: estimator '{options.estimator}' is for 2D recordings",
            where=args.input,
            hint=f"--estimator {' or '.join(em.ESTIMATORS_3D)}",
        )
    original = recording.source.get("path", args.input)
    source = {**recording.source, "path": args.input}
    if original != args.input:
        source["made_from"] = original
    recording = dataclasses.replace(recording, source=source)
    return recording.without_odometry() if args.no_odometry else recording


def _given_poses(recording: "Recording", args: argparse.Namespace) -> "NDArray[np.float64] | None":
    from stillmap.io.trajectory import poses_from_tum

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


def _build(
    args: argparse.Namespace,
    inputs: _Inputs,
    options: "Options",
    checkpoints: "CheckpointFolder",
    progress: "Progress",
    stages: "StageTimer",
) -> _Built:
    """EM with a checkpoint per iteration, then the rig's second laser and the meshes."""
    from stillmap.cli.rig import built
    from stillmap.pipeline.checkpoint_files import identify_run
    from stillmap.results.result import build

    with stages.measure("read"):
        run_id = identify_run(inputs.recording, options, inputs.poses)
    result = build(
        inputs.recording,
        options,
        poses=inputs.poses,
        progress=progress,
        stages=stages,
        scratch=checkpoints.folder,
        resume=_load_checkpoint(args, checkpoints, run_id, options, stages),
        checkpoint=lambda state: checkpoints.save(state, run_id, stages),
    )
    tilting = None
    if inputs.tilting is not None:
        progress("cutting out what moves", 0, 0, 0)
        with stages.measure("tilting"):
            tilting = built(result, inputs.tilting, options)
    models, warnings = _build_models(result, tilting, progress, stages)
    warnings = [*result.warnings, *warnings]
    result = dataclasses.replace(result, warnings=warnings, stages=stages.to_dict())
    return _Built(result, tilting, models)


def _build_models(
    result: "Result", tilting: "TiltingResult | None", progress: "Progress", stages: "StageTimer"
) -> "tuple[Models | None, list[str]]":
    """The meshes of a 3D recording, where they are wanted and can be built; and warnings."""
    from stillmap.pipeline.models import build_models

    if not result.options.mesh.enabled or (tilting is None and result.recording.dimension == 2):
        return None, []
    try:
        models = build_models(result, tilting=tilting, progress=progress, stages=stages)
    except MissingExtra as error:
        return None, [f"no models: {error}"]
    warnings = []
    if not len(models.assignment.mesh):
        warnings.append("no mesh of the place: hardly any beams are neighbours on a surface")
    if count := len(models.unread):
        what = "an image is not used" if count == 1 else f"{count} images are not used, the first"
        warnings.append(f"{what}: {models.unread[0]}")
    return models, warnings


def _load_checkpoint(
    args: argparse.Namespace,
    checkpoints: "CheckpointFolder",
    run_id: dict[str, Any],
    options: "Options",
    stages: "StageTimer",
) -> "EmState | None":
    """The state of an interrupted run, where there is one and it is to be resumed."""
    from stillmap.pipeline.checkpoint import DamagedCheckpoint

    if checkpoints.newest is None:
        return None
    if not args.resume:
        _tell(args, "an earlier run was interrupted: starts anew; --resume would continue it")
        checkpoints.clear()
        return None
    try:
        state = checkpoints.load(run_id, options, stages)
    except DamagedCheckpoint as error:
        say(f"warning: {error}; starts anew")
        checkpoints.clear()
        return None
    if state is not None:
        _tell(args, f"continues after iteration {len(state.records)}")
    return state


def _tell(args: argparse.Namespace, line: str) -> None:
    if not args.quiet:
        say(line)


def _summary(output: Path) -> dict[str, Any]:
    """What `run.json` says of the run, shorter, and which files there are."""
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    return {
        "output": str(output),
        "files": files_in(output),
        "iterations": len(record["iterations"]),
        **{key: record[key] for key in (*_IN_SUMMARY, "tilting") if key in record},
    }


def _print_summary(built: _Built, output: Path) -> None:
    from stillmap.cli.rig import said
    from stillmap.mapping.beam_statistics import count_beams

    result, n = built.result, len(built.result.iterations)
    counts = count_beams(result.recording, result.p_static)
    lines = [
        f"{result.recording.n_scans} scans, {counts['hits']} beams that hit something, "
        f"{100.0 * counts['dynamic'] / max(counts['hits'], 1):.1f} % of them dynamic",
        f"{n} iteration{'s' * (n > 1)}, {'' if result.converged else 'not '}converged, "
        f"the best is {result.best_iteration}",
        *_changes_line(result),
        *([] if built.tilting is None else [said(built.tilting)]),
        *(f"warning: {warning}" for warning in result.warnings),
        f"wrote {output}: open {output / 'report.html'}",
    ]
    for line in lines:
        say(line)


def _changes_line(result: "Result") -> list[str]:
    n, last = len(result.changes), result.options.output.map_state == "last"
    if not n:
        return []
    state = "in its last state" if last else "in the state that it was in for longest"
    return [f"{n} place{'s' * (n > 1)} changed, the map shows {'it' if n == 1 else 'each'} {state}"]
