"""Map the inputs of `stillmap map`: EM with checkpoints, then the tilting laser and the meshes."""

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

from stillmap.cli.console import say
from stillmap.cli.map_inputs import Inputs
from stillmap.core.errors import MissingExtra
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer
from stillmap.core.recording import Recording
from stillmap.pipeline.checkpoint import CheckpointFolder, DamagedCheckpoint
from stillmap.pipeline.checkpoint_files import identify_run
from stillmap.pipeline.estimate import EmState
from stillmap.pipeline.models import build_models
from stillmap.pipeline.options import Options
from stillmap.results.result import Result, build
from stillmap.rig.build import PlanarResult, TiltingResult, build_tilting

if TYPE_CHECKING:
    from stillmap.mesh.build import Models


class Built(NamedTuple):
    """The result, the 3D result of a tilting laser, and the meshes."""

    result: Result
    tilting: TiltingResult | None
    models: "Models | None"


def build_all(
    inputs: Inputs,
    options: Options,
    checkpoints: CheckpointFolder,
    progress: Progress,
    stages: StageTimer,
    *,
    resume: bool,
    quiet: bool,
) -> Built:
    """EM with a checkpoint per iteration, then the tilting laser and the meshes."""
    with stages.measure("read"):
        run_id = identify_run(inputs.recording, options, inputs.poses)
    result = build(
        inputs.recording,
        options,
        poses=inputs.poses,
        progress=progress,
        stages=stages,
        scratch=checkpoints.folder,
        resume=_load_checkpoint(checkpoints, run_id, options, stages, resume, quiet),
        checkpoint=lambda state: checkpoints.save(state, run_id, stages),
    )
    tilting = None
    if inputs.tilting is not None:
        progress("removing moving objects", 0, 0, 0)
        with stages.measure("tilting"):
            tilting = _map_tilting_laser(result, inputs.tilting, options)
    models, warnings = _build_models(result, tilting, progress, stages)
    warnings = [*result.warnings, *warnings]
    result = dataclasses.replace(result, warnings=warnings, stages=stages.to_dict())
    return Built(result, tilting, models)


def _build_models(
    result: Result, tilting: TiltingResult | None, progress: Progress, stages: StageTimer
) -> "tuple[Models | None, list[str]]":
    """Build the meshes of a 3D recording where they are enabled; return them and warnings."""
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
    checkpoints: CheckpointFolder,
    run_id: dict[str, Any],
    options: Options,
    stages: StageTimer,
    resume: bool,
    quiet: bool,
) -> EmState | None:
    """The state of an interrupted run, where there is one and `--resume` is given."""
    if checkpoints.newest is None:
        return None
    if not resume:
        if not quiet:
            say("an earlier run was interrupted: starts anew; --resume would continue it")
        checkpoints.clear()
        return None
    try:
        state = checkpoints.load(run_id, options, stages)
    except DamagedCheckpoint as error:
        say(f"warning: {error}; starts anew")
        checkpoints.clear()
        return None
    if state is not None and not quiet:
        say(f"continues after iteration {len(state.records)}")
    return state


@limit_blas_threads()
def _map_tilting_laser(result: Result, tilting: Recording, options: Options) -> TiltingResult:
    """Map the tilting laser in 3D, given the labels and objects of the planar one."""
    planar = PlanarResult(result.deskewed, result.poses, result.p_static, result.objects)
    threads = resolve_threads(options.threads)
    return build_tilting(planar, tilting, options.rig, options.objects, options.em, threads)
