"""What was seen of a thing in a moment, as a surface: triangles between neighbouring beams.

People change their shape while they walk, and a laser meets them with few beams: what counts is
one look, and each beam of it. Triangles do not go where beams passed between.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from stillmap.mesh.objects.frame import ObjectFrame
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]
Index = NDArray[np.intp]
Bool = NDArray[np.bool_]

_AHEAD = 0.2  # cosine from the middle of a thing, up to which it is seen at once
_PASSED = 0.25  # m beyond a triangle, from where on a beam passed by
_STEEPEST = 8.0  # times as long along the line of sight as across
_ROUNDS = 2  # of smoothing
_OWN = 0.5  # of its range that a beam keeps in a round
_STEP = 0.08  # m in range between neighbours that are smoothed together


class ObjectBeams(NamedTuple):
    """Beams in a thing's own frame.

    Attributes:
        points: (n, 3) metres, where they ended.
        origin: (n, 3) metres, where the sensor was.
    """

    points: Float
    origin: Float

    @classmethod
    def from_map(
        cls, points: Float, origin: Float, seconds: Float, way: ObjectFrame
    ) -> "ObjectBeams":
        """Beams in the map frame, each as it was at its time (n,)."""
        return cls(way.to_object(seconds, points), way.to_object(seconds, origin))


def find_best_interval(
    seconds: Float, look: Index, moment: float, near: float, pictures: Float
) -> tuple[float, float, float]:
    """From when to when most beams met a thing, rather where a picture is; and how good that is.

    Args:
        seconds: (n,) when beams met it, n > 0.
        look: (n,) number of the scan, rising.
        moment: s that it may last; 0: it is one scan.
        near: s from its middle to a picture, from which on it counts a fifth.
        pictures: (N,) s, when pictures show it.
    """
    if moment == 0.0:
        ends = np.flatnonzero(np.diff(look)) + 1
        a, b = np.concatenate([[0], ends]), np.concatenate([ends, [len(look)]])
        first, last = np.minimum.reduceat(seconds, a), np.maximum.reduceat(seconds, a)
        value = (b - a).astype(np.float64)
    else:
        first = np.sort(seconds)
        at = np.searchsorted(first, first + moment, side="right")
        last, value = first[at - 1], (at - np.arange(len(first))).astype(np.float64)
    if len(pictures):
        away = np.abs(0.5 * (first + last)[:, None] - pictures).min(axis=1)
        value = value / (1.0 + np.minimum(4.0 * away / max(near, 1e-9), 4.0))
    best = int(np.argmax(value))
    return float(first[best]), float(last[best]), float(value[best])


def triangulate_beams(
    own: ObjectBeams, others: ObjectBeams, stretch: float, longest: float, deepest: float = 0.0
) -> Mesh:
    """The surface between beams that met a thing, as seen from the middle of where they came from.

    Args:
        own: beams that ended on it.
        others: beams about then that did not; NaN where nobody knows how far they went.
        stretch: times as long as usual may an edge be.
        longest: metres, an edge at most.
        deepest: metres along the line of sight: at flat angles an edge may be so long.

    Returns:
        (V, 3) metres, in the thing's own frame; each vertex is of a beam.
    """
    if len(own.points) < 3:
        return _nothing()
    place, middle = own.origin.mean(axis=0), own.points.mean(axis=0)
    plane, ahead = _seen_from(place, middle, own.points)
    points, plane = own.points[ahead], plane[ahead]
    try:
        found = Delaunay(plane)
    except (QhullError, ValueError):  # all in one line
        return _nothing()
    faces = found.simplices
    spans = points[faces] - points[np.roll(faces, 1, axis=1)]
    edges = np.linalg.norm(spans, axis=2)
    limit = min(stretch * float(np.median(edges)), longest)
    kept = edges.max(axis=1) <= limit
    if deepest > 0.0:
        kept |= _flat(spans, edges, points[faces].mean(axis=1) - place, limit, deepest)
    kept &= ~_passed(found, points, place, middle, others)
    faces = _towards(points, faces[kept], place)
    if not len(faces):
        return _nothing()
    used, number = np.unique(faces, return_inverse=True)
    faces = number.reshape(-1, 3).astype(np.int32)
    return Mesh(_smoothed(points[used], faces, place), faces)


def _flat(spans: Float, edges: Float, sight: Float, limit: float, deepest: float) -> Bool:
    """(m,) whether triangles are short as they are seen, and long along the line of sight only."""
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    deep = np.abs(np.einsum("nki,ni->nk", spans, sight))
    across = np.sqrt(np.maximum(edges**2 - deep**2, 0.0)).max(axis=1)
    return np.asarray(
        (across <= limit) & (deep.max(axis=1) <= np.minimum(deepest, _STEEPEST * across))
    )


def _nothing() -> Mesh:
    return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))


def _seen_from(place: Float, middle: Float, points: Float) -> tuple[Float, NDArray[np.bool_]]:
    """(n, 2) where points are in an ideal picture of `middle`, and (n,) whether they are in it."""
    towards = (middle - place) / max(float(np.linalg.norm(middle - place)), 1e-9)
    side = np.linalg.svd(towards[None])[2][1:]
    off = points - place
    depth = off @ towards
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = depth > _AHEAD * np.linalg.norm(off, axis=1)
        return (off @ side.T) / depth[:, None], ahead


def _passed(
    found: Delaunay, points: Float, place: Float, middle: Float, others: ObjectBeams
) -> NDArray[np.bool_]:
    """(m,) whether a beam went through a triangle and on behind it."""
    out = np.zeros(len(found.simplices), np.bool_)
    along = others.points - others.origin
    length = np.linalg.norm(along, axis=1, keepdims=True)
    # where it was when it came by: sensors move
    by = others.origin + along / length * np.linalg.norm(middle - others.origin, axis=1)[:, None]
    plane, ahead = _seen_from(place, middle, by)
    some = np.flatnonzero(ahead)
    triangle = found.find_simplex(plane[some])
    some, triangle = some[triangle >= 0], triangle[triangle >= 0]
    depth = np.linalg.norm(points - place, axis=1)[found.simplices].max(axis=1)
    behind = np.linalg.norm(others.points[some] - place, axis=1) > depth[triangle] + _PASSED
    out[triangle[behind]] = True
    return out


def _towards(points: Float, faces: NDArray[np.integer], place: Float) -> NDArray[np.int32]:
    """(m, 3) the same faces, counter-clockwise as seen from a place."""
    a, b, c = (points[faces[:, k]] for k in (0, 1, 2))
    away = np.einsum("ni,ni->n", np.cross(b - a, c - a), place - a) < 0.0
    return np.where(away[:, None], faces[:, ::-1], faces).astype(np.int32)


def _smoothed(points: Float, faces: NDArray[np.int32], place: Float) -> Float:
    """(n, 3) points, along their lines of sight nearer to those around but for steps."""
    off = points - place
    length = np.linalg.norm(off, axis=1)
    sight = off / length[:, None]
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    one, other = np.unique(pairs, axis=0).T
    for _ in range(_ROUNDS):
        apart = length[other] - length[one]
        near = np.abs(apart) <= _STEP
        total = np.bincount(one[near], apart[near], len(points))
        total -= np.bincount(other[near], apart[near], len(points))
        count = np.bincount(np.concatenate([one[near], other[near]]), minlength=len(points))
        length = length + (1.0 - _OWN) * total / np.maximum(count, 1)
    return np.asarray(place + length[:, None] * sight)
