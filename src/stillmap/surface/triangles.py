"""Triangles between neighbouring beams, and which of them are surface."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.surface.options import SurfaceOptions

Float = NDArray[np.float64]
Faces = NDArray[np.int32]
Bool = NDArray[np.bool_]

_SMOOTHING = 2  # rounds in which normals are averaged with those beside
_AROUND = 6  # triangles around a point that has neighbours on all sides
_HALF = (
    0.73  # standard deviations that a point is off the mean of six beside, or less, half the time
)
_NOISES = 5.0  # standard deviations between the farthest and the nearest of three corners


class Kept(NamedTuple):
    """Triangles that are surface.

    Attributes:
        faces: (m, 3) int32, counter-clockwise seen from the sensor.
        standoff: (n,) metres from the sensor to the tangent plane at each point; 0: of no triangle.
    """

    faces: Faces
    standoff: Float


def grid_faces(points: Float, use: Bool, number: NDArray[np.int32]) -> Faces:
    """Two triangles for each square of neighbours in a range image, one where a corner is missing.

    The diagonal is the shorter one.

    Args:
        points: (n, 3) metres.
        use: (n,) which can be used.
        number: (H, W) of the point at each place of the image.
    """
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    d, c = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    ua, ub, uc, ud = use[a], use[b], use[c], use[d]
    with np.errstate(invalid="ignore"):
        ac = np.linalg.norm(points[a] - points[c], axis=1)
        bd = np.linalg.norm(points[b] - points[d], axis=1)
        by_ac = np.where(ua & uc & ub & ud, ac <= bd, ua & uc)
    triangles = (
        ((a, b, c), by_ac & ua & ub & uc),
        ((a, c, d), by_ac & ua & uc & ud),
        ((a, b, d), ~by_ac & ua & ub & ud),
        ((b, c, d), ~by_ac & ub & uc & ud),
    )
    parts = [np.stack(corners, axis=1)[some] for corners, some in triangles]
    return np.concatenate(parts).astype(np.int32)


def surface_faces(points: Float, origin: Float, faces: Faces, o: SurfaceOptions) -> Kept:
    """The triangles that do not span holes or steps in depth.

    A triangle that is seen at a flat angle either belongs to a surface that is, as the floor far
    ahead, and then lies in a plane with those beside; or it leads from something near to what is
    seen behind its edge. One whose corners are as far away as noise lets them seem tells nothing of
    an angle.

    Args:
        points: (n, 3) metres.
        origin: (n, 3) where the sensor was at each.
        faces: (m, 3).
        o: limits.
    """
    a, b, c = (points[faces[:, k]] for k in (0, 1, 2))
    spans, sight = np.cross(b - a, c - a), origin[faces[:, 0]] - (a + b + c) / 3.0
    area, range, longest = _length(spans), _length(sight), _length(b - a)
    for edge in (c - b, a - c):
        longest = np.maximum(longest, _length(edge))
    facing = np.einsum("ni,ni->n", spans, sight)
    # counter-clockwise seen from the sensor
    away = facing < 0.0
    faces = np.where(away[:, None], faces[:, ::-1], faces)
    normals = (np.where(away, -1.0, 1.0) / np.maximum(area, 1e-300))[:, None] * spans
    cosine = np.abs(facing) / np.maximum(area * range, 1e-300)
    level = is_level(_length(origin - points), faces)
    limit = np.minimum(o.longest, o.longest_share * range)
    kept = (longest <= limit) & (level | (cosine >= np.cos(o.steepest))) & (area > 0.0)
    faces, normals, cosine = faces[kept], normals[kept], cosine[kept]
    steep = (cosine < np.cos(o.steep)) & ~level[kept]
    at_points = point_normals(normals, faces, len(points), 0)
    along = np.einsum("nki,ni->nk", at_points[faces[steep]], normals[steep])
    fits = np.ones(len(faces), np.bool_)
    # at two corners: the third may lie in the edge of a room
    fits[steep] = np.sort(along, axis=1)[:, 1] >= np.cos(o.bend)
    faces, normals = faces[fits], normals[fits]
    smooth = point_normals(normals, faces, len(points), _SMOOTHING)
    standoff = np.einsum("ni,ni->n", smooth, origin - points)
    return Kept(faces.astype(np.int32), np.where(np.isfinite(standoff), standoff, 0.0))


def is_level(range: Float, faces: Faces) -> Bool:
    """(m,) whether the corners of triangles are as far away as each other, but for noise.

    Args:
        range: (n,) metres.
        faces: (m, 3).
    """
    a, b, c = (range[faces[:, k]] for k in (0, 1, 2))
    between = np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c)
    return np.asarray(between <= _NOISES * noise_of(range, faces))


def noise_of(range: Float, faces: Faces) -> float:
    """Standard deviation of ranges (n,) in metres, by what they are off those around.

    Half of the points are nearer to the mean of their neighbours than noise lets them be; 0 where
    no point has neighbours on all sides.
    """
    count = np.bincount(faces.ravel(), minlength=len(range))
    each = range[faces[:, 0]] + range[faces[:, 1]] + range[faces[:, 2]]
    total = np.bincount(faces.ravel(), np.repeat(each, 3), len(range))
    inside = count >= _AROUND
    if not inside.any():
        return 0.0
    # each triangle around counts the point itself, and each neighbour is of two
    around = (total[inside] - count[inside] * range[inside]) / (2 * count[inside])
    return float(np.median(np.abs(around - range[inside]))) / _HALF


def point_normals(normals: Float, faces: Faces, n: int, rounds: int) -> Float:
    """(n, 3) of length one at each point: the mean of those of the triangles around.

    Args:
        normals: (m, 3) of the triangles, of length one.
        faces: (m, 3).
        n: how many points there are.
        rounds: how often they are averaged again over the triangles' corners.
    """
    out = _gathered(normals, faces, n)
    for _ in range(rounds):
        out = _gathered(
            _of_length_one(out[faces[:, 0]] + out[faces[:, 1]] + out[faces[:, 2]]), faces, n
        )
    return out


def _gathered(normals: Float, faces: Faces, n: int) -> Float:
    out, corner = np.empty((n, 3)), faces.ravel()
    for d in range(3):
        out[:, d] = np.bincount(corner, np.repeat(normals[:, d], 3), n)
    return _of_length_one(out)


def _of_length_one(vectors: Float) -> Float:
    length = _length(vectors)
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0)[:, None])


def _length(vectors: Float) -> Float:
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)))
