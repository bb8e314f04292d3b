"""Read what `stillmap map` is given, and map it: EM, then a tilting laser and the meshes."""

import argparse
import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stillmap.cli.console import list_files, say, show_share
from stillmap.core.array_types import Float, Float32
from stillmap.core.errors import InputError, MissingExtra, advise, split_advice
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer
from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.io.builder import ReadContext
from stillmap.io.registry import detect_format
from stillmap.mapping.labelled_recording import count_beams
from stillmap.pipeline import inputs
from stillmap.pipeline.checkpoint import CheckpointFolder, identify_run
from stillmap.pipeline.em_loop import EmState
from stillmap.pipeline.options import Options, resolve_options
from stillmap.pipeline.result import MappingResult, map_recording
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.prepare import interpret
from stillmap.prepare.time_window import TimeWindow, select_time
from stillmap.results.reader import read_run
from stillmap.results.writer import crop_result, require_overlap

if TYPE_CHECKING:
    from stillmap.mesh.build import Models
    from stillmap.pipeline.tilting import TiltingResult


class Inputs(NamedTuple):
    """The recording, its options, poses to keep, and the recording of a tilting laser."""

    recording: Recording
    options: Options
    poses: Float | None
    tilting: Recording | None


def read_inputs(args: argparse.Namespace, options: Options, scratch: Path) -> Inputs:
    """Read the recording, or the parts of one, and resolve the options for it.

    Raises:
        InputError: something cannot be read, or the inputs do not follow each other.
    """
    with show_share(args.quiet, "reading") as progress:
        recording = inputs.read(args.input, options.read, progress=progress, scratch=scratch)
    if len(args.input) > 1 and not args.quiet:
        say(f"{len(args.input)} parts of one run, in the order of their stamps")
    if args.no_odometry:
        recording = recording.without_odometry()
    poses = inputs.read_poses(args.poses or None, recording)
    inputs.require_mappable(recording, options, poses)
    tilting = _read_tilting_laser(args, recording, options.read, scratch)
    return Inputs(recording, resolve_options(options, recording), poses, tilting)


def _read_tilting_laser(
    args: argparse.Namespace, planar: Recording, options: ReadOptions, scratch: Path
) -> Recording | None:
    """Read the tilting laser from its own recording, or from a topic of the planar one's bag.

    Raises:
        InputError: it cannot be read, or is not of the same robot and time as the planar one.
    """
    path, topic = args.tilting, options.tilting_topic
    if path and topic is not None:
        raise InputError("--tilting and --tilting-topic exclude each other")
    if not path and topic is None:
        return None
    if planar.dimension != 2:
        what = "the planar laser decides which objects move, but this recording is 3D"
        raise InputError(what, where=args.input[0])
    from stillmap.pipeline.tilting import check_rig  # only a rig needs it

    paths = [Path(path)] if path else [Path(part.path or "") for part in planar.source.parts]
    paths = paths or [Path(word) for word in args.input]
    # the part to be mapped counts from the start of the planar recording, which has the topics
    read_as = dataclasses.replace(
        options,
        start=None,
        end=None,
        tilting_topic=None,
        topic=topic,
        base_frame=options.base_frame if path else planar.source.base_frame or None,
    )
    with show_share(args.quiet, "reading") as progress:
        context = ReadContext(read_as, progress, scratch)
        tilting = read(paths[0], read_as, progress=progress, scratch=scratch) if path else None
        tilting = tilting or _read_topic(paths, context)
    where = str(paths[0])
    if planar.source.part is not None:
        origin_ns = planar.source.part.first_stamp_ns
        tilting = select_time(tilting, TimeWindow(options, origin_ns), where)
    check_rig(planar, tilting, where)
    source = dataclasses.replace(tilting.source, path=where)
    return dataclasses.replace(tilting, source=source)


def _read_topic(paths: Sequence[Path], context: ReadContext) -> Recording:
    from stillmap.io.ros.reader import read as read_bags  # message types take long to load

    for path in paths:
        if detect_format(path).name != "ROS bag":
            raise InputError("--tilting-topic is for bags", where=str(path))
    with np.errstate(over="ignore", invalid="ignore"):
        raw = read_bags(paths, context, tilting=True)
        return interpret(raw, context.options, context.scratch)


def build_all(
    args: argparse.Namespace,
    given: Inputs,
    checkpoints: CheckpointFolder,
    progress: Progress,
    stages: StageTimer,
) -> "tuple[MappingResult, TiltingResult | None, Models | None]":
    """EM with a checkpoint per iteration, then the tilting laser and the meshes."""
    options = given.options
    with stages.measure("read"):
        run_id = identify_run(given.recording, options, given.poses)
    result = map_recording(
        given.recording,
        options,
        poses=given.poses,
        progress=progress,
        stages=stages,
        scratch=checkpoints.folder,
        resume=_load_checkpoint(args, checkpoints, run_id, given, stages),
        checkpoint=lambda state: checkpoints.save(state, run_id, stages),
    )
    require_overlap(result.map, options.output.region)
    tilting = None
    if given.tilting is not None:
        progress("removing moving objects", 0, 0, 0)
        with stages.measure("tilting"):
            tilting = _map_tilting_laser(result, given.tilting, options)
    models, warnings = _build_models(result, tilting, progress, stages)
    warnings = [*result.warnings, *warnings]
    result = dataclasses.replace(result, warnings=warnings, stages=stages.to_dict())
    return crop_result(result), tilting, models


def _build_models(
    result: MappingResult, tilting: "TiltingResult | None", progress: Progress, stages: StageTimer
) -> "tuple[Models | None, list[str]]":
    """Build the meshes of a 3D recording where they are wanted; return them and warnings."""
    enabled = result.options.mesh.enabled
    recording = result.recording if tilting is None else tilting.recording
    if recording.dimension == 2 or enabled is False:
        return None, []
    if enabled is None:
        from stillmap.mesh.views import usable_images  # takes long to load

        if recording.images is None or not usable_images(recording)[0].any():
            return None, []
    from stillmap.results.models import build_models  # meshes take long to load

    try:
        models = build_models(result, tilting=tilting, progress=progress, stages=stages)
    except MissingExtra as error:
        return None, [advise(f"no models: {error}", "install what is missing, and map again")]
    warnings = []
    if not len(models.assignment.mesh):
        warnings.append("no mesh of the place: hardly any beams are neighbours on a surface")
    if models.unread:
        warnings.append(f"images that are not used: {len(models.unread)}, {models.unread[0]}")
    return models, warnings


def _load_checkpoint(
    args: argparse.Namespace,
    checkpoints: CheckpointFolder,
    run_id: dict[str, Any],
    given: Inputs,
    stages: StageTimer,
) -> EmState | None:
    """The state of an interrupted run, where there is one and `--resume` is given."""
    if checkpoints.newest is None:
        return None
    if not args.resume:
        if not args.quiet:
            say("an earlier run was interrupted: starts anew; --resume would continue it")
        checkpoints.clear()
        return None
    state = checkpoints.load(run_id, given.options, stages)
    if state is not None and not args.quiet:
        say(f"continues after iteration {len(state.records)}")
    return state


@limit_blas_threads()
def _map_tilting_laser(
    result: MappingResult, tilting: Recording, options: Options
) -> "TiltingResult":
    """Map the tilting laser in 3D, given the labels and objects of the planar one."""
    from stillmap.pipeline.map_frame import leave_local_frame
    from stillmap.pipeline.tilting import PlanarResult, build_tilting

    near, threads = result.near, resolve_threads(options.threads)
    planar = PlanarResult(near.deskewed, near.poses, near.p_static, near.objects)
    built = build_tilting(planar, tilting, options.em, threads)
    return leave_local_frame(built, result.origin)


_IN_SUMMARY = ("version", "converged", "best_iteration", "counts", "area", "seconds", "warnings")


def summarize(output: Path) -> dict[str, Any]:
    """The main entries of `run.json`, and the files of the result."""
    record = read_run(output)
    return {
        "output": str(output),
        "files": list_files(output),
        "iterations": len(record["iterations"]),
        **{key: record[key] for key in (*_IN_SUMMARY, "tilting") if key in record},
    }


def print_summary(
    result: MappingResult, tilting: "TiltingResult | None", models: "Models | None", output: Path
) -> None:
    """Print what was found, what is to be known about it, and where it lies."""
    n, quality = len(result.iterations), result.quality
    say(f"{result.recording.n_scans} scans, {_describe_hits(result.recording, result.p_static)}")
    ending = "" if result.converged else ", which had not converged"
    say(f"kept iteration {result.best_iteration} of {n}{ending}")
    if quality.overall is not None:
        parts = {"labels": quality.labels, "geometry": quality.geometry}
        known = [f"{name} {value:.0f}" for name, value in parts.items() if value is not None]
        say(f"quality {quality.overall:.0f} of 100: {', '.join(known)}")
    if result.changes:
        state = result.options.output.map_state
        say(f"{len(result.changes)} places changed; the map shows their state: {state}")
    if tilting is not None:
        left_out = f"; {tilting.unposed_beams} left out: the robot's pose is not known there"
        hits = _describe_hits(tilting.deskewed, tilting.p_static)
        say(f"in 3D {hits}{left_out if tilting.unposed_beams else ''}")
    for warning in result.warnings:
        # a warning where the user can do something
        say(f"{'warning' if split_advice(warning)[1] else 'note'}: {warning}")
    in_3d = tilting is not None or result.recording.dimension == 3
    if in_3d and models is None and result.options.mesh.enabled is None:
        say("no surface model: the recording has no pictures, --mesh makes a grey one")
    say(f"wrote {output}: open {output / 'report.html'}")
    say(f"see it over time: stillmap view {shlex.quote(str(output))}")


def _describe_hits(recording: Recording, p_static: Float32) -> str:
    counts = count_beams(recording.hit, p_static)
    share = 100.0 * counts["dynamic"] / max(counts["hits"], 1)
    return f"{counts['hits']} beams that hit something, {share:.1f} % of them dynamic"
