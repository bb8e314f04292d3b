"""Models of a recording in 3D: a surface, painted; and what moved, likewise (Sect. 4.4, 4.5)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Images
from stillmap.core.errors import import_extra
from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.mesh.background import Background
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.objects.merging import ObjectTrack, collect_tracks, merge_tracks
from stillmap.mesh.objects.reconstruction import ObjectShape, reconstruct_object
from stillmap.mesh.objects.segmentation import DynamicReturns
from stillmap.mesh.objects.texturing import TexturedViews, assign_object_views, times_in_view
from stillmap.mesh.options import MeshOptions, VisibleOptions
from stillmap.mesh.place import ViewAssignment, assign_views
from stillmap.mesh.point_colors import PointColors, color_points
from stillmap.mesh.texture.atlas import TexturedMesh, replace_faces
from stillmap.mesh.texture.baking import bake_texture
from stillmap.mesh.texture.exposure import apply_gains
from stillmap.mesh.texture.views import (
    UNREADABLE,
    View,
    filter_readable,
    find_views,
    read_color_image,
)
from stillmap.mesh.tsdf import build_surface

Float = NDArray[np.float64]
Read = Callable[[int], NDArray[Any]]
Tell = Callable[[int, int], None]

_NEEDED = ("skimage.measure", "pyfqmr", "xatlas", "trimesh")  # of the extra `mesh`
_SPOILED = 0.5  # probability that a picture shows static things only, below which it does not


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """What moved, as a model in its own frame: x ahead, y left, z up, on the ground.

    Attributes:
        shape: its surface, and where it was.
        dressed: which view paints each face.
        textured: with the pictures on it.
        T_map_object: (4, 4) where it was when it was of this shape.
        stamp_ns: when that was.
        span_ns: from when to when what was seen of it is in the model.
    """

    shape: ObjectShape
    face_views: TexturedViews
    textured: TexturedMesh
    T_map_object: Float
    stamp_ns: int
    span_ns: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Models:
    """The place without its people, and the people.

    Attributes:
        painted: the surface of the place, and which of `views` paints each face.
        textured: with the pictures on it.
        unfiltered: the same with the sharpest picture wherever that probably shows something that
            moves, as it would be without labels; None where that is nowhere.
        views: the pictures that can be used.
        left_out: how many others there are, by reason.
        unread: a line for each of the others that could not be read.
        movers: models of what moved, in the order of the objects.
        tried: how many objects there are.
        tints: colours of the beams' ends; None where there are no pictures, or nobody wants them.
    """

    assignment: ViewAssignment
    textured: TexturedMesh
    unfiltered: TexturedMesh | None
    views: list[View]
    left_out: dict[str, int]
    unread: list[str]
    objects: list[ObjectModel]
    n_objects: int
    point_colors: PointColors | None = None


def require_extras() -> None:
    """Refuses before any work is done.

    Raises:
        MissingExtra: a library of the extra `mesh` is not installed.
    """
    for module in _NEEDED:
        import_extra(module, "mesh.glb", "made", group="mesh")


def build_models(
    sources: MeshInputs,
    options: MeshOptions,
    threads: int = 1,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
) -> Models:
    """A surface from what stands still, and for each face the picture that most likely shows it.

    Args:
        sources: a recording of which everything is known.
        options: see MeshOptions.
        threads: same result with any number.
        progress: called with what is done, 0, and how much of it.
        stages: where time and memory per stage are noted.

    Raises:
        MissingExtra: a library of the extra `mesh` is not installed.
    """
    stages = stages or StageTimer()

    def tell(what: str) -> Tell:
        return lambda done, total: progress(what, 0, done, total)

    with stages.measure("surface"):
        mesh = build_surface(
            sources.deskewed,
            sources.poses,
            sources.p_static,
            options.surface,
            threads,
            tell("building the surface"),
        )
    with stages.measure("painting"):
        views, left_out, unread = _usable(sources, tell("reading pictures"))
        limits = options.texture.visible
        place, gain = assign_views(
            mesh, views, sources, options.choice, limits, threads, tell("choosing pictures")
        )
        sources = _levelled(sources, views, gain)
    progress("putting pictures on the surface", 0, 0, 0)
    with stages.measure("texture"):
        read = _reader(sources.recording.images)
        textured = bake_texture(place.mesh, place.view, views, read, options.texture)
        unfiltered = _unfiltered(textured, place, views, read, options)
    ahead = _ahead(place, views, sources.recording.images, limits)
    with stages.measure("movers"):
        movers, moves = [], DynamicReturns.collect(sources)
        if options.objects.enabled:
            movers = _movers(sources, moves, views, ahead, options, tell("building what moved"))
    tints = None
    if views and options.points.enabled:
        with stages.measure("points"):
            now = tell("colouring points")
            tints = color_points(sources, textured, ahead, moves, options, threads, now)
    tried = len(sources.objects)
    return Models(place, textured, unfiltered, views, left_out, unread, movers, tried, tints)


def _usable(sources: MeshInputs, tell: Tell) -> tuple[list[View], dict[str, int], list[str]]:
    """Pictures of a known place that can be read; how many cannot be used, and which not read."""
    views, left_out = find_views(sources.recording, sources.poses)
    views, unread = filter_readable(sources.recording.images, views, tell)
    if unread:
        left_out = {**left_out, UNREADABLE: left_out.get(UNREADABLE, 0) + len(unread)}
    return views, left_out, unread


def _levelled(sources: MeshInputs, views: Sequence[View], gain: Float) -> MeshInputs:
    """The same with pictures of one exposure."""
    images = sources.recording.images
    if images is None:
        return sources
    recording = replace(sources.recording, images=apply_gains(images, views, gain))
    return replace(sources, recording=recording)


def _unfiltered(
    textured: TexturedMesh,
    place: ViewAssignment,
    views: list[View],
    read: Read,
    options: MeshOptions,
) -> TexturedMesh | None:
    """With the sharpest picture on the faces of which that probably shows something that moves."""
    spoiled = (place.sharpest >= 0) & (place.p_sharpest < _SPOILED)
    if not spoiled.any():
        return None
    part = bake_texture(
        place.mesh.select(spoiled), place.sharpest[spoiled], views, read, options.texture
    )
    return replace_faces(textured, spoiled, part)


def _reader(images: Images | None) -> Read:
    if images is not None:
        return images.read

    def none(image: int) -> NDArray[Any]:
        raise IndexError(f"there is no picture {image}")

    return none


def _ahead(
    place: ViewAssignment, views: list[View], images: Images | None, limits: VisibleOptions
) -> Background:
    def colours(view: View) -> NDArray[np.uint8] | None:
        return None if images is None else read_color_image(images, view)

    return Background(place, views, limits, colours)


def _movers(
    sources: MeshInputs,
    moves: DynamicReturns,
    views: Sequence[View],
    ahead: Background,
    options: MeshOptions,
    tell: Tell,
) -> list[ObjectModel]:
    followed = collect_tracks(sources, moves, options.objects)
    wholes = merge_tracks(followed, moves, sources, options.objects)
    out = []
    for number, whole in enumerate(wholes):
        model = _mover(whole, sources, moves, views, ahead, options)
        if model is not None:
            out.append(model)
        tell(number + 1, len(wholes))
    return sorted(out, key=lambda model: model.shape.id)


def _mover(
    whole: Sequence[ObjectTrack],
    sources: MeshInputs,
    moves: DynamicReturns,
    views: Sequence[View],
    place: Background,
    options: MeshOptions,
) -> ObjectModel | None:
    """The model of what was followed as one or more objects; None where `shape_of` finds none."""
    start = sources.start_ns
    seconds = [times_in_view(one.box, views, start) for one in whole]
    shown = [some[np.isfinite(some)] for some in seconds]
    shape = reconstruct_object(whole, sources, moves, options.objects, shown)
    if shape is None:
        return None
    parts = {one.object.id for one in whole if one.object.id != shape.id}
    dress = assign_object_views(
        shape,
        views,
        place,
        [thing for thing in sources.boxes if thing.box.object_id not in parts],
        start,
        options.objects,
        options.choice,
        options.texture.visible,
    )
    read = _reader(sources.recording.images)
    textured = bake_texture(
        dress.assignment.mesh, dress.assignment.view, dress.views, read, options.texture
    )
    T = shape.frame.T_map_object(shape.seconds)
    first, middle, last = (
        start + round(1e9 * seconds) for seconds in (shape.span[0], shape.seconds, shape.span[1])
    )
    return ObjectModel(shape, dress, textured, T, middle, (first, last))
