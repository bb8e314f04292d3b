"""View assignment: the image that textures each face of the static surface (Sect. 4.4)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from stillmap.core.camera import project
from stillmap.core.parallel import map_ordered
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.simplification import subdivide
from stillmap.mesh.texture.exposure import estimate_gains
from stillmap.mesh.texture.occluders import (
    OUTLINE_MARGIN,
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
from stillmap.mesh.types import Bool, Float, Float32, Index, Int32, Tell

CANDIDATES = 6  # views compared for each face
SEAM_COST = 1.0  # e-folds of resolution where two images meet
_P_UNOBSERVED = 0.9  # that an image shows static surface where no beam tells
_MAX_COLOR_DIFFERENCE = 40.0  # of 442, from the median color of a face's candidates
_MAX_FACE_EDGE = 0.25  # m: longer edges are subdivided, as each part has its own view
_MIN_EDGE_PIXELS = 16.0  # edges shorter than this in the nearest image are not


@dataclass(frozen=True, eq=False)
class ViewAssignment:
    """A surface of F faces, and which of N views textures each.

    Attributes:
        mesh: the surface, its long edges subdivided.
        view: (F,) number of the view; -1: none shows it without a mover in front.
        p_static: (F,) probability that this view shows static surface only; 0 without a view.
        visible: (F,) whether any view shows it at all.
        sharpest: (F,) number of the view with most pixels, movers or not.
        p_sharpest: (F,) probability that this one shows static surface only.
    """

    mesh: Mesh
    view: Int32
    p_static: Float32
    visible: Bool
    sharpest: Int32
    p_sharpest: Float32


def assign_views(
    mesh: Mesh,
    views: Sequence[View],
    inputs: MeshInputs,
    threads: int = 1,
    tell: Tell | None = None,
    use_occlusion: bool = True,
) -> tuple[ViewAssignment, Float]:
    """Chooses for each face the view that most likely shows static surface only (Sect. 4.4).

    Args:
        mesh: the static surface.
        views: images and their poses.
        inputs: beams and objects.
        threads: same result with any number.
        tell: called with the number of views done and the total.
        use_occlusion: without, the sharpest view is taken, movers or not.

    Returns:
        The view of each face; (N, 3) gains for the colors of N views.
    """
    if views:
        mesh, _ = subdivide(mesh, partial(max_edge_at, views))
    returns, areas = inputs.index_returns(), mesh.areas()
    candidates = Candidates.empty(len(mesh), min(CANDIDATES, max(len(views), 1)))
    sharpest = Candidates.empty(len(mesh), 1)

    def evaluate(view: View) -> tuple[Index, Float, Float]:
        found = find_visible_faces(mesh, view)
        faces = np.flatnonzero(found.visible)
        p = np.zeros(0)
        if len(faces):
            p = p_unoccluded(mesh, faces, view, returns, inputs.boxes)
        return faces, found.pixels[faces].astype(np.float64), p

    for number, (faces, pixels, p) in enumerate(map_ordered(evaluate, views, threads)):
        candidates.add(number, faces, view_utility(p, pixels, areas[faces], use_occlusion), p)
        sharpest.add(number, faces, pixels, p)
        if tell is not None:
            tell(number + 1, len(views))
    images, gains = inputs.recording.images, np.ones((len(views), 3))
    if views and images is not None:
        colors = sample_face_colors(mesh, candidates, views, partial(read_color_image, images))
        gains = estimate_gains(candidates.view, colors, len(views))
        colors *= gains[candidates.view]  # NaN where there is no view
        if use_occlusion:
            candidates = reject_inconsistent_views(candidates, colors, _MAX_COLOR_DIFFERENCE)
    return resolve_assignment(mesh, candidates, sharpest), gains


def max_edge_at(views: Sequence[View], points: Float) -> Float:
    """(n,) metres, maximum length of edges that end at points (n, 3).

    `_MAX_FACE_EDGE`, or where the nearest camera is far, `_MIN_EDGE_PIXELS` of its images.
    """
    away, nearest = cKDTree(np.array([view.position for view in views])).query(points)
    focal = np.array([0.0 if view.camera.K is None else view.camera.K[0, 0] for view in views])
    wide = _MIN_EDGE_PIXELS * away / np.maximum(focal[nearest], 1.0)
    return np.asarray(np.maximum(_MAX_FACE_EDGE, wide), np.float64)


def resolve_assignment(mesh: Mesh, candidates: Candidates, sharpest: Candidates) -> ViewAssignment:
    """Selects the view of each of F faces from its candidates, with few seams.

    Args:
        mesh: F faces.
        candidates: the best views of each.
        sharpest: the view of each with most pixels.
    """
    view = select_views(candidates, mesh.adjacent_faces(), SEAM_COST)
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
    faces: Index,
    view: View,
    returns: LidarReturns,
    boxes: Sequence[TrackedBox],
) -> Float:
    """(n,) probability that a view shows static surface only at faces (n,).

    From the returns near its timestamp, and where there are none from the boxes of moving objects;
    the minimum over the corners and the center of a face.
    """
    part = mesh.subset(faces)
    points = np.concatenate([part.vertices, part.centers])
    seconds = 1e-9 * (view.stamp_ns - returns.start_ns)
    there = boxes_at(boxes, seconds)
    free = 1.0 - occlusion_probability(there, view.position, points)
    ends, p_static = returns.near_time(view.stamp_ns)
    # a laser sees past an object what the camera beside it does not see
    informative = (p_static < 0.5) | ~is_in_or_behind_box(there, view.position, ends)
    mask = build_occlusion_mask(view, ends[informative], p_static[informative])
    local = view.to_camera(points)
    uv, ok = project(view.camera, local)
    uv = np.where(ok[:, None], uv, 0.0)  # corners just outside: as at the border
    p = mask.p_unoccluded(uv, local[:, 2], OUTLINE_MARGIN, _P_UNOBSERVED * free)
    a, b, c = (p[part.faces[:, k]] for k in range(3))
    return np.minimum(np.minimum(a, b), np.minimum(c, p[len(part.vertices) :]))
