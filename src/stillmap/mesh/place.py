"""The static surface in images: which textures each face (Sect. 4.4), and what they show of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.core.array_types import Bool, Float, Float32, Index, Int32
from stillmap.core.camera import is_in_image, project, unproject
from stillmap.core.parallel import map_ordered
from stillmap.core.short_repr import ShortRepr
from stillmap.mesh import view_selection, visibility
from stillmap.mesh.inputs import MeshInputs, boxes_at, is_in_or_behind_box, occlusion_probability
from stillmap.mesh.texture import sample_bilinear
from stillmap.mesh.triangle_mesh import Image, Mesh, Tell, no_tell, subdivide
from stillmap.mesh.view_selection import Candidates
from stillmap.mesh.views import View, read_color_image
from stillmap.mesh.visibility import DepthBuffer

SEAM_COST = 1.0  # e-folds of resolution where two images meet
_P_UNOBSERVED = 0.9  # that an image shows static surface where no beam tells
_MAX_COLOR_DIFFERENCE = 40.0  # of 442, from the median color of a face's candidates
_MAX_FACE_EDGE = 0.25  # m: longer edges are subdivided, as each part has its own view
_MIN_EDGE_PIXELS = 16.0  # edges shorter than this in the nearest image are not
_BEHIND_TOLERANCE = 0.1  # m by which the background may lie in front of a point
_BUFFER_WIDTH = 320.0  # pixels of the z-buffers
_BORDER_RAYS = 16  # along an edge of an image, for its field of view
_CACHED_IMAGES, _CACHED_BUFFERS = 8, 256
_SHIFTS = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]  # pixels of pose error


@dataclass(frozen=True, eq=False)
class ViewAssignment(ShortRepr):
    """A surface of F faces, and which of N views textures each.

    Attributes:
        mesh: the surface, its long edges subdivided.
        view: (F,) number of the view; -1: none shows it without a mover in front.
        p_static: (F,) probability that this view shows static surface only; 0 without a view.
        visible: (F,) whether any view shows it at all.
    """

    mesh: Mesh
    view: Int32
    p_static: Float32
    visible: Bool

    def select(self, kept: Bool) -> "ViewAssignment":
        """That of the faces marked in `kept` (F,)."""
        return ViewAssignment(
            self.mesh.select(kept), self.view[kept], self.p_static[kept], self.visible[kept]
        )


def assign_views(
    mesh: Mesh, views: Sequence[View], inputs: MeshInputs, threads: int = 1, tell: Tell = no_tell
) -> tuple[ViewAssignment, Float]:
    """Chooses for each face the view that most likely shows static surface only (Sect. 4.4).

    Args:
        mesh: the static surface.
        views: images and their poses.
        inputs: beams and objects.
        threads: same result with any number.
        tell: called with the number of views done and the total.

    Returns:
        The view of each face; (N, 3) gains for the colors of N views.
    """
    if views:
        mesh, _ = subdivide(mesh, partial(max_edge_at, views))
    areas = mesh.areas()
    candidates = Candidates.empty(len(mesh))

    def evaluate(view: View) -> tuple[Index, Float, Float]:
        pixels = visibility.find_visible_faces(mesh, view)
        faces = np.flatnonzero(pixels)
        p = p_unoccluded(mesh, faces, view, inputs) if len(faces) else np.zeros(0)
        return faces, pixels[faces].astype(np.float64), p

    for number, (faces, pixels, p) in enumerate(map_ordered(evaluate, views, threads)):
        candidates.add(number, faces, view_selection.view_utility(p, pixels, areas[faces]), p)
        tell(number + 1, len(views))
    gains, read = np.ones((len(views), 3)), partial(read_color_image, inputs.images)
    if views:
        colors = view_selection.sample_face_colors(mesh, candidates, views, read)
        gains = view_selection.estimate_gains(candidates.view, colors, len(views))
        colors *= gains[candidates.view]  # NaN where there is no view
        candidates = view_selection.reject_inconsistent_views(
            candidates, colors, _MAX_COLOR_DIFFERENCE
        )
    return resolve_assignment(mesh, candidates), gains


def max_edge_at(views: Sequence[View], points: Float) -> Float:
    """(n,) metres, maximum length of edges that end at points (n, 3).

    `_MAX_FACE_EDGE`, or where the nearest camera is far, `_MIN_EDGE_PIXELS` of its images.
    """
    away, nearest = cKDTree(np.array([view.position for view in views])).query(points)
    focal = np.array([0.0 if view.camera.K is None else view.camera.K[0, 0] for view in views])
    wide = _MIN_EDGE_PIXELS * away / np.maximum(focal[nearest], 1.0)
    return np.asarray(np.maximum(_MAX_FACE_EDGE, wide), np.float64)


def resolve_assignment(mesh: Mesh, candidates: Candidates) -> ViewAssignment:
    """Selects the view of each face of a mesh from its candidates, with few seams."""
    view = view_selection.select_views(candidates, mesh.adjacent_faces(), SEAM_COST)
    p_static = np.where(candidates.view == view[:, None], candidates.p_static, 0.0).max(axis=1)
    p_static = np.where(view >= 0, p_static, 0.0).astype(np.float32)
    return ViewAssignment(mesh, view, p_static, candidates.visible)


def p_unoccluded(mesh: Mesh, faces: Index, view: View, inputs: MeshInputs) -> Float:
    """(n,) probability that a view shows static surface only at faces (n,).

    From the returns near its timestamp, and where there are none from the boxes of moving objects;
    the minimum over the corners and the center of a face.
    """
    part = mesh.select(faces)
    points = np.concatenate([part.vertices, part.centers])
    there = boxes_at(inputs.boxes, 1e-9 * (view.stamp_ns - inputs.start_ns))
    free = 1.0 - occlusion_probability(there, view.position, points)
    ends, p_static = inputs.returns_near(view.stamp_ns)
    # a laser sees past an object what the camera beside it does not see
    informative = (p_static < 0.5) | ~is_in_or_behind_box(there, view.position, ends)
    mask = visibility.build_occlusion_mask(view, ends[informative], p_static[informative])
    local = view.to_camera(points)
    uv, ok = project(view.camera, local)
    uv = np.where(ok[:, None], uv, 0.0)  # corners just outside: as at the border
    p = mask.p_unoccluded(uv, local[:, 2], _P_UNOBSERVED * free)
    a, b, c = (p[part.faces[:, k]] for k in range(3))
    return np.minimum(np.minimum(a, b), np.minimum(c, p[len(part.vertices) :]))


class Background:
    """The static surface in all views.

    Args:
        place: the surface, and which of `views` textures each face.
        views: images and their poses.
        read: (h, w, 3) the image of a view.
    """

    def __init__(
        self, place: ViewAssignment, views: Sequence[View], read: Callable[[View], Image]
    ) -> None:
        self._place, self.views = place, views
        self._buffer = lru_cache(_CACHED_BUFFERS)(self._render)
        # (h, w, 3) by the number of a view
        self.image = lru_cache(_CACHED_IMAGES)(lambda number: read(views[number]))

    def is_unoccluded(self, number: int, points: Float) -> Bool:
        """(n,) whether no background lies in front of map points (n, 3) in a view."""
        at = self.views[number].to_camera(points)
        free = at[:, 2] > visibility.NEAR
        if not free.any() or not len(self._place.mesh):
            return free
        buffer = self._buffer(number)
        free[free] = sample_buffer(buffer.depth, buffer, at[free]) > at[free, 2] - _BEHIND_TOLERANCE
        return free

    def color_difference(self, number: int, points: Float) -> Float32:
        """(n,) distance of a view's colors at map points (n, 3) from those of the background.

        In RGB, 0 to 442; background colors come from the views that texture it. NaN where no other
        view textures the background.
        """
        view, out = self.views[number], np.full(len(points), np.nan, np.float32)
        at = view.to_camera(points)
        if not len(points) or not len(self._place.mesh):
            return out
        buffer = self._buffer(number)
        face = sample_buffer(buffer.face, buffer, at).astype(np.intp)
        source = np.where(face >= 0, self._place.view[face], -1)
        here, ok = project(view.camera, at)
        source[~ok | (source == number)] = -1
        for other in np.unique(source[source >= 0]).tolist():
            image, some = self.image(other), np.flatnonzero(source == other)
            z = sample_buffer(buffer.depth, buffer, at[some])
            behind = view.to_map(at[some] * (z / at[some, 2])[:, None])
            there, ok = project(self.views[other].camera, self.views[other].to_camera(behind))
            ok &= is_in_image(self.views[other].camera, there)
            some, there = some[ok], there[ok]
            shown = sample_bilinear(self.image(number), here[some])
            known = [sample_bilinear(image, there + shift) for shift in _SHIFTS]
            off = [np.linalg.norm(shown - color, axis=1) for color in known]
            out[some] = np.min(off, axis=0)
        return out

    def _render(self, number: int) -> DepthBuffer:
        """A small z-buffer of all that a view shows."""
        view = self.views[number]
        size = (view.camera.width, view.camera.height)
        across, down = np.meshgrid(*(np.linspace(0, edge - 1, _BORDER_RAYS) for edge in size))
        shown = unproject(view.camera, np.column_stack([across.ravel(), down.ravel()]))
        shown = shown[np.isfinite(shown).all(axis=1)]
        scale = min(_BUFFER_WIDTH / view.camera.width, visibility.DEPTH_SCALE)
        return visibility.render_depth(self._place.mesh, view, shown, scale)


def sample_buffer(values: NDArray[np.generic], buffer: DepthBuffer, at: Float) -> Float:
    """(n,) values of an image (h, w) of a z-buffer at points (n, 3) in the camera's frame."""
    h, w = values.shape
    column, row = (np.rint(a).astype(np.intp) for a in visibility.project_pinhole(buffer.K, at.T))
    found = values[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
    return np.asarray(found, np.float64)
