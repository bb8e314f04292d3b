"""What `stillmap map` does once it is known what is wanted."""

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
from stillmap.checkpoint import Damaged, Place, held, identity
from stillmap.cli.options import resolved_options
from stillmap.cli.printing import files_in, print_json
from stillmap.cli.progress import say, shown_progress, shown_share
from stillmap.cli.reading import read_changes
from stillmap.cli.results import require_apart
from stillmap.cli.tilting import built, read_tilting, said
from stillmap.errors import InputError
from stillmap.extras import MissingExtra
from stillmap.loop import Loop
from stillmap.models.building import Models
from stillmap.models.result import models_of
from stillmap.output.atomic import require_new
from stillmap.output.points import beam_counts
from stillmap.output.run_json import RECORD
from stillmap.output.save import save
from stillmap.pipeline import Options, Progress, resolved
from stillmap.recording import Recording, read
from stillmap.recording.poses import poses_from_tum
from stillmap.result import Result, build
from stillmap.scene.rig import Tilting
from stillmap.stages import Stages

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
    with held(output) as place:
        try:
            result, in_3d = _mapped_and_saved(args, options, place)
            place.forget()
        except OSError as error:
            if error.errno not in _FULL:
                raise
            raise InputError(f"cannot go on: {error.strerror}", where=str(place.folder)) from error
        except (KeyboardInterrupt, SystemExit):
            if place.present is not None:
                _tell(args, f"{place.folder} keeps how far it came: --resume goes on from there")
            raise
    if not args.quiet:
        _say(result, in_3d, output)
    if args.json:
        print_json(_summary(output))
    return 0


def _mapped_and_saved(
    args: argparse.Namespace, options: Options, place: Place
) -> tuple[Result, Tilting | None]:
    """The whole job; how far it has come is kept after every iteration."""
    stages = Stages()
    with stages.measure("read"):
        with shown_share(args.quiet, "reading") as tell:
            found = read(Path(args.input), options.read, progress=tell, scratch=place.folder)
        recording = _usable(found, args)
        poses = _given_poses(recording, args)
        tilting = read_tilting(args, recording, options, place.folder)
        _require_known(recording, options, args)
        options = resolved(options, recording)
        same = identity(recording, options, poses)
    loop = _resumed(args, place, same, options, stages)
    with shown_progress(args.quiet, em.iterations(options.estimator, options.em)) as progress:
        result = build(
            recording,
            options,
            poses=poses,
            progress=progress,
            stages=stages,
            scratch=place.folder,
            go_on=loop,
            keep=lambda loop: place.save(loop, same, stages),
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
        save(result, Path(args.output), replace, within=place.folder, tilting=in_3d, models=models)
    return result, in_3d


def _modelled(
    result: Result, in_3d: Tilting | None, progress: Progress, stages: Stages
) -> tuple[Models | None, Result]:
    """Models of what is in 3D, where they are wanted and can be made; and what the result says."""
    if not result.options.mesh.enabled or (in_3d is None and result.recording.dimension == 2):
        return None, result
    try:
        models = models_of(result, tilting=in_3d, progress=progress, stages=stages)
    except MissingExtra as error:
        warning = f"no models: {error}"
        return None, dataclasses.replace(result, warnings=[*result.warnings, warning])
    warnings = [*result.warnings]
    if not len(models.painted.mesh):
        warnings.append("no model of the place: hardly any beams lie side by side on it")
    if count := len(models.unread):
        what = (
            "a picture is not used" if count == 1 else f"{count} pictures are not used, the first"
        )
        warnings.append(f"{what}: {models.unread[0]}")
    return models, dataclasses.replace(result, warnings=warnings, stages=stages.to_dict())


def _resumed(
    args: argparse.Namespace,
    place: Place,
    same: dict[str, Any],
    options: Options,
    stages: Stages,
) -> Loop | None:
    """How far an interrupted run came, if it is to be gone on from."""
    if place.present is None:
        return None
    if not args.resume:
        _tell(args, "an earlier run was interrupted: begins anew, --resume would go on from it")
        place.forget()
        return None
    try:
        loop = place.load(same, options, stages)
    except Damaged as error:
        say(f"warning: {error}; begins anew")
        place.forget()
        return None
    if loop is not None:
        _tell(args, f"goes on after iteration {len(loop.records)}")
    return loop


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
    if recording.dimension == 3 and options.estimator not in em.IN_SPACE:
        raise InputError(
            f"is 3D: estimator '{options.estimator}' knows 2D recordings alone",
            where=args.input,
            hint=f"--estimator {' or '.join(em.IN_SPACE)}",
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


def _say(result: Result, in_3d: Tilting | None, output: Path) -> None:
    counts = beam_counts(result.recording, result.p_static)
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
