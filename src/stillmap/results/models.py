"""Models of a result: made, and written with the views that texture their faces."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stillmap.core.arrays import write_npz
from stillmap.core.grid_map import is_inside, shift_region
from stillmap.core.local_frame import Fields, Shift, shift
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.em import estimate_ground
from stillmap.mesh import build
from stillmap.mesh.build import Models, ObjectModel
from stillmap.mesh.inputs import MeshInputs, box_objects, extrude_boxes
from stillmap.mesh.place import ViewAssignment
from stillmap.mesh.texture import TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.views import View
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.tilting import TiltingResult
from stillmap.results.gltf import write_glb

if TYPE_CHECKING:
    from stillmap.results.mapped_place import MappedPlace

_MICROMETRES = 6  # digits
# fields that depend on the frame; views of moving objects and their surfaces are in that of each
_FIELDS: Fields = {
    Models: {"assignment": "part", "textured": "part", "views": "part", "objects": "part"},
    ViewAssignment: {"mesh": "part"},
    TexturedMesh: {"vertices": "points"},
    Mesh: {"vertices": "points"},
    View: {"T_camera_map": "view"},
    ObjectModel: {"T_map_object": "poses"},
}


@limit_blas_threads()
def build_models(
    result: "MappedPlace | MappingResult",
    *,
    tilting: TiltingResult | None = None,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
) -> Models:
    """Builds the textured surface and the object models; `result.save(models=...)` writes them.

    They are in the frame in which the result was computed, whose origin is `Models.origin`: zero
    unless the map frame is far away.

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
    mapped = result if isinstance(result, MappingResult) else result.mapping
    if mapped is None:
        raise ValueError("result: expected one that was just built")
    start_ns, origin = int(mapped.recording.stamp_ns[0]), mapped.origin
    seen: MappingResult | TiltingResult
    if tilting is None:
        seen = mapped.near
        boxes = box_objects(seen.objects, start_ns)
    else:  # the flat laser gives the tracks, the tilting laser the 3D data
        seen = tilting.near
        ground = estimate_ground(seen.deskewed, seen.poses, seen.p_static, threads)
        boxes = extrude_boxes(seen.boxes, seen.objects, ground)
    objects, region = seen.objects, result.options.output.region
    if region is not None:
        region = shift_region(region, -origin)
        objects = [one for one in objects if is_inside(one.xy, region).any()]
    inputs = MeshInputs(
        seen.recording, seen.deskewed, seen.poses, seen.p_static, objects, boxes, start_ns
    )
    models = build.build_models(inputs, result.options.mesh, threads, progress, stages, region)
    return dataclasses.replace(models, origin=origin) if origin.any() else models


def write_models(folder: Path, models: Models, n_images: int, quality: int) -> None:
    """Writes models into a new result folder, and beside each the views of its faces.

    Args:
        folder: of the result; its `objects/` may be there already.
        models: the static surface and the moving objects.
        n_images: of the recording.
        quality: JPEG quality of texture pages; 0: PNG.
    """
    models = shift(models, Shift(models.origin), _FIELDS)
    if len(models.textured):
        write_glb(folder / "mesh.glb", _drop_empty_texture(models.textured), quality)
        path = folder / "mesh_faces.npz"
        write_faces(path, models.assignment, models.views, n_images, "map")
    objects = folder / "objects"
    if models.objects:
        objects.mkdir(exist_ok=True)
    for one in models.objects:
        name = f"{one.shape.id:04d}"
        write_glb(objects / f"{name}.glb", _drop_empty_texture(one.textured), quality)
        path = objects / f"{name}_faces.npz"
        write_faces(path, one.assignment, one.views, n_images, "object")
        record = {
            "stamp_ns": one.stamp_ns,
            "first_stamp_ns": one.span_ns[0],
            "last_stamp_ns": one.span_ns[1],
            "T_map_object": np.round(one.T_map_object, _MICROMETRES).tolist(),
            "rigid": one.shape.rigid,
        }
        text = json.dumps(record, allow_nan=False)
        (objects / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def _drop_empty_texture(model: TexturedMesh) -> TexturedMesh | Mesh:
    """A mesh without pages loses its texture, so that viewers shade it."""
    return model if model.pages else Mesh(model.vertices, model.faces)


def write_faces(
    path: Path, assignment: ViewAssignment, views: Sequence[View], n_images: int, name: str
) -> None:
    """Writes which image textures each face; `name` of the frame that they are written in.

    `vertices` (V, 3) metres, `faces` (F, 3), `image` (F,) number of the image or -1, `p_static`
    (F,), and `T_camera_map` or `T_camera_object` (N, 4, 4) of all images, NaN where not used.
    """
    number = np.array([view.image for view in views] + [-1], np.int32)
    poses = np.full((n_images, 4, 4), np.nan)
    for view in views:
        poses[view.image] = view.T_camera_map
    write_npz(
        path,
        {
            "vertices": np.asarray(assignment.mesh.vertices, np.float64),
            "faces": assignment.mesh.faces,
            "image": number[assignment.view],
            "p_static": assignment.p_static,
            f"T_camera_{name}": poses,
        },
    )
