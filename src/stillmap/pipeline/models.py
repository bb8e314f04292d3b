"""Builds the models of a result: the static surface and the moving objects."""

import dataclasses

from stillmap.core.grid_map import is_inside, shift_region
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.em import estimate_ground
from stillmap.mesh import build
from stillmap.mesh.build import Models
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.tracked_boxes import box_objects, extrude_boxes
from stillmap.pipeline.map_frame import objects_to_local
from stillmap.pipeline.result import MappingResult
from stillmap.rig.build import TiltingResult, shift_tilting


@limit_blas_threads()
def build_models(
    result: MappingResult,
    *,
    tilting: TiltingResult | None = None,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
) -> Models:
    """Builds the textured surface and the object models; `result.save(models=...)` writes them.

    They are in the frame of `result.frame`, whose origin `Models.origin` is: zero unless the map
    frame is far away.

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
    start_ns, frame = int(result.recording.stamp_ns[0]), result.frame
    seen = result if tilting is None else tilting
    objects, poses = objects_to_local(seen.objects, frame), frame.to_local(seen.poses)
    if tilting is None:
        boxes = box_objects(objects, start_ns)
    else:  # the flat laser gives the tracks, the tilting laser the 3D data
        near = shift_tilting(tilting, -frame.origin)
        ground = estimate_ground(near.deskewed, near.poses, near.p_static, threads)
        boxes = extrude_boxes(near.boxes, near.objects, ground)
    region = result.options.output.region
    if region is not None:
        region = shift_region(region, -frame.origin)
    if region is not None:
        objects = [one for one in objects if is_inside(one.xy, region).any()]
    inputs = MeshInputs(
        seen.recording, seen.deskewed, poses, seen.p_static, objects, boxes, start_ns
    )
    models = build.build_models(inputs, result.options.mesh, threads, progress, stages, region)
    return dataclasses.replace(models, origin=frame.origin) if frame.is_shifted else models
