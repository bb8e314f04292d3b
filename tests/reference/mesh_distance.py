"""The place of a mesh nearest to a point: every face is tried."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int32 = NDArray[np.int32]

_SLIVER = 1e-12  # squared sine of the angle of a triangle without area
_LEAST = 1e-300


class MeshDistance:
    """The faces of a mesh, to be asked which of them is the nearest to a point.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3) counter-clockwise from where they are seen.
        max_distance: metres to a face, beyond which it is not near.
    """

    def __init__(self, vertices: Float, faces: Int32, *, max_distance: float) -> None:
        self._corners, self.max_distance = vertices[faces], max_distance

    def __len__(self) -> int:
        return len(self._corners)

    def closest_faces(self, points: Float, origins: Float) -> tuple[Int32, Float]:
        """Faces (n,), -1: none is less than the max_distance away; weights (n, 3) of their corners.

        Faces without area do not count, nor those that have their back to `origins` (n, 3); of
        several at one distance the lowest number does.
        """
        n = len(points)
        face, weight = np.full(n, -1, np.int32), np.zeros((n, 3))
        least = np.full(n, self.max_distance * self.max_distance)
        for number, corners in enumerate(self._corners):
            towards = _dot((origins - points).T, _normal(*corners)) > 0.0
            here, square = place_on(points, np.broadcast_to(corners, (n, 3, 3)))
            better = towards & (square < least)
            face[better], weight[better], least[better] = number, here[better], square[better]
        return face, weight


def place_on(points: Float, corners: Float) -> tuple[Float, Float]:
    """The place of a triangle (n, 3, 3) of its own that is nearest to each point (n, 3).

    It is a + j (b - a) + k (c - a), where the plane's place nearest to the point is within the
    triangle; or else the nearest of those on the edges.

    Returns:
        (n, 3) weights of the corners, none below zero; (n,) square metres to there.
    """
    a, b, c = (corners[:, k].T for k in range(3))
    p = points.T
    u, v, w = b - a, c - a, p - a
    uu, uv, vv, wu, wv = _dot(u, u), _dot(u, v), _dot(v, v), _dot(w, u), _dot(w, v)
    square = uu * vv - uv * uv
    flat = square <= _SLIVER * uu * vv  # no more than a line, or a point
    square = np.where(flat, 1.0, square)
    j, k = (vv * wu - uv * wv) / square, (uu * wv - uv * wu) / square
    inside = (j >= 0.0) & (k >= 0.0) & (j + k <= 1.0) & ~flat
    weight = np.where(inside[:, None], np.stack([1.0 - j - k, j, k], axis=1), 0.0)
    least = np.where(inside, -np.inf, np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        start, end = corners[:, first].T, corners[:, second].T
        along, to = end - start, p - start
        share = np.clip(_dot(to, along) / np.maximum(_dot(along, along), _LEAST), 0.0, 1.0)
        left = to - share * along
        away = _dot(left, left)
        nearer = away < least
        least[nearer] = away[nearer]
        on_edge = np.zeros_like(weight)
        on_edge[:, first], on_edge[:, second] = 1.0 - share, share
        weight[nearer] = on_edge[nearer]
    off = p - (weight[:, 0] * a + weight[:, 1] * b + weight[:, 2] * c)
    return weight, _dot(off, off)


def _normal(a: Float, b: Float, c: Float) -> Float:
    u, v = b - a, c - a
    return np.array(
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    )


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
