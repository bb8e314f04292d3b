"""The surface of a partial scan: triangles between neighboring beams on an object.

People change their shape while they walk and are met by few beams, so one partial scan counts, and
each of its beams. Triangles that other beams passed through are dropped.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.triangulation import SMOOTHING_ROUNDS
from stillmap.mesh.types import Bool, Float, Index, Int32

IMAGE_WINDOW = 0.5  # s between an observation and an image of an object that is not rigid
_MIN_COSINE = 0.2  # from an object's center, up to which points are in one perspective image
_PASS_MARGIN = 0.25  # m behind a triangle from which on a beam has passed it
_MAX_STEEPNESS = 8.0  # length along the line of sight over length across
_SMOOTHING_KEPT = 0.5  # share of its range that a beam keeps in a round
_MAX_RANGE_STEP = 0.08  # m between neighbors that are smoothed together
_FAR_IMAGE_PENALTY = 4.0  # an interval far from all images counts 1 / (1 + this)


class ObjectBeams(NamedTuple):
    """Beams in an object's frame.

    Attributes:
        points: (n, 3) metres, end points.
        origin: (n, 3) metres, sensor positions.
    """

    points: Float
    origin: Float


def find_best_interval(
    seconds: Float, scan: Index, duration: float, images: Float
) -> tuple[float, float, float]:
    """The interval with most returns on an object, preferably near an image; start, end, score.

    Args:
        seconds: (n,) times of returns on it, n > 0.
        scan: (n,) number of the scan, rising.
        duration: s; 0: one scan.
        images: (N,) s, when images show the object; an interval `IMAGE_WINDOW` away from all
            counts one fifth.
    """
    if duration == 0.0:
        ends = np.flatnonzero(np.diff(scan)) + 1
        a, b = np.concatenate([[0], ends]), np.concatenate([ends, [len(scan)]])
        first, last = np.minimum.reduceat(seconds, a), np.maximum.reduceat(seconds, a)
        score = (b - a).astype(np.float64)
    else:
        first = np.sort(seconds)
        at = np.searchsorted(first, first + duration, side="right")
        last, score = first[at - 1], (at - np.arange(len(first))).astype(np.float64)
    if len(images):
        away = np.abs(0.5 * (first + last)[:, None] - images).min(axis=1)
        penalty = np.minimum(_FAR_IMAGE_PENALTY * away / IMAGE_WINDOW, _FAR_IMAGE_PENALTY)
        score = score / (1.0 + penalty)
    best = int(np.argmax(score))
    return float(first[best]), float(last[best]), float(score[best])


def triangulate_beams(
    own: ObjectBeams, others: ObjectBeams, stretch: float, max_edge: float, max_depth: float = 0.0
) -> Mesh:
    """The surface between beams on an object, triangulated as seen from their mean origin.

    Args:
        own: beams that ended on it.
        others: beams near in time that did not; NaN where their range is unknown.
        stretch: maximum length of an edge over the median.
        max_edge: metres.
        max_depth: metres; at grazing incidence edges along the line of sight may be so long.

    Returns:
        Metres in the object's frame; each vertex belongs to a beam.
    """
    if len(own.points) < 3:
        return Mesh.empty()
    sensor, center = own.origin.mean(axis=0), own.points.mean(axis=0)
    plane, ahead = _project_perspective(sensor, center, own.points)
    points, plane = own.points[ahead], plane[ahead]
    try:
        found = Delaunay(plane)
    except (QhullError, ValueError):  # all in one line
        return Mesh.empty()
    faces = found.simplices
    spans = points[faces] - points[np.roll(faces, 1, axis=1)]
    edges = np.linalg.norm(spans, axis=2)
    limit = min(stretch * float(np.median(edges)), max_edge)
    kept = edges.max(axis=1) <= limit
    if max_depth > 0.0:
        sight = points[faces].mean(axis=1) - sensor
        kept |= _is_grazing(spans, edges, sight, limit, max_depth)
    kept &= ~_is_passed(found, points, sensor, center, others)
    faces = _orient(points, faces[kept], sensor)
    if not len(faces):
        return Mesh.empty()
    used, number = np.unique(faces, return_inverse=True)
    faces = number.reshape(-1, 3).astype(np.int32)
    return Mesh(_smooth_ranges(points[used], faces, sensor), faces)


def _is_grazing(spans: Float, edges: Float, sight: Float, limit: float, max_depth: float) -> Bool:
    """(m,) whether triangles are short across the line of sight, and long only along it."""
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    deep = np.abs(np.einsum("nki,ni->nk", spans, sight))
    across = np.sqrt(np.maximum(edges**2 - deep**2, 0.0)).max(axis=1)
    return np.asarray(
        (across <= limit) & (deep.max(axis=1) <= np.minimum(max_depth, _MAX_STEEPNESS * across))
    )


def _project_perspective(sensor: Float, center: Float, points: Float) -> tuple[Float, Bool]:
    """(n, 2) image coordinates of points as seen from the sensor towards `center`, and whether (n,)
    they are in front."""
    towards = (center - sensor) / max(float(np.linalg.norm(center - sensor)), 1e-9)
    side = np.linalg.svd(towards[None])[2][1:]
    off = points - sensor
    depth = off @ towards
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = depth > _MIN_COSINE * np.linalg.norm(off, axis=1)
        return (off @ side.T) / depth[:, None], ahead


def _is_passed(
    found: Delaunay, points: Float, sensor: Float, center: Float, others: ObjectBeams
) -> Bool:
    """(m,) whether a beam went through a triangle and on behind it."""
    out = np.zeros(len(found.simplices), np.bool_)
    along = others.points - others.origin
    length = np.linalg.norm(along, axis=1, keepdims=True)
    # where it passed the object, as each beam has its own origin
    by = others.origin + along / length * np.linalg.norm(center - others.origin, axis=1)[:, None]
    plane, ahead = _project_perspective(sensor, center, by)
    some = np.flatnonzero(ahead)
    triangle = found.find_simplex(plane[some])
    some, triangle = some[triangle >= 0], triangle[triangle >= 0]
    depth = np.linalg.norm(points - sensor, axis=1)[found.simplices].max(axis=1)
    distance = np.linalg.norm(others.points[some] - sensor, axis=1)
    out[triangle[distance > depth[triangle] + _PASS_MARGIN]] = True
    return out


def _orient(points: Float, faces: NDArray[np.integer], sensor: Float) -> Int32:
    """(m, 3) the faces, counter-clockwise as seen from the sensor."""
    a, b, c = (points[faces[:, k]] for k in (0, 1, 2))
    away = np.einsum("ni,ni->n", np.cross(b - a, c - a), sensor - a) < 0.0
    return np.where(away[:, None], faces[:, ::-1], faces).astype(np.int32)


def _smooth_ranges(points: Float, faces: Int32, sensor: Float) -> Float:
    """(n, 3) points, their ranges averaged with those of neighbors, but not across steps."""
    off = points - sensor
    length = np.linalg.norm(off, axis=1)
    sight = off / length[:, None]
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    one, other = np.unique(pairs, axis=0).T
    for _ in range(SMOOTHING_ROUNDS):
        step = length[other] - length[one]
        near = np.abs(step) <= _MAX_RANGE_STEP
        total = np.bincount(one[near], step[near], len(points))
        total -= np.bincount(other[near], step[near], len(points))
        count = np.bincount(np.concatenate([one[near], other[near]]), minlength=len(points))
        length = length + (1.0 - _SMOOTHING_KEPT) * total / np.maximum(count, 1)
    return np.asarray(sensor + length[:, None] * sight)
