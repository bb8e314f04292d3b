"""Closest point on a mesh by brute force over all faces."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int32 = NDArray[np.int32]

_SLIVER = 1e-12  # squared sine of the angle of a degenerate triangle
_LEAST = 1e-300


class MeshDistance:
    """Closest-face queries against a triangle mesh.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3) counter-clockwise seen from the front.
        max_distance: search radius, metres.
    """

    def __init__(self, vertices: Float, faces: Int32, *, max_distance: float) -> None:
        self._corners, self.max_distance = vertices[faces], max_distance

    def __len__(self) -> int:
        return len(self._corners)

    def closest_faces(self, points: Float, origins: Float) -> tuple[Int32, Float]:
        """Closest faces (n,), -1: none within max_distance; barycentric coordinates (n, 3).

        Degenerate faces and faces seen from behind from `origins` (n, 3) are skipped; ties go to
        the lowest index.
        """
        n = len(points)
        face, weight = np.full(n, -1, np.int32), np.zeros((n, 3))
        least = np.full(n, self.max_distance * self.max_distance)
        for number, corners in enumerate(self._corners):
            towards = _dot((origins - points).T, _normal(*corners)) > 0.0
            here, square = closest_point(points, np.broadcast_to(corners, (n, 3, 3)))
            better = towards & (square < least)
            face[better], weight[better], least[better] = number, here[better], square[better]
        return face, weight


def closest_point(points: Float, corners: Float) -> tuple[Float, Float]:
    """Closest point of each triangle (n, 3, 3) to each point (n, 3).

    It is the projection a + j (b - a) + k (c - a) onto the plane if that is inside the triangle,
    else the closest point on the edges.

    Returns:
        (n, 3) barycentric coordinates, none negative; (n,) squared distances, m^2.
    """
    a, b, c = (corners[:, k].T for k in range(3))
    p = points.T
    u, v, w = b - a, c - a, p - a
    uu, uv, vv, wu, wv = _dot(u, u), _dot(u, v), _dot(v, v), _dot(w, u), _dot(w, v)
    square = uu * vv - uv * uv
    flat = square <= _SLIVER * uu * vv  # degenerate
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
