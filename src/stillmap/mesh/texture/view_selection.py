"""Which picture paints which face: the one that most likely shows static things only (Sect. 4.4).

Of the pictures that see a face those compete that probably show nothing that moves before it, by
that probability and by their resolution; neighbouring faces prefer the same picture.

Whether pictures of a face agree: one that differs from all the others shows somebody.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import project
from stillmap.mesh.options import ChoiceOptions
from stillmap.mesh.texture.baking import sample_bilinear
from stillmap.mesh.texture.views import View
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]

Float32 = NDArray[np.float32]

Index = NDArray[np.int32]

NONE = -1

_ROUNDS = 20  # in which faces settle with their neighbours

_KEPT = 0.5  # of what a face was told before, from round to round: it settles, and does not swing

_UNSURE = 1e-6

_TOGETHER = 1 << 17  # pairs worked on together


class Candidates(NamedTuple):
    """The K best pictures of F faces, the best first.

    Attributes:
        picture: (F, K) their numbers; -1: there are no more.
        utility: (F, K) how good they are, e-folds of resolution; -inf where there is none.
        p_static: (F, K) how probably each shows static things only.
    """

    view: Index
    utility: Float32
    p_static: Float32

    @classmethod
    def empty(cls, faces: int, most: int) -> "Candidates":
        """Nothing known yet of so many faces."""
        shape = faces, most
        return cls(
            np.full(shape, NONE, np.int32),
            np.full(shape, -np.inf, np.float32),
            np.zeros(shape, np.float32),
        )

    def add(self, picture: int, faces: NDArray[np.intp], utility: Float, p_static: Float) -> None:
        """Puts a picture of some faces (n,) where it belongs among the best."""
        better = utility > self.utility[faces, -1]
        faces = faces[better]
        row = np.arange(len(faces))[:, None]
        utilities = np.column_stack([self.utility[faces], utility[better].astype(np.float32)])
        order = np.argsort(-utilities, axis=1, kind="stable")[:, :-1]
        self.utility[faces] = utilities[row, order]
        for array, value in ((self.view, picture), (self.p_static, p_static[better])):
            new = np.broadcast_to(np.asarray(value, array.dtype), (len(faces),))
            array[faces] = np.column_stack([array[faces], new])[row, order]


def view_utility(p_static: Float, pixels: Float, area: Float, options: ChoiceOptions) -> Float:
    """(n,) how good a picture is for faces, in e-folds of resolution; -inf: not to be used.

    Args:
        p_static: (n,) how probably it shows static things only.
        pixels: (n,) that each face covers in it: resolution and angle in one.
        area: (n,) square metres of each face.
        options: see ChoiceOptions.
    """
    sharp = 0.5 * np.log(np.maximum(pixels, _UNSURE) / np.maximum(area, _UNSURE**2))
    if not options.believe:
        return np.asarray(sharp)
    sure = options.trust * np.log(np.maximum(p_static, _UNSURE))
    return np.where(p_static >= options.least, sharp + sure, -np.inf)


def select_views(candidates: Candidates, pairs: Index, border: float) -> Index:
    """(F,) the picture of each face, -1 where there is none.

    Minimises the sum of what is lost against each face's best picture, plus `border` for each
    pair of neighbours with different ones (a Potts model), by min-sum belief propagation.

    Args:
        candidates: the best pictures of each face.
        pairs: (N, 2) faces side by side.
        border: what it costs where two pictures meet.
    """
    F, K = candidates.view.shape
    best = candidates.utility.max(axis=1, keepdims=True, initial=-np.inf)
    painted = np.isfinite(best[:, 0])
    with np.errstate(invalid="ignore"):
        cost = np.where(np.isfinite(candidates.utility), best - candidates.utility, np.inf)
    pairs = pairs[painted[pairs].all(axis=1)]
    told = np.zeros((2, len(pairs), K), np.float32)  # to the second of each pair, and to the first
    belief = cost
    for _ in range(_ROUNDS):
        for first in range(0, len(pairs), _TOGETHER):
            part = slice(first, first + _TOGETHER)
            _tell(candidates.view, belief, pairs[part], told[:, part], border)
        belief = cost.copy()
        for way, taker in enumerate(pairs.T[::-1]):
            for k in range(K):
                belief[:, k] += np.bincount(taker, told[way, :, k], minlength=F)
    label = np.argmin(belief, axis=1)
    return np.where(painted, candidates.view[np.arange(F), label], NONE).astype(np.int32)


def _tell(picture: Index, belief: Float32, pairs: Index, told: Float32, border: float) -> None:
    """What some pairs (n, 2) tell each other next, in place of what they told, (2, n, K)."""
    a, b = pairs.T
    before = told.copy()
    for way, (giver, taker) in enumerate(((a, b), (b, a))):
        own = belief[giver]
        own -= np.where(np.isfinite(own), before[1 - way], np.float32(0.0))
        K = own.shape[1]
        least = own[:, 0].copy()
        for k in range(1, K):
            np.minimum(least, own[:, k], out=least)
        given, taken = picture[giver], picture[taker]
        for k in range(K):
            heard = least + np.float32(border)
            for i in range(K):
                equal = (given[:, i] == taken[:, k]) & (given[:, i] != NONE)
                heard = np.where(equal, np.minimum(heard, own[:, i]), heard)
            told[way, :, k] = _KEPT * before[way, :, k] + (1.0 - _KEPT) * (heard - least)


_FEWEST = 3  # pictures of a face: of two nobody knows which one is wrong


def sample_face_colors(
    mesh: Mesh,
    candidates: Candidates,
    views: Sequence[View],
    colours: Callable[[View], NDArray[np.uint8] | None],
) -> NDArray[np.float32]:
    """(F, K, 3) what pictures show in the middles of faces, 0 to 255; NaN where that is unknown.

    Args:
        mesh: F faces.
        candidates: the K best pictures of each.
        views: the pictures.
        colours: (h, w, 3) the picture of a view; None: it is damaged.
    """
    found = np.full((*candidates.view.shape, 3), np.nan, np.float32)
    for number, view in enumerate(views):
        face, place = np.nonzero(candidates.view == number)
        picture = colours(view) if len(face) else None
        if picture is not None:
            uv, ok = project(view.camera, view.to_camera(mesh.centers[face]))
            found[face[ok], place[ok]] = sample_bilinear(picture, uv[ok])
    return found


def reject_inconsistent_views(
    candidates: Candidates, found: NDArray[np.float32], odd: float
) -> Candidates:
    """Leaves out pictures that most others of a face contradict.

    Args:
        candidates: the K best pictures of each of F faces.
        found: (F, K, 3) what they show there; NaN: unknown.
        odd: by how much colours, of 442, differ at least from the median of those of all, where
            more than half of them lie within half of that.
    """
    known = np.isfinite(found[..., 0]).sum(axis=1)
    asked = np.flatnonzero(known >= _FEWEST)
    off = np.full(candidates.view.shape, np.nan, np.float32)
    median = np.nanmedian(found[asked], axis=1, keepdims=True)
    off[asked] = np.linalg.norm(found[asked] - median, axis=2)
    most = 2 * (off < 0.5 * odd).sum(axis=1) > known
    out = most[:, None] & (off > odd)
    utility = np.where(out, np.float32(-np.inf), candidates.utility)
    order, row = np.argsort(-utility, axis=1, kind="stable"), np.arange(len(utility))[:, None]
    return Candidates(
        np.where(out, np.int32(NONE), candidates.view)[row, order],
        utility[row, order],
        np.where(out, np.float32(0.0), candidates.p_static)[row, order],
    )
