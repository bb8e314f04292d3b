"""Which pictures paint what moved: those in which it, and nothing else, is seen (Fig. 13)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from stillmap.core.camera import is_in_image, project
from stillmap.mesh.background import Background, sample_buffer
from stillmap.mesh.objects.reconstruction import ObjectShape
from stillmap.mesh.options import ChoiceOptions, MoverOptions, VisibleOptions
from stillmap.mesh.place import ViewAssignment, resolve_assignment
from stillmap.mesh.simplification import subdivide
from stillmap.mesh.texture.occluders import TrackedBox, boxes_at, occlusion_probability
from stillmap.mesh.texture.view_selection import NONE, Candidates, view_utility
from stillmap.mesh.texture.views import View
from stillmap.mesh.texture.visibility import find_visible_faces, render_depth
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]

_LEAST = 1e-9
_SCRAPS = 0.05  # of its area: less is no picture of it


@dataclass(frozen=True, eq=False)
class TexturedViews:
    """A moving thing's surface and what paints it, in the thing's own frame.

    Attributes:
        painted: its faces, and which of `views` paints each.
        views: pictures, as if the thing had stood still: `T_camera_map` is T_camera_object.
    """

    assignment: ViewAssignment
    views: list[View]


def times_in_view(thing: TrackedBox, views: Sequence[View], start_ns: int) -> Float:
    """(N,) s, when views show the middle of a thing, by the time of its box; NaN: not."""
    seconds = np.array([1e-9 * (view.stamp_ns - start_ns) for view in views])
    out = np.full(len(views), np.nan)
    for k, (view, now) in enumerate(zip(views, seconds.tolist(), strict=True)):
        for cuboid in boxes_at([thing], now):
            uv, ok = project(view.camera, view.to_camera(cuboid.center[None]))
            if ok[0] and is_in_image(view.camera, uv)[0]:
                out[k] = now
    return out


def assign_object_views(
    shape: ObjectShape,
    views: Sequence[View],
    place: Background,
    things: Sequence[TrackedBox],
    start_ns: int,
    options: MoverOptions,
    choice: ChoiceOptions,
    limits: VisibleOptions,
) -> TexturedViews:
    """Chooses for each face of what moved the view that shows it best.

    A view may paint a face if the place does not hide it, if no other thing is likely to, and if it
    lies within the thing's outline by `options.rim`, and more with time: beside that it shows what
    is behind. So it may within it, too, as between legs: there must be other colours than what the
    place behind has in other views. Where none shows that, a face must lie farther within.

    Args:
        shape: the thing.
        views: pictures and where they were taken, in the map frame.
        place: what stands still, of the same views.
        things: all that moves, this one too.
        start_ns: when the time of the things begins.
        options, choice, limits: see there.
    """
    mesh, _ = subdivide(shape.mesh, min(choice.edge, options.edge))
    candidates = Candidates.empty(len(mesh), choice.candidates)
    sharpest, own = Candidates.empty(len(mesh), 1), list[View]()
    others = [one for one in things if one.box.object_id != shape.id]
    seconds = times_in_view(shape.frame.box, views, start_ns)
    for number, (view, now) in enumerate(zip(views, seconds.tolist(), strict=True)):
        away = max(shape.span[0] - now, now - shape.span[1], 0.0)
        if np.isnan(now) or (not shape.rigid and away > options.near):
            continue
        T_map_object = shape.frame.T_map_object(now)
        rim = options.rim + options.drift * (0.0 if shape.rigid else _gone(shape, now))
        moved = replace(view, T_camera_map=view.T_camera_map @ T_map_object)
        found = find_visible_faces(mesh, moved, limits)
        faces = np.flatnonzero(found.visible)
        within = _within(mesh, faces, moved, limits)
        points = mesh.centers[faces] @ T_map_object[:3, :3].T + T_map_object[:3, 3]
        own_colours = _shows_it(points, within - rim, number, place, options)
        faces, points = faces[own_colours], points[own_colours]
        if not len(faces):
            continue
        hidden = occlusion_probability(
            boxes_at(others, now), view.position, points, choice.margin, choice.sigma
        )
        pixels = found.pixels[faces].astype(np.float64)
        good = view_utility(
            1.0 - hidden, pixels, mesh.areas()[faces], replace(choice, believe=True)
        )
        if not shape.rigid:  # who walks looks otherwise a moment later
            good -= away / max(options.near, _LEAST)
        candidates.add(len(own), faces, good, 1.0 - hidden)
        sharpest.add(len(own), faces, pixels, 1.0 - hidden)
        own.append(moved)
    painted = resolve_assignment(mesh, candidates, sharpest, choice.border)
    areas = mesh.areas()
    if areas[painted.view >= 0].sum() < _SCRAPS * areas.sum():
        painted = replace(painted, view=np.full_like(painted.view, NONE))
    return TexturedViews(painted, own)


def _shows_it(
    points: Float, within: Float, number: int, place: Background, options: MoverOptions
) -> NDArray[np.bool_]:
    """(n,) whether a view shows a thing where it has points (n, 3) in the map frame.

    They lie (n,) metres farther within its outline than they need to. Nothing of the place is
    before them, and the view's colours are not those of the place behind.
    """
    shown = within >= 0.0
    shown[shown] = place.is_unoccluded(number, points[shown])
    if options.differs > 0.0 and shown.any():
        off = place.color_difference(number, points[shown])
        unsure = np.isnan(off) & (within[shown] >= options.unsure)
        shown[shown] = unsure | (off >= options.differs)
    return shown


def _gone(shape: ObjectShape, seconds: float) -> float:
    """Metres that a thing went from when its shape was seen to a time."""
    there = shape.frame.box.box.center_at(np.array([shape.seconds, seconds]))
    return float(np.linalg.norm(there[1] - there[0]))


def _within(mesh: Mesh, faces: NDArray[np.intp], view: View, limits: VisibleOptions) -> Float:
    """(n,) metres by which faces (n,) lie within the outline of a mesh."""
    if not len(faces):
        return np.zeros(0)
    points = view.to_camera(mesh.vertices)
    depths = render_depth(
        mesh, view, points[np.unique(mesh.faces[faces])], limits.scale, limits.near
    )
    far = ndimage.distance_transform_edt(np.pad(depths.face >= 0, 1))[1:-1, 1:-1]
    at = np.concatenate([points[mesh.faces[faces]], points[mesh.faces[faces]].mean(1)[:, None]], 1)
    metres = sample_buffer(far, depths, at) * at[..., 2] / depths.K[0, 0]
    return np.asarray(metres.min(axis=1))
