"""View selection: which image textures which face (Sect. 4.4).

Among the images that show a face, those that probably show no mover in front of it compete by that
probability and by their resolution. Neighboring faces prefer the same image (a Potts model).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from stillmap.core.camera import project
from stillmap.mesh.texture.sampling import sample_bilinear
from stillmap.mesh.texture.views import View
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.types import Float, Float32, Image, Index, Int32

NONE = -1
MIN_P_VISIBLE = 0.6  # probability below which an image does not texture a face
_OCCLUSION_WEIGHT = 10.0  # e-folds of resolution per e-fold of that probability
_ITERATIONS = 20  # of belief propagation
_DAMPING = 0.5  # share of a message that is kept per iteration, against oscillation
_MIN_POSITIVE = 1e-6  # keeps logarithms finite
_PAIRS_PER_BLOCK = 1 << 17
_MIN_IMAGES = 3  # of a face: of two images neither is the outlier


class Candidates(NamedTuple):
    """The K best images of F faces, best first.

    Attributes:
        view: (F, K) number of the view; -1: none.
        utility: (F, K) e-folds of resolution; -inf where there is none.
        p_static: (F, K) probability that the image shows static surface only.
    """

    view: Int32
    utility: Float32
    p_static: Float32

    @classmethod
    def empty(cls, n_faces: int, k: int) -> "Candidates":
        """Candidates of faces that no image shows."""
        shape = n_faces, k
        return cls(
            np.full(shape, NONE, np.int32),
            np.full(shape, -np.inf, np.float32),
            np.zeros(shape, np.float32),
        )

    def add(self, view: int, faces: Index, utility: Float, p_static: Float) -> None:
        """Inserts a view of faces (n,) by its utility (n,); the worst candidate drops out."""
        better = utility > self.utility[faces, -1]
        faces = faces[better]
        row = np.arange(len(faces))[:, None]
        utilities = np.column_stack([self.utility[faces], utility[better].astype(np.float32)])
        order = np.argsort(-utilities, axis=1, kind="stable")[:, :-1]
        self.utility[faces] = utilities[row, order]
        for array, value in ((self.view, view), (self.p_static, p_static[better])):
            new = np.broadcast_to(np.asarray(value, array.dtype), (len(faces),))
            array[faces] = np.column_stack([array[faces], new])[row, order]


def view_utility(p_static: Float, pixels: Float, area: Float, use_occlusion: bool = True) -> Float:
    """(n,) utility of an image for faces, in e-folds of resolution; -inf: not to be used.

    Args:
        p_static: (n,) probability that it shows static surface only.
        pixels: (n,) area of each face in it: resolution and angle in one.
        area: (n,) square metres of each face.
        use_occlusion: without, resolution alone counts.
    """
    sharpness = 0.5 * np.log(np.maximum(pixels, _MIN_POSITIVE) / np.maximum(area, _MIN_POSITIVE**2))
    if not use_occlusion:
        return np.asarray(sharpness)
    certainty = _OCCLUSION_WEIGHT * np.log(np.maximum(p_static, _MIN_POSITIVE))
    return np.where(p_static >= MIN_P_VISIBLE, sharpness + certainty, -np.inf)


def select_views(candidates: Candidates, pairs: Int32, seam_cost: float) -> Int32:
    """(F,) the view of each face, -1 where there is none.

    Minimises the sum of the utility lost against each face's best view, plus `seam_cost` for each
    pair of adjacent faces with different views, by damped min-sum belief propagation.

    Args:
        candidates: of F faces.
        pairs: (N, 2) adjacent faces.
        seam_cost: e-folds of resolution.
    """
    F, K = candidates.view.shape
    best = candidates.utility.max(axis=1, keepdims=True, initial=-np.inf)
    has_view = np.isfinite(best[:, 0])
    with np.errstate(invalid="ignore"):
        cost = np.where(np.isfinite(candidates.utility), best - candidates.utility, np.inf)
    pairs = pairs[has_view[pairs].all(axis=1)]
    messages = np.zeros((2, len(pairs), K), np.float32)  # to the second face, and to the first
    belief = cost
    for _ in range(_ITERATIONS):
        for first in range(0, len(pairs), _PAIRS_PER_BLOCK):
            part = slice(first, first + _PAIRS_PER_BLOCK)
            _update_messages(candidates.view, belief, pairs[part], messages[:, part], seam_cost)
        belief = cost.copy()
        for way, receiver in enumerate(pairs.T[::-1]):
            for k in range(K):
                belief[:, k] += np.bincount(receiver, messages[way, :, k], minlength=F)
    label = np.argmin(belief, axis=1)
    return np.where(has_view, candidates.view[np.arange(F), label], NONE).astype(np.int32)


def _update_messages(
    view: Int32, belief: Float32, pairs: Int32, messages: Float32, seam_cost: float
) -> None:
    """The next messages (2, n, K) between pairs (n, 2); in place."""
    a, b = pairs.T
    before = messages.copy()
    for way, (sender, receiver) in enumerate(((a, b), (b, a))):
        own = belief[sender]
        own -= np.where(np.isfinite(own), before[1 - way], np.float32(0.0))
        K = own.shape[1]
        lowest = own[:, 0].copy()
        for k in range(1, K):
            np.minimum(lowest, own[:, k], out=lowest)
        sent, received = view[sender], view[receiver]
        for k in range(K):
            message = lowest + np.float32(seam_cost)
            for i in range(K):
                equal = (sent[:, i] == received[:, k]) & (sent[:, i] != NONE)
                message = np.where(equal, np.minimum(message, own[:, i]), message)
            messages[way, :, k] = _DAMPING * before[way, :, k] + (1.0 - _DAMPING) * (
                message - lowest
            )


def sample_face_colors(
    mesh: Mesh,
    candidates: Candidates,
    views: Sequence[View],
    read: Callable[[View], Image | None],
) -> Float32:
    """(F, K, 3) colors of the candidates at the centers of faces, 0 to 255; NaN: unknown.

    Args:
        mesh: F faces.
        candidates: K of each face.
        views: all views.
        read: (h, w, 3) the image of a view; None: it is damaged.
    """
    colors = np.full((*candidates.view.shape, 3), np.nan, np.float32)
    for number, view in enumerate(views):
        face, place = np.nonzero(candidates.view == number)
        image = read(view) if len(face) else None
        if image is not None:
            uv, ok = project(view.camera, view.to_camera(mesh.centers[face]))
            colors[face[ok], place[ok]] = sample_bilinear(image, uv[ok])
    return colors


def reject_inconsistent_views(
    candidates: Candidates, colors: Float32, max_difference: float
) -> Candidates:
    """Photo-consistency: drops images that most others of a face contradict.

    Args:
        candidates: K of each of F faces.
        colors: (F, K, 3) at the faces; NaN: unknown.
        max_difference: distance from the median color of all, of 442, from which on an image is
            an outlier; more than half of them must lie within half of that.
    """
    known = np.isfinite(colors[..., 0]).sum(axis=1)
    tested = np.flatnonzero(known >= _MIN_IMAGES)
    off = np.full(candidates.view.shape, np.nan, np.float32)
    median = np.nanmedian(colors[tested], axis=1, keepdims=True)
    off[tested] = np.linalg.norm(colors[tested] - median, axis=2)
    majority = 2 * (off < 0.5 * max_difference).sum(axis=1) > known
    out = majority[:, None] & (off > max_difference)
    utility = np.where(out, np.float32(-np.inf), candidates.utility)
    order, row = np.argsort(-utility, axis=1, kind="stable"), np.arange(len(utility))[:, None]
    return Candidates(
        np.where(out, np.int32(NONE), candidates.view)[row, order],
        utility[row, order],
        np.where(out, np.float32(0.0), candidates.p_static)[row, order],
    )
