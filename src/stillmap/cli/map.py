"""`stillmap map`: the main job, recording in, folder out.

What `stillmap map` does once it is known what is wanted.
"""

import argparse
import dataclasses
import errno
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.cli.arguments import add_read_flags, read_changes, require_apart
from stillmap.cli.config import add_option_flags, resolved_options
from stillmap.cli.console import files_in, print_json, say, shown_progress, shown_share
from stillmap.cli.parser import COMMANDS
from stillmap.cli.rig import built, read_tilting, said
from stillmap.core.errors import InputError, MissingExtra
from stillmap.core.files import require_new
from stillmap.core.profiling import Progress, StageTimer
from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.io.trajectory import poses_from_tum
from stillmap.mapping.beam_statistics import count_beams
from stillmap.mesh.build import Models
from stillmap.pipeline.checkpoint import CheckpointFolder, DamagedCheckpoint, lock_checkpoints
from stillmap.pipeline.checkpoint_files import identify_run
from stillmap.pipeline.estimate import EmState
from stillmap.pipeline.models import build_models
from stillmap.pipeline.options import Options, resolved
from stillmap.pipeline.result import Result, build
from stillmap.results.save import RECORD, save
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


def run(args: argparse.Namespace) -> int:
    """Reads, maps, writes, says what came of it."""
    pass  # DROPPED  # takes long to load

    return mapped(args, _changes(args))


def _changes(args: argparse.Namespace) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    if args.paper and args.estimator not in (None, "paper"):
        raise InputError(f"--paper and --estimator {args.estimator} exclude each other")
    if args.paper or args.estimator:
        changes["estimator"] = "paper" if args.paper else args.estimator
    if args.threads is not None:
        changes["threads"] = args.threads
    if args.resolution is not None:
        changes["slam"] = {"resolution": args.resolution, "voxel": args.resolution}
    if args.tilting_topic is not None:
        changes["read"] = {"tilting_topic": args.tilting_topic}
    output = {"map_mode": args.map_mode, "map_state": args.map_state}
    if chosen := {name: value for name, value in output.items() if value}:
        changes["output"] = chosen
    return changes


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_IN_SUMMARY = ("version", "converged", "best_iteration", "counts", "area", "seconds", "warnings")


def mapped(args: argparse.Namespace, changes: dict[str, Any]) -> int:
    """Reads, maps, writes, says what came of it.

    Args:
        args: the flags.
        changes: of the options, by them.
    """
    options = resolved_options(args, read_changes(args), changes)
    output, replace = Path(args.output), args.overwrite or args.resume
    require_new(output, RECORD, replace)
    require_apart(output, Path(args.input))
    if args.tilting:
        require_apart(output, Path(args.tilting))
    _require_writable(output)
    with lock_checkpoints(output) as checkpoints:
        try:
            result, in_3d = _mapped_and_saved(args, options, checkpoints)
            checkpoints.clear()
        except OSError as error:
            if error.errno not in _FULL:
                raise
            raise InputError(
                f"cannot go on: {error.strerror}", where=str(checkpoints.folder)
            ) from error
        except (KeyboardInterrupt, SystemExit):
            if checkpoints.newest is not None:
                _tell(
                    args, f"{checkpoints.folder} keeps how far it came: --resume goes on from there"
                )
            raise
    if not args.quiet:
        _say(result, in_3d, output)
    if args.json:
        print_json(_summary(output))
    return 0


def _mapped_and_saved(
    args: argparse.Namespace, options: Options, checkpoints: CheckpointFolder
) -> tuple[Result, TiltingResult | None]:
    """The whole job; how far it has come is kept after every iteration."""
    stages = StageTimer()
    with stages.measure("read"):
        with shown_share(args.quiet, "reading") as tell:
            found = read(Path(args.input), options.read, progress=tell, scratch=checkpoints.folder)
        recording = _usable(found, args)
        poses = _given_poses(recording, args)
        tilting = read_tilting(args, recording, options, checkpoints.folder)
        _require_known(recording, options, args)
        options = resolved(options, recording)
        same = identify_run(recording, options, poses)
    state = _resumed(args, checkpoints, same, options, stages)
    with shown_progress(args.quiet, em.max_iterations(options.estimator, options.em)) as progress:
        result = build(
            recording,
            options,
            poses=poses,
            progress=progress,
            stages=stages,
            scratch=checkpoints.folder,
            resume=state,
            checkpoint=lambda state: checkpoints.save(state, same, stages),
        )
        in_3d = None
        if tilting is not None:
            progress("cutting out what moves", 0, 0, 0)
            with stages.measure("tilting"):
                in_3d = built(result, tilting, options)
            result = dataclasses.replace(result, stages=stages.to_dict())
        models, result = _modelled(result, in_3d, progress, stages)
        progress("writing", 0, 0, 0)
        replace = args.overwrite or args.resume
        save(
            result,
            Path(args.output),
            replace,
            staging_folder=checkpoints.folder,
            tilting=in_3d,
            models=models,
        )
    return result, in_3d


def _modelled(
    result: Result, in_3d: TiltingResult | None, progress: Progress, stages: StageTimer
) -> tuple[Models | None, Result]:
    """Models of what is in 3D, where they are wanted and can be made; and what the result says."""
    if not result.options.mesh.enabled or (in_3d is None and result.recording.dimension == 2):
        return None, result
    try:
        models = build_models(result, tilting=in_3d, progress=progress, stages=stages)
    except MissingExtra as error:
        warning = f"no models: {error}"
        return None, dataclasses.replace(result, warnings=[*result.warnings, warning])
    warnings = [*result.warnings]
    if not len(models.assignment.mesh):
        warnings.append("no model of the place: hardly any beams lie side by side on it")
    if count := len(models.unread):
        what = (
            "a picture is not used" if count == 1 else f"{count} pictures are not used, the first"
        )
        warnings.append(f"{what}: {models.unread[0]}")
    return models, dataclasses.replace(result, warnings=warnings, stages=stages.to_dict())


def _resumed(
    args: argparse.Namespace,
    checkpoints: CheckpointFolder,
    same: dict[str, Any],
    options: Options,
    stages: StageTimer,
) -> EmState | None:
    """How far an interrupted run came, if it is to be gone on from."""
    if checkpoints.newest is None:
        return None
    if not args.resume:
        _tell(args, "an earlier run was interrupted: begins anew, --resume would go on from it")
        checkpoints.clear()
        return None
    try:
        state = checkpoints.load(same, options, stages)
    except DamagedCheckpoint as error:
        say(f"warning: {error}; begins anew")
        checkpoints.clear()
        return None
    if state is not None:
        _tell(args, f"goes on after iteration {len(state.records)}")
    return state


def _tell(args: argparse.Namespace, line: str) -> None:
    if not args.quiet:
        say(line)


def _given_poses(recording: Recording, args: argparse.Namespace) -> NDArray[np.float64] | None:
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


def _usable(recording: Recording, args: argparse.Namespace) -> Recording:
    if recording.n_scans == 0:
        raise InputError("holds no scan that can be used", where=args.input)
    recording = dataclasses.replace(recording, source=_found_at(recording.source, args.input))
    return recording.without_odometry() if args.no_odometry else recording


def _require_known(recording: Recording, options: Options, args: argparse.Namespace) -> None:
    """Refuse an estimator that knows nothing of space before the work is done."""
    if recording.dimension == 3 and options.estimator not in em.ESTIMATORS_3D:
        raise InputError(
            f"is 3D: estimator '{options.estimator}' knows 2D recordings alone",
            where=args.input,
            hint=f"--estimator {' or '.join(em.ESTIMATORS_3D)}",
        )


def _found_at(source: dict[str, Any], path: str) -> dict[str, Any]:
    """The source as run.json tells it: where the recording is now, and what it was made from."""
    made_from = source.get("path", path)
    return {**source, "path": path} | ({} if made_from == path else {"made_from": made_from})


def _summary(output: Path) -> dict[str, Any]:
    """What `run.json` says of the run, shorter, and which files there are."""
    record = json.loads((output / "run.json").read_text(encoding="utf-8"))
    return {
        "output": str(output),
        "files": files_in(output),
        "iterations": len(record["iterations"]),
        **{key: record[key] for key in (*_IN_SUMMARY, "tilting") if key in record},
    }


def _say(result: Result, in_3d: TiltingResult | None, output: Path) -> None:
    counts = count_beams(result.recording, result.p_static)
    end, n = "converged" if result.converged else "not converged", len(result.iterations)
    lines = [
        f"{result.recording.n_scans} scans, {counts['hits']} beams that hit something, "
        f"{100.0 * counts['dynamic'] / max(counts['hits'], 1):.1f} % of them dynamic",
        f"{n} iteration{'s' if n > 1 else ''}, {end}, the best is {result.best_iteration}",
        *_changed(result),
        *([] if in_3d is None else [said(in_3d)]),
        *(f"warning: {warning}" for warning in result.warnings),
        f"wrote {output}: open {output / 'report.html'}",
    ]
    for line in lines:
        say(line)


def _changed(result: Result) -> list[str]:
    n = len(result.changes)
    if not n:
        return []
    state = "as it was last seen" if result.options.output.map_state == "last" else "as it was most"
    each = "it" if n == 1 else "each"
    return [f"{n} place{'s' * (n > 1)} changed meanwhile, the map shows {each} {state}"]
