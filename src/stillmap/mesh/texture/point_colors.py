"""Colours of points that lie on a textured mesh: what is painted where each lies.

How far within the outline of a thing its points lie, by nothing but these points.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

import stillmap._core as _core
from stillmap.mesh.texture.atlas import GRAY, TexturedMesh
from stillmap.mesh.texture.baking import sample_bilinear

Colours = NDArray[np.uint8]

Float = NDArray[np.float64]

_NOT_GREY = (128, 128, 127)  # what a picture shows as grey, so that grey means none


class TextureSampler:
    """A textured mesh, to be asked for the colours of points on it.

    Args:
        textured: F faces.
        reach: metres, how far a point may lie off a face.
    """

    def __init__(self, textured: TexturedMesh, reach: float) -> None:
        self._of = textured
        self._near = _core.MeshDistance(textured.vertices, textured.faces, max_distance=reach)
        # -1 at the end: that of no face
        self._page = np.append(np.where(textured.view >= 0, textured.page, -1), -1)

    def colors(self, points: Float, origins: Float) -> tuple[Colours, NDArray[np.bool_]]:
        """(n, 3) uint8 colours, none of them GREY, and whether (n,) there are any.

        That of a point is painted at the place nearest to it on faces that face where it was seen
        from.

        Args:
            points: (n, 3) metres.
            origins: (n, 3) from where each was seen.
        """
        places = np.ascontiguousarray(points), np.ascontiguousarray(origins)
        face, weight = self._near.closest_faces(*places)
        found = self._page[face]
        out = np.zeros((len(points), 3), np.uint8)
        for page, texels in enumerate(self._of.pages):
            mine = np.flatnonzero(found == page)
            corner, share = self._of.faces[face[mine]], weight[mine]
            uv = sum(share[:, k, None] * self._of.uv[corner[:, k]] for k in range(3))
            h, w = texels.shape[:2]
            out[mine] = np.rint(sample_bilinear(texels, uv * np.array([w, h], np.float64) - 0.5))
        return avoid_gray(out), found >= 0


def avoid_gray(colours: Colours) -> Colours:
    """(n, 3) the same, but for GREY, which would mean that there is none."""
    is_grey = (colours == GRAY).all(axis=1, keepdims=True)
    return np.where(is_grey, np.array(_NOT_GREY, np.uint8), colours)


_CELL = 0.01  # m

_MOST_CELLS = 1 << 10  # along an edge, beyond which they are larger


def outline_depth(points: Float, apart: float) -> Float:
    """(n,) metres from points (n, 2) to the edge of what they cover; 0: they are its edge.

    They cover discs of `apart` metres around each, and what these enclose, less a seam as wide.

    Args:
        points: metres, in a plane.
        apart: farther apart than twice that they are of two pieces.
    """
    if not len(points):
        return np.zeros(0)
    cell = max(_CELL, float(np.ptp(points, axis=0).max()) / _MOST_CELLS)
    at = np.floor(points / cell).astype(np.int64)
    beside = int(np.ceil(apart / cell)) + 2
    at -= at.min(axis=0) - beside
    empty = np.ones(at.max(axis=0) + beside + 1, np.bool_)
    empty[at[:, 0], at[:, 1]] = False
    covered = ndimage.distance_transform_edt(empty) * cell <= apart
    away = ndimage.distance_transform_edt(ndimage.binary_fill_holes(covered)) * cell
    return np.asarray(np.maximum(away[at[:, 0], at[:, 1]] - cell - apart, 0.0))
