"""Read what `stillmap map` is given, and map it: EM, then a tilting laser and the meshes."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.cli.console import say, show_share
from stillmap.core.advice import advise
from stillmap.core.errors import InputError, MissingExtra
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer
from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.io.input_groups import InputGroup
from stillmap.io.registry import detect_format
from stillmap.io.text_lines import Progress as ReadProgress
from stillmap.pipeline import inputs
from stillmap.pipeline.checkpoint import CheckpointFolder, identify_run
from stillmap.pipeline.estimate import EmState
from stillmap.pipeline.map_frame import objects_to_local
from stillmap.pipeline.options import Options, resolve_options
from stillmap.pipeline.result import MappingResult, map_recording
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.overrides import select_time
from stillmap.prepare.time_window import TimeWindow
from stillmap.results.region import crop_result, require_overlap

if TYPE_CHECKING:
    from stillmap.mesh.build import Models
    from stillmap.rig.build import TiltingResult


class Inputs(NamedTuple):
    """The recording, its options, poses to keep, and the recording of a tilting laser."""

    recording: Recording
    options: Options
    poses: NDArray[np.float64] | None
    tilting: Recording | None


def read_inputs(
    args: argparse.Namespace,
    group: InputGroup,
    options: Options,
    scratch: Path,
    stages: StageTimer,
) -> Inputs:
    """Read the inputs, one recording or its parts, and resolve the options for them."""
    with stages.measure("read"):
        with show_share(args.quiet, "reading") as progress:
            recording = inputs.read_group(group, options.read, progress=progress, scratch=scratch)
        if args.no_odometry:
            recording = recording.without_odometry()
        poses = inputs.read_poses(args.poses or None, recording)
        inputs.require_mappable(recording, options, poses)
        with show_share(args.quiet, "reading") as progress:
            tilting = _read_tilting_laser(
                group.paths, args.tilting, recording, options, progress, scratch
            )
        return Inputs(recording, resolve_options(options, recording), poses, tilting)


def _read_tilting_laser(
    planar_paths: tuple[str, ...],
    tilting_path: str | None,
    planar: Recording,
    options: Options,
    progress: ReadProgress | None,
    scratch: Path,
) -> Recording | None:
    """Read the tilting laser from its own recording, or from a topic of the planar one's bag.

    Returns:
        The recording, None where neither `tilting_path` nor `read.tilting_topic` is given.

    Raises:
        InputError: it cannot be read, or is not of the same robot and time as the planar one.
    """
    topic = options.read.tilting_topic
    if tilting_path and topic is not None:
        raise InputError("--tilting and --tilting-topic exclude each other")
    if not tilting_path and topic is None:
        return None
    if planar.dimension != 2:
        what = "the planar laser decides which objects move, but this recording is 3D"
        raise InputError(what, where=planar_paths[0])
    # the part to be mapped counts from the start of the planar recording
    whole = dataclasses.replace(options.read, start=None, end=None)
    if topic is not None:
        base_frame = planar.source.get("base_frame") or None
        read_as = dataclasses.replace(whole, topic=topic, tilting_topic=None, base_frame=base_frame)
        tilting = _read_topic(planar_paths, read_as, progress, scratch)
    else:
        # a topic chosen for INPUT is not in the other recording
        read_as = dataclasses.replace(whole, topic=None)
        tilting = read(Path(str(tilting_path)), read_as, progress=progress, scratch=scratch)
    from stillmap.rig.build import check_rig  # only a rig needs it

    path = tilting_path or planar_paths[0]
    if "part" in planar.source:
        origin_ns = planar.source["part"]["first_stamp_ns"]
        tilting = select_time(tilting, TimeWindow(options.read, origin_ns), path)
    check_rig(planar, tilting, path)
    return dataclasses.replace(tilting, source={**tilting.source, "path": path})


def _read_topic(
    paths: tuple[str, ...], options: ReadOptions, progress: ReadProgress | None, scratch: Path
) -> Recording:
    from stillmap.io.builder import ReadContext
    from stillmap.io.ros.reader import read_parts  # message types take long to load

    bags = [Path(path) for path in paths]
    for path in bags:
        if detect_format(path).name != "ROS bag":
            raise InputError("--tilting-topic is for bags", where=str(path))
    with np.errstate(over="ignore", invalid="ignore"):
        return read_parts(bags, ReadContext(options, progress, scratch), tilting=True)


def build_all(
    args: argparse.Namespace,
    found: Inputs,
    checkpoints: CheckpointFolder,
    progress: Progress,
    stages: StageTimer,
) -> "tuple[MappingResult, TiltingResult | None, Models | None]":
    """EM with a checkpoint per iteration, then the tilting laser and the meshes."""
    options = found.options
    with stages.measure("read"):
        run_id = identify_run(found.recording, options, found.poses)
    result = map_recording(
        found.recording,
        options,
        poses=found.poses,
        progress=progress,
        stages=stages,
        scratch=checkpoints.folder,
        resume=_load_checkpoint(args, checkpoints, run_id, found, stages),
        checkpoint=lambda state: checkpoints.save(state, run_id, stages),
    )
    require_overlap(result.map, options.output.region)
    tilting = None
    if found.tilting is not None:
        progress("removing moving objects", 0, 0, 0)
        with stages.measure("tilting"):
            tilting = _map_tilting_laser(result, found.tilting, options)
    models, warnings = _build_models(result, tilting, progress, stages)
    warnings = [*result.warnings, *warnings]
    result = dataclasses.replace(result, warnings=warnings, stages=stages.to_dict())
    return crop_result(result), tilting, models


def _build_models(
    result: MappingResult, tilting: "TiltingResult | None", progress: Progress, stages: StageTimer
) -> "tuple[Models | None, list[str]]":
    """Build the meshes of a 3D recording where they are wanted; return them and warnings."""
    if not _wants_models(result, tilting):
        return None, []
    from stillmap.pipeline.models import build_models  # meshes take long to load

    try:
        models = build_models(result, tilting=tilting, progress=progress, stages=stages)
    except MissingExtra as error:
        return None, [advise(f"no models: {error}", "install what is missing, and map again")]
    warnings = []
    if not len(models.assignment.mesh):
        warnings.append("no mesh of the place: hardly any beams are neighbours on a surface")
    if count := len(models.unread):
        what = "an image is not used" if count == 1 else f"{count} images are not used, the first"
        warnings.append(f"{what}: {models.unread[0]}")
    return models, warnings


def _wants_models(result: MappingResult, tilting: "TiltingResult | None") -> bool:
    """True if models are enabled, or could be textured where nothing is said about them."""
    enabled = result.options.mesh.enabled
    recording = result.recording if tilting is None else tilting.recording
    if recording.dimension == 2 or enabled is False:
        return False
    if enabled or recording.images is None:
        return bool(enabled)
    from stillmap.mesh.texture.views import usable_images  # takes long to load

    return bool(usable_images(recording)[0].any())


def _load_checkpoint(
    args: argparse.Namespace,
    checkpoints: CheckpointFolder,
    run_id: dict[str, Any],
    found: Inputs,
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
    state = checkpoints.load(run_id, found.options, found.recording, stages)
    if state is not None and not args.quiet:
        say(f"continues after iteration {len(state.records)}")
    return state


@limit_blas_threads()
def _map_tilting_laser(
    result: MappingResult, tilting: Recording, options: Options
) -> "TiltingResult":
    """Map the tilting laser in 3D, given the labels and objects of the planar one."""
    from stillmap.rig.build import PlanarResult, build_tilting, shift_tilting

    frame = result.frame
    planar = PlanarResult(
        result.deskewed,
        frame.to_local(result.poses),
        result.p_static,
        objects_to_local(result.objects, frame),
    )
    threads = resolve_threads(options.threads)
    found = build_tilting(planar, tilting, options.em, threads)
    return shift_tilting(found, frame.origin)
