"""The place without its people: a surface, and for each face the picture that paints it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.core.camera import project
from stillmap.core.parallel import map_ordered
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.options import ChoiceOptions, VisibleOptions
from stillmap.mesh.simplification import subdivide
from stillmap.mesh.texture.exposure import estimate_gains
from stillmap.mesh.texture.occluders import (
    TrackedBox,
    boxes_at,
    is_in_or_behind_box,
    occlusion_probability,
)
from stillmap.mesh.texture.occlusion import LidarReturns, build_occlusion_mask
from stillmap.mesh.texture.view_selection import (
    Candidates,
    reject_inconsistent_views,
    sample_face_colors,
    select_views,
    view_utility,
)
from stillmap.mesh.texture.views import View, read_color_image
from stillmap.mesh.texture.visibility import find_visible_faces
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]
Index = NDArray[np.int32]
Tell = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class ViewAssignment:
    """A surface of F faces, and which of N views paints each.

    Attributes:
        mesh: the surface, its long edges divided.
        view: (F,) number of the view; -1: none sees it without something that moves before it.
        p_static: (F,) how probably that view shows static things only; 0 where there is none.
        seen: (F,) whether any view sees it at all.
        sharpest: (F,) number of the view that shows it in most pixels, whatever stands before it.
        p_sharpest: (F,) how probably that one shows static things only.
    """

    mesh: Mesh
    view: Index
    p_static: NDArray[np.float32]
    visible: NDArray[np.bool_]
    sharpest: Index
    p_sharpest: NDArray[np.float32]


def assign_views(
    mesh: Mesh,
    views: Sequence[View],
    sources: MeshInputs,
    options: ChoiceOptions,
    limits: VisibleOptions,
    threads: int = 1,
    tell: Tell | None = None,
) -> tuple[ViewAssignment, Float]:
    """Chooses for each face the view that most likely shows static things only (Sect. 4.4).

    Args:
        mesh: what stands still.
        views: pictures and where they were taken.
        sources: the beams that tell what moves, and when.
        options: see ChoiceOptions.
        limits: see VisibleOptions.
        threads: same result with any number.
        tell: called with how many views are looked at, and of how many.

    Returns:
        What paints each face; (N, 3) by which colours of N views are multiplied to be of one
        exposure.
    """
    if views:
        mesh, _ = subdivide(mesh, partial(max_edge_at, views, options))
    beams, areas = sources.index_returns(), mesh.areas()
    candidates = Candidates.empty(len(mesh), min(options.candidates, max(len(views), 1)))
    sharpest = Candidates.empty(len(mesh), 1)

    def looked_at(view: View) -> tuple[NDArray[np.intp], Float, Float]:
        found = find_visible_faces(mesh, view, limits)
        faces = np.flatnonzero(found.visible)
        p = np.zeros(0)
        if len(faces):
            p = p_unoccluded(mesh, faces, view, beams, sources.boxes, options)
        return faces, found.pixels[faces].astype(np.float64), p

    for number, (faces, pixels, p) in enumerate(map_ordered(looked_at, views, threads)):
        candidates.add(number, faces, view_utility(p, pixels, areas[faces], options), p)
        sharpest.add(number, faces, pixels, p)
        if tell is not None:
            tell(number + 1, len(views))
    images, gain = sources.recording.images, np.ones((len(views), 3))
    if views and images is not None and (options.level or (options.believe and options.odd > 0.0)):
        found = sample_face_colors(mesh, candidates, views, partial(read_color_image, images))
        if options.level:
            gain = estimate_gains(candidates.view, found, len(views))
            found *= gain[candidates.view]  # of no picture, NaN stays
        if options.believe and options.odd > 0.0:
            candidates = reject_inconsistent_views(candidates, found, options.odd)
    return resolve_assignment(mesh, candidates, sharpest, options.border), gain


def max_edge_at(views: Sequence[View], options: ChoiceOptions, points: Float) -> Float:
    """(n,) metres, how long edges may be that end at points (n, 3).

    `edge` metres, and where the nearest camera is far what is `edge_pixels` wide in its pictures.
    """
    away, nearest = cKDTree(np.array([view.position for view in views])).query(points)
    focal = np.array([0.0 if view.camera.K is None else view.camera.K[0, 0] for view in views])
    wide = options.edge_pixels * away / np.maximum(focal[nearest], 1.0)
    return np.asarray(np.maximum(options.edge, wide), np.float64)


def resolve_assignment(
    mesh: Mesh, candidates: Candidates, sharpest: Candidates, border: float
) -> ViewAssignment:
    """What paints each face once neighbours have settled.

    Args:
        mesh: F faces.
        candidates: the best views of each.
        sharpest: of each the one that shows it in most pixels.
        border: what it costs where two views meet.
    """
    view = select_views(candidates, mesh.adjacent_faces(), border)
    p_static = np.where(candidates.view == view[:, None], candidates.p_static, 0.0).max(axis=1)
    return ViewAssignment(
        mesh,
        view,
        np.where(view >= 0, p_static, 0.0).astype(np.float32),
        sharpest.view[:, 0] >= 0,
        sharpest.view[:, 0],
        sharpest.p_static[:, 0],
    )


def p_unoccluded(
    mesh: Mesh,
    faces: NDArray[np.intp],
    view: View,
    beams: LidarReturns,
    things: Sequence[TrackedBox],
    options: ChoiceOptions,
) -> Float:
    """(n,) how probably a view shows static things only where it sees faces (n,).

    By what beams taken about then say, and where there are none by whether a thing that is followed
    stands before it; where one does, nothing behind it speaks against that. Of the corners of a
    face and its middle the least counts.
    """
    part = mesh.subset(faces)
    points = np.concatenate([part.vertices, part.centers])
    seconds = 1e-9 * (view.stamp_ns - beams.start_ns)
    there = boxes_at(things, seconds)
    free = 1.0 - occlusion_probability(there, view.position, points, options.margin, options.sigma)
    ends, p_static = beams.near_time(view.stamp_ns, options)
    # a laser sees past a thing what the camera beside it does not see
    speaks = (p_static < 0.5) | ~is_in_or_behind_box(there, view.position, ends)
    found = build_occlusion_mask(view, ends[speaks], p_static[speaks], options.margin)
    local = view.to_camera(points)
    uv, ok = project(view.camera, local)
    uv = np.where(ok[:, None], uv, 0.0)  # corners just outside: as at the edge
    p = found.p_unoccluded(uv, local[:, 2], options.margin, options.unseen * free)
    a, b, c = (p[part.faces[:, k]] for k in range(3))
    return np.minimum(np.minimum(a, b), np.minimum(c, p[len(part.vertices) :]))
