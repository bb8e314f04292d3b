"""Builds the models of a result: the static surface and the moving objects."""

from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.core.region import is_inside
from stillmap.em import estimate_ground
from stillmap.mesh import build
from stillmap.mesh.build import Models
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.tracked_boxes import box_objects, extrude_boxes
from stillmap.pipeline.result import MappingResult
from stillmap.rig.build import TiltingResult


@limit_blas_threads()
def build_models(
    result: MappingResult,
    *,
    tilting: TiltingResult | None = None,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
) -> Models:
    """Builds the textured surface and the object models; `result.save(models=...)` writes them.

    Args:
        result: of a 3D recording, or of the flat laser of a rig; `result.options.mesh` applies.
        tilting: 3D data of the rig's second laser.
        progress: called with the stage, 0, the work done and the total.
        stages: records time and memory per stage.

    Raises:
        ValueError: the result is 2D and there is no `tilting`.
        MissingExtra: a library of the extra `mesh` is not installed.
    """
    if tilting is None and result.recording.dimension == 2:
        raise ValueError("result: expected one in 3D")
    build.require_extras()
    threads = resolve_threads(result.options.threads)
    start_ns = int(result.recording.stamp_ns[0])
    seen = result if tilting is None else tilting
    if tilting is None:
        boxes = box_objects(result.objects, start_ns)
    else:  # the flat laser gives the tracks, the tilting laser the 3D data
        ground = estimate_ground(tilting.deskewed, tilting.poses, tilting.p_static, threads)
        boxes = extrude_boxes(tilting.boxes, tilting.objects, ground)
    region = result.options.output.region
    objects = seen.objects
    if region is not None:
        objects = [one for one in objects if is_inside(one.xy, region).any()]
    inputs = MeshInputs(
        seen.recording, seen.deskewed, seen.poses, seen.p_static, objects, boxes, start_ns
    )
    return build.build_models(inputs, result.options.mesh, threads, progress, stages, region)
