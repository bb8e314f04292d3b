"""Whether pictures of a face agree: one that differs from all the others shows somebody."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from stillmap.surface.mesh import Mesh
from stillmap.texture.choice import NONE, Candidates
from stillmap.texture.lens import project
from stillmap.texture.sampling import bilinear
from stillmap.texture.view import View

_FEWEST = 3  # pictures of a face: of two nobody knows which one is wrong


def colours_of_faces(
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
    found = np.full((*candidates.picture.shape, 3), np.nan, np.float32)
    for number, view in enumerate(views):
        face, place = np.nonzero(candidates.picture == number)
        picture = colours(view) if len(face) else None
        if picture is not None:
            uv, ok = project(view.camera, view.in_camera(mesh.centres[face]))
            found[face[ok], place[ok]] = bilinear(picture, uv[ok])
    return found


def agreeing(candidates: Candidates, found: NDArray[np.float32], odd: float) -> Candidates:
    """Leaves out pictures that most others of a face contradict.

    Args:
        candidates: the K best pictures of each of F faces.
        found: (F, K, 3) what they show there; NaN: unknown.
        odd: by how much colours, of 442, differ at least from the median of those of all, where
            more than half of them lie within half of that.
    """
    known = np.isfinite(found[..., 0]).sum(axis=1)
    asked = np.flatnonzero(known >= _FEWEST)
    off = np.full(candidates.picture.shape, np.nan, np.float32)
    median = np.nanmedian(found[asked], axis=1, keepdims=True)
    off[asked] = np.linalg.norm(found[asked] - median, axis=2)
    most = 2 * (off < 0.5 * odd).sum(axis=1) > known
    out = most[:, None] & (off > odd)
    utility = np.where(out, np.float32(-np.inf), candidates.utility)
    order, row = np.argsort(-utility, axis=1, kind="stable"), np.arange(len(utility))[:, None]
    return Candidates(
        np.where(out, np.int32(NONE), candidates.picture)[row, order],
        utility[row, order],
        np.where(out, np.float32(0.0), candidates.p_static)[row, order],
    )
