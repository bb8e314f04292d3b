"""Builds the models of a 3D recording: the textured static surface and the moving objects
(Sect. 4.4, 4.5)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from stillmap.core.array_types import Float, Int32
from stillmap.core.errors import import_extra
from stillmap.core.grid_map import Region, is_inside
from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.core.short_repr import ShortRepr
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.mover_colors import assign_object_views, color_points, times_in_view
from stillmap.mesh.options import MeshOptions
from stillmap.mesh.place import Background, ViewAssignment, assign_views
from stillmap.mesh.reconstruction import ObjectShape, reconstruct_object
from stillmap.mesh.returns import DynamicReturns, ObjectTrack, collect_tracks, merge_tracks
from stillmap.mesh.texture import TexturedMesh, bake_texture
from stillmap.mesh.triangle_mesh import Image, Mesh, Tell
from stillmap.mesh.tsdf import build_surface
from stillmap.mesh.view_selection import read_with_gains
from stillmap.mesh.views import UNREADABLE, View, filter_readable, find_views

Bake = Callable[[Mesh, Int32, list[View]], TexturedMesh]

_LIBRARIES = ("skimage.measure", "pyfqmr", "xatlas", "trimesh")  # of the extra `mesh`


@dataclass(frozen=True, eq=False)
class ObjectModel(ShortRepr):
    """A moving object as a model in its own frame: x ahead, y left, z up, on the ground.

    Attributes:
        shape: its surface, and its frame over time.
        assignment: its faces, and which of `views` textures each.
        views: images in the object's frame: `T_camera_map` is T_camera_object.
        textured: the textured surface.
        T_map_object: (4, 4) pose of the frame at `stamp_ns`.
        stamp_ns: time of this shape.
        span_ns: first and last beam that it is made of.
    """

    shape: ObjectShape
    assignment: ViewAssignment
    views: list[View]
    textured: TexturedMesh
    T_map_object: Float
    stamp_ns: int
    span_ns: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Models(ShortRepr):
    """The static surface without movers, and the moving objects.

    Attributes:
        assignment: the static surface, and which of `views` textures each face.
        textured: the textured surface.
        views: usable images.
        left_out: number of other images, by reason.
        unread: one line for each image that could not be read.
        objects: models of moving objects, in the order of the objects.
        n_objects: number of moving objects.
        point_colors: (M, 3) of the end points, see `color_points`; None without images.
        origin: (3,) metres in the map frame, the origin of the frame that all this is in.
    """

    assignment: ViewAssignment
    textured: TexturedMesh
    views: list[View]
    left_out: dict[str, int]
    unread: list[str]
    objects: list[ObjectModel]
    n_objects: int
    point_colors: Image | None = None
    origin: Float = field(default_factory=lambda: np.zeros(3))


def require_extras() -> None:
    """Checks that the libraries of the extra `mesh` are installed.

    Raises:
        MissingExtra: one is not.
    """
    for module in _LIBRARIES:
        import_extra(module, "mesh.glb", "made", group="mesh")


def build_models(
    inputs: MeshInputs,
    options: MeshOptions,
    threads: int = 1,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
    region: Region | None = None,
) -> Models:
    """Builds the static surface, textures it, and models the moving objects.

    Args:
        inputs: a posed and labelled recording.
        options: see MeshOptions.
        threads: same result with any number.
        progress: called with the stage, 0, the work done and the total.
        stages: records time and memory per stage.
        region: of which the static surface is textured and returned; the rest hides what lies
            behind it. None: everything.

    Raises:
        MissingExtra: a library of the extra `mesh` is not installed.
    """
    stages = stages or StageTimer()

    def tell(stage: str) -> Tell:
        return lambda done, total: progress(stage, 0, done, total)

    with stages.measure("surface"):
        now = tell("building the surface")
        mesh = build_surface(inputs.deskewed, inputs.poses, inputs.p_static, options, threads, now)
    with stages.measure("painting"):
        views, left_out = find_views(inputs.recording, inputs.poses)
        views, unread = filter_readable(inputs.images, views, tell("reading images"))
        if unread:
            left_out[UNREADABLE] = left_out.get(UNREADABLE, 0) + len(unread)
        place, gains = assign_views(mesh, views, inputs, threads, tell("selecting views"))
        read = read_with_gains(inputs.images, views, gains)
    progress("baking textures", 0, 0, 0)
    with stages.measure("texture"):
        bake = partial(bake_texture, read=read, texture_size=options.texture_size)
        shown = place if region is None else place.select(is_inside(place.mesh.centers, region))
        textured = bake(shown.mesh, shown.view, views)
    background = Background(place, views, read)
    with stages.measure("movers"):
        models, returns = [], DynamicReturns.collect(inputs)
        if options.objects:
            models = _model_objects(returns, background, bake, tell("modelling moving objects"))
    colors = None
    if views:
        with stages.measure("points"):
            colors = color_points(textured, background, returns, threads, tell("coloring points"))
    return Models(shown, textured, views, left_out, unread, models, len(inputs.objects), colors)


def _model_objects(
    returns: DynamicReturns, background: Background, bake: Bake, tell: Tell
) -> list[ObjectModel]:
    groups = merge_tracks(collect_tracks(returns), returns)
    out = []
    for number, tracks in enumerate(groups):
        model = _model_object(tracks, returns, background, bake)
        if model is not None:
            out.append(model)
        tell(number + 1, len(groups))
    return sorted(out, key=lambda model: model.shape.id)


def _model_object(
    tracks: Sequence[ObjectTrack], returns: DynamicReturns, background: Background, bake: Bake
) -> ObjectModel | None:
    """The model of one object; None where `reconstruct_object` finds none."""
    start = returns.inputs.start_ns
    seconds = [times_in_view(one.box, background.views, start) for one in tracks]
    shape = reconstruct_object(tracks, returns, [some[np.isfinite(some)] for some in seconds])
    if shape is None:
        return None
    parts = {one.object.id for one in tracks if one.object.id != shape.id}
    boxes = [one for one in returns.inputs.boxes if one.box.object_id not in parts]
    assignment, views = assign_object_views(shape, background, boxes, start)
    textured = bake(assignment.mesh, assignment.view, views)
    T = shape.frame.T_map_object(shape.seconds)
    times = (shape.span[0], shape.seconds, shape.span[1])
    first, middle, last = (start + round(1e9 * at) for at in times)
    return ObjectModel(shape, assignment, views, textured, T, middle, (first, last))
