"""View selection: which image textures which face (Sect. 4.4), and compensation of exposure.

Among the images that show a face, those that probably show no mover in front of it compete by that
probability and by their resolution. Neighboring faces prefer the same image (a Potts model).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.linalg import lsqr

from stillmap.core.array_types import Bool, Float, Float32, Index, Int32
from stillmap.core.camera import Images, project
from stillmap.mesh.texture import sample_bilinear
from stillmap.mesh.triangle_mesh import Image, Mesh
from stillmap.mesh.views import View, read_color_image

NONE = -1
_CANDIDATES = 6  # views compared for each face
MIN_P_VISIBLE = 0.6  # probability below which an image does not texture a face
_OCCLUSION_WEIGHT = 10.0  # e-folds of resolution per e-fold of that probability
_ITERATIONS = 20  # of belief propagation
_DAMPING = 0.5  # share of a message that is kept per iteration, against oscillation
_MIN_POSITIVE = 1e-6  # keeps logarithms finite
_MIN_IMAGES = 3  # of a face: of two images neither is the outlier
_DARK, _BRIGHT = 16.0, 240.0  # of 255: beyond these a value may be clipped
_MIN_FACES = 30  # that two images must share
_HALF_WEIGHT_FACES = 100.0  # at which a pair has half of its full weight
_SPREAD = 0.05  # of log ratios; pairs with more spread weigh less
_MIN_IMPROVEMENT = 0.9  # of the former difference that may be left
_REGULARIZATION = 0.01  # weight of gains against differences
_MAX_LOG_GAIN = np.log(2.0)


class Candidates(NamedTuple):
    """The K best images of F faces, best first until some are dropped.

    Attributes:
        view: (F, K) number of the view; -1: none.
        utility: (F, K) e-folds of resolution; -inf where there is none.
        p_static: (F, K) probability that the image shows static surface only.
        visible: (F,) whether any image shows the face at all.
    """

    view: Int32
    utility: Float32
    p_static: Float32
    visible: Bool

    @classmethod
    def empty(cls, n_faces: int, k: int = _CANDIDATES) -> "Candidates":
        """Candidates of faces that no image shows."""
        shape = n_faces, k
        return cls(
            np.full(shape, NONE, np.int32),
            np.full(shape, -np.inf, np.float32),
            np.zeros(shape, np.float32),
            np.zeros(n_faces, np.bool_),
        )

    def add(self, view: int, faces: Index, utility: Float, p_static: Float) -> None:
        """Inserts a view of faces (n,) by its utility (n,); the worst candidate drops out."""
        self.visible[faces] = True
        better = utility > self.utility[faces, -1]
        faces = faces[better]
        row = np.arange(len(faces))[:, None]
        utilities = np.column_stack([self.utility[faces], utility[better].astype(np.float32)])
        order = np.argsort(-utilities, axis=1, kind="stable")[:, :-1]
        self.utility[faces] = utilities[row, order]
        for array, value in ((self.view, view), (self.p_static, p_static[better])):
            new = np.broadcast_to(np.asarray(value, array.dtype), (len(faces),))
            array[faces] = np.column_stack([array[faces], new])[row, order]


def view_utility(p_static: Float, pixels: Float, area: Float) -> Float:
    """(n,) utility of an image for faces, in e-folds of resolution; -inf: not to be used.

    Args:
        p_static: (n,) probability that it shows static surface only.
        pixels: (n,) area of each face in it: resolution and angle in one.
        area: (n,) square metres of each face.
    """
    sharpness = 0.5 * np.log(np.maximum(pixels, _MIN_POSITIVE) / np.maximum(area, _MIN_POSITIVE**2))
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
    # to the second face of a pair, and to the first
    ways = (pairs.T, pairs.T[::-1])
    messages = np.zeros((2, len(pairs), K), np.float32)
    belief = cost
    for _ in range(_ITERATIONS):
        new = np.empty_like(messages)
        for way, (sender, receiver) in enumerate(ways):
            own = belief[sender] - np.where(np.isfinite(belief[sender]), messages[1 - way], 0.0)
            views = candidates.view[sender], candidates.view[receiver]
            new[way] = _least_costs(own, *views, seam_cost)
        messages = _DAMPING * messages + (1.0 - _DAMPING) * new
        belief = cost.copy()
        for way, (_, receiver) in enumerate(ways):
            np.add.at(belief, receiver, messages[way])
    label = np.argmin(belief, axis=1)
    return np.where(has_view, candidates.view[np.arange(F), label], NONE).astype(np.int32)


def _least_costs(own: Float32, sent: Int32, received: Int32, seam_cost: float) -> Float32:
    """(n, K) least costs of n faces, whose views `sent` (n, K) cost `own` (n, K), for each view
    `received` (n, K) of a face beside; relative to the least of all."""
    lowest = own.min(axis=1)
    least = np.repeat(lowest[:, None] + np.float32(seam_cost), own.shape[1], axis=1)
    # view by view: all pairs of views at once would take K times the memory
    for view, cost in zip(sent.T, own.T, strict=True):
        same = (received == view[:, None]) & (view != NONE)[:, None]
        np.minimum(least, cost[:, None], out=least, where=same)
    return np.asarray(least - lowest[:, None], np.float32)


def sample_face_colors(
    mesh: Mesh, candidates: Candidates, views: Sequence[View], read: Callable[[View], Image]
) -> Float32:
    """(F, K, 3) colors of the candidates at the centers of faces, 0 to 255; NaN: unknown.

    Args:
        mesh: F faces.
        candidates: K of each face.
        views: all views.
        read: (h, w, 3) the image of a view.
    """
    colors = np.full((*candidates.view.shape, 3), np.nan, np.float32)
    for number, view in enumerate(views):
        face, place = np.nonzero(candidates.view == number)
        if len(face):
            image = read(view)
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
    return candidates._replace(
        view=np.where(out, np.int32(NONE), candidates.view),
        utility=np.where(out, np.float32(-np.inf), candidates.utility),
        p_static=np.where(out, np.float32(0.0), candidates.p_static),
    )


def estimate_gains(view: Int32, colors: Float32, n: int) -> Float:
    """(n, 3) gains of red, green and blue by which n images agree best.

    Pixel values are about a power of the light, so exposure and white balance are factors of
    values, too. Each pair of images gives the median log ratio d_ij over the faces that they share,
    robust against people, gloss and misaligned edges. With g the log gains and w_ij the weights,

        sum_ij w_ij (g_i - g_j - d_ij)^2 + 0.01 sum_i g_i^2

    is minimised; the last term keeps the overall brightness. All gains are 1 where images do not
    agree clearly better then: moving shadows make images of one exposure differ, too.

    Args:
        view: (F, K) views of each face, -1: none.
        colors: (F, K, 3) their colors there, 0 to 255; NaN: unknown.
        n: number of images.
    """
    one, other, brighter = _log_ratios(view, colors)
    pair, of = np.unique(one.astype(np.int64) * n + other, return_inverse=True)
    count = np.bincount(of, minlength=len(pair))
    kept = np.flatnonzero(count >= _MIN_FACES)
    if not len(kept):
        return np.ones((n, 3))
    groups = np.arange(len(pair))
    d = np.stack([ndimage.median(brighter[:, c], of, groups) for c in range(3)], axis=1)
    spread = ndimage.median(np.abs(brighter - d[of]).max(axis=1), of, groups)
    w = np.sqrt(count / (count + _HALF_WEIGHT_FACES) / (1.0 + (spread / _SPREAD) ** 2))[kept]
    rows, ones = np.tile(np.arange(len(kept)), 2), np.concatenate([w, -w])
    images = np.concatenate([pair[kept] // n, pair[kept] % n])
    equations = coo_array((ones, (rows, images)), shape=(len(kept), n)).tocsr()
    damp = np.sqrt(_REGULARIZATION)
    g = np.stack([lsqr(equations, w * d[kept, c], damp)[0] for c in range(3)], axis=1)
    g = np.clip(g, -_MAX_LOG_GAIN, _MAX_LOG_GAIN)
    left = np.median(np.abs(brighter + g[other] - g[one]))
    if left > _MIN_IMPROVEMENT * np.median(np.abs(brighter)):
        return np.ones((n, 3))
    return np.asarray(np.exp(g))


def _log_ratios(view: Int32, colors: Float32) -> tuple[Int32, Int32, Float32]:
    """Pairs (m,), (m,) of images of one face, the lower number first, and the log ratio (m, 3) of
    the second to the first; of each face's best with all others, and of neighbors in rank."""
    with np.errstate(invalid="ignore"):
        usable = ((colors >= _DARK) & (colors <= _BRIGHT)).all(axis=2) & (view >= 0)
    later = range(1, view.shape[1])
    ranks = np.array(sorted({(0, k) for k in later} | {(k - 1, k) for k in later}), np.intp)
    first, second = ranks.reshape(-1, 2).T
    pair, face = np.nonzero((usable[:, first] & usable[:, second]).T)
    a, b = first[pair], second[pair]
    image_a, image_b = view[face, a], view[face, b]
    brighter = np.log(colors[face, b] / colors[face, a])
    ratio = np.where((image_a < image_b)[:, None], brighter, -brighter)
    return np.minimum(image_a, image_b), np.maximum(image_a, image_b), ratio


def read_with_gains(images: Images, views: Sequence[View], gains: Float) -> Callable[[View], Image]:
    """Reads the images of views (n,), multiplied by gains (n, 3) and clipped at 255."""
    levels = np.arange(256)[:, None]
    tables = {
        view.image: np.rint(levels * gain).clip(0, 255).astype(np.uint8)
        for view, gain in zip(views, gains, strict=True)
    }
    return lambda view: tables[view.image][read_color_image(images, view), np.arange(3)]
