"""Colours of points that lie on a textured mesh: what is painted where each lies."""

from typing import NamedTuple

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.surface.mesh import Mesh
from stillmap.texture.sampling import bilinear
from stillmap.texture.textured import GREY, Textured

Float = NDArray[np.float64]
Index = NDArray[np.intp]
Colours = NDArray[np.uint8]

_FEW = 4  # places of the mesh around a point, of whose faces one may be the nearest
_MOST_PLACES = 1 << 21  # of a mesh, beyond which they lie farther apart
_COARSER = 1.5  # by so many times, again and again
_LEAST = 1e-300
_SLIVER = 1e-12  # squared sine of the angle of a triangle without area
_NOT_GREY = (128, 128, 127)  # what a picture shows as grey, so that grey means none


class Places(NamedTuple):
    """n places on F faces.

    Attributes:
        face: (n,) which face; F: there is none near.
        weight: (n, 3) of its corners.
    """

    face: Index
    weight: Float


class PaintedMesh:
    """A textured mesh, to be asked for the colours of points on it.

    Args:
        textured: F faces.
        reach: metres, how far a point may lie off a face.
    """

    def __init__(self, textured: Textured, reach: float) -> None:
        self._of, self._reach = textured, reach
        self._mesh = Mesh(textured.vertices, textured.faces)
        self._normals = self._mesh.normals()
        self._spacing, self._face, places = _lattice(self._mesh, reach)
        self._tree = scipy.spatial.cKDTree(places)

    def colours(self, points: Float, origins: Float) -> tuple[Colours, NDArray[np.bool_]]:
        """(n, 3) uint8 colours, none of them GREY, and whether (n,) there are any.

        Args:
            points: (n, 3) metres.
            origins: (n, 3) from where each was seen: what has its back to there does not count.
        """
        found = self.places(points, origins)
        view = np.append(self._of.view, -1)
        has = (view[found.face] >= 0) & (np.append(self._of.page, -1)[found.face] >= 0)
        out = np.zeros((len(points), 3), np.uint8)
        number, face, weight = np.flatnonzero(has), found.face[has], found.weight[has]
        uv = np.einsum("nk,nkd->nd", weight, self._of.uv[self._of.faces[face]])
        for page, texels in enumerate(self._of.pages):
            mine = self._of.page[face] == page
            h, w = texels.shape[:2]
            at = uv[mine] * np.array([w, h], np.float64) - 0.5
            out[number[mine]] = np.rint(bilinear(texels, at))
        return not_grey(out), has

    def places(self, points: Float, origins: Float) -> Places:
        """The place nearest to each point on faces that face where it was seen from."""
        F, n = len(self._mesh), len(points)
        best, out = np.full(n, self._reach), Places(np.full(n, F), np.zeros((n, 3)))
        if not F:
            return out
        farthest = self._reach + self._spacing
        numbers = list(range(1, _FEW + 1))
        _, near = self._tree.query(points, k=numbers, distance_upper_bound=farthest)
        faces = np.append(self._face, F)[near]
        for k, column in enumerate(faces.T):
            known = (faces[:, :k] == column[:, None]).any(axis=1)
            some = np.flatnonzero((column < F) & ~known)
            face = column[some]
            towards = ((origins[some] - points[some]) * self._normals[face]).sum(axis=1) > 0.0
            some, face = some[towards], face[towards]
            weight, off = feet(points[some], self._mesh.vertices[self._mesh.faces[face]])
            better = off < best[some]
            some = some[better]
            best[some], out.face[some], out.weight[some] = off[better], face[better], weight[better]
        return out


def not_grey(colours: Colours) -> Colours:
    """(n, 3) the same, but for GREY, which would mean that there is none."""
    is_grey = (colours == GREY).all(axis=1, keepdims=True)
    return np.where(is_grey, np.array(_NOT_GREY, np.uint8), colours)


def feet(points: Float, corners: Float) -> tuple[Float, Float]:
    """The place of a triangle (n, 3, 3) of its own that is nearest to each point (n, 3).

    Returns:
        (n, 3) weights of the corners, none below zero; (n,) metres to there.
    """
    a, b, c = (np.ascontiguousarray(corners[:, k].T) for k in range(3))
    p = np.ascontiguousarray(points.T)
    u, v, w = b - a, c - a, p - a
    uu, uv, vv, wu, wv = _dot(u, u), _dot(u, v), _dot(v, v), _dot(w, u), _dot(w, v)
    square = uu * vv - uv * uv
    flat = square <= _SLIVER * uu * vv  # no more than a line, or a point
    square = np.where(flat, 1.0, square)
    j, k = (vv * wu - uv * wv) / square, (uu * wv - uv * wu) / square
    inside = (j >= 0.0) & (k >= 0.0) & (j + k <= 1.0) & ~flat
    weight = np.stack([1.0 - j - k, j, k], axis=1)
    rest = np.flatnonzero(~inside)
    if len(rest):
        least = np.full(len(rest), np.inf)
        ends = [one[:, rest] for one in (a, b, c)]
        for first, second in ((0, 1), (1, 2), (2, 0)):
            along, to = ends[second] - ends[first], p[:, rest] - ends[first]
            share = np.clip(_dot(to, along) / np.maximum(_dot(along, along), _LEAST), 0.0, 1.0)
            left = to - share * along
            away = _dot(left, left)
            nearer = away < least
            least = np.where(nearer, away, least)
            on_edge = np.zeros((len(rest), 3))
            on_edge[:, first], on_edge[:, second] = 1.0 - share, share
            weight[rest[nearer]] = on_edge[nearer]
    foot = weight[:, 0] * a + weight[:, 1] * b + weight[:, 2] * c
    return weight, np.sqrt(_dot(p - foot, p - foot))


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _lattice(mesh: Mesh, spacing: float) -> tuple[float, Index, Float]:
    """Places (n, 3) all over a mesh, no farther from one to the next than the metres that are
    returned, about `spacing`, and the faces (n,) they are on."""
    corners = mesh.corners
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    longest = edges.max(axis=1, initial=0.0)
    while True:
        steps = np.maximum(np.ceil(longest / spacing), 1).astype(np.int64)
        if int((steps * steps).sum()) <= max(_MOST_PLACES, 2 * len(mesh)):
            break
        spacing *= _COARSER
    face, places = [np.zeros(0, np.intp)], [np.zeros((0, 3))]
    for n in np.unique(steps).tolist():
        some, weights = np.flatnonzero(steps == n), _middles(n)
        face.append(np.repeat(some, len(weights)))
        places.append(np.einsum("mk,fkd->fmd", weights, corners[some]).reshape(-1, 3))
    return spacing, np.concatenate(face), np.concatenate(places)


def _middles(n: int) -> Float:
    """(n * n, 3) weights of the middles of the equal parts of a triangle with sides cut in n."""
    i, j = (one.ravel() for one in np.mgrid[:n, :n])
    upward, downward = i + j < n, i + j < n - 1
    first = np.concatenate([i[upward] + 1 / 3, i[downward] + 2 / 3]) / n
    second = np.concatenate([j[upward] + 1 / 3, j[downward] + 2 / 3]) / n
    return np.stack([1.0 - first - second, first, second], axis=1)
