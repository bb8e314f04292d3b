"""Triangles between neighbouring beams, and which of them are surface.

Triangles between rows that differ in length: the rings of a lidar without lost beams.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.mesh.options import SurfaceOptions

Faces = NDArray[np.int32]

Bool = NDArray[np.bool_]

Float = NDArray[np.float64]

Index = NDArray[np.intp]

_SMOOTHING = 2  # rounds in which normals are averaged with those beside

_AROUND = 6  # triangles around a point that has neighbours on all sides

_HALF = (
    0.73  # standard deviations that a point is off the mean of six beside, or less, half the time
)

_NOISES = 5.0  # standard deviations between the farthest and the nearest of three corners


class SurfaceFaces(NamedTuple):
    """Triangles that are surface.

    Attributes:
        faces: (m, 3) int32, counter-clockwise seen from the sensor.
        standoff: (n,) metres from the sensor to the tangent plane at each point; 0: of no triangle.
    """

    faces: Faces
    standoff: Float


def triangulate_grid(points: Float, use: Bool, number: NDArray[np.int32]) -> Faces:
    """Two triangles for each square of neighbours in a range image, one where a corner is missing.

    The diagonal is the shorter one.

    Args:
        points: (n, 3) metres.
        use: (n,) which can be used.
        number: (H, W) of the point at each place of the image.
    """
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    d, c = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    some = np.flatnonzero(use[a].astype(np.int8) + use[b] + use[c] + use[d] >= 3)
    a, b, c, d = a[some], b[some], c[some], d[some]
    ua, ub, uc, ud = use[a], use[b], use[c], use[d]
    columns = _columns(points)
    with np.errstate(invalid="ignore"):
        shorter = _squares(columns, a, c) <= _squares(columns, b, d)
    by_ac = np.where(ua & uc & ub & ud, shorter, ua & uc)
    triangles = (
        ((a, b, c), by_ac & ub),
        ((a, c, d), by_ac & ud),
        ((a, b, d), ~by_ac & ua),
        ((b, c, d), ~by_ac & uc),
    )
    parts = [np.column_stack([one[kept] for one in corners]) for corners, kept in triangles]
    return np.concatenate(parts).astype(np.int32)


def _columns(points: Float) -> Float:
    """(3, n): operations on long rows are fast."""
    return np.ascontiguousarray(points.T)


def _squares(columns: Float, a: NDArray[np.int32], b: NDArray[np.int32]) -> Float:
    """(m,) squared distances between points of (3, n)."""
    return np.asarray(sum((x[a] - x[b]) ** 2 for x in columns))


def filter_faces(points: Float, origin: Float, faces: Faces, o: SurfaceOptions) -> SurfaceFaces:
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
    columns, corners = _columns(points), [np.ascontiguousarray(k) for k in faces.T]
    a, b, c = (columns[:, k] for k in corners)
    ab, bc, ca = b - a, c - b, a - c
    spans, sight = _cross(ca, ab), _columns(origin)[:, corners[0]] - (a + b + c) / 3.0
    area, range = np.sqrt(_dot(spans, spans)), np.sqrt(_dot(sight, sight))
    longest = np.sqrt(np.maximum(np.maximum(_dot(ab, ab), _dot(bc, bc)), _dot(ca, ca)))
    facing = _dot(spans, sight)
    # counter-clockwise seen from the sensor
    away = facing < 0.0
    faces = np.column_stack(
        [np.where(away, corners[2], corners[0]), corners[1], np.where(away, *corners[::2])]
    )
    cosine = np.abs(facing) / np.maximum(area * range, 1e-300)
    level = has_equal_ranges(_length(origin - points), faces)
    limit = np.minimum(o.longest, o.longest_share * range)
    kept = (longest <= limit) & (level | (cosine >= np.cos(o.steepest))) & (area > 0.0)
    faces, cosine = faces[kept], cosine[kept]
    normals = spans[:, kept] * (np.where(away, -1.0, 1.0) / np.maximum(area, 1e-300))[kept]
    steep = np.flatnonzero((cosine < np.cos(o.steep)) & ~level[kept])
    at_points = vertex_normals(normals, faces, len(points), 0)
    along = [_dot(at_points[:, faces[steep, k]], normals[:, steep]) for k in (0, 1, 2)]
    fits = np.ones(len(faces), np.bool_)
    # at two corners: the third may lie in the edge of a room
    fits[steep] = _middle(*along) >= np.cos(o.bend)
    faces, normals = faces[fits], normals[:, fits]
    smooth = vertex_normals(normals, faces, len(points), _SMOOTHING)
    standoff = _dot(smooth, _columns(origin - points))
    return SurfaceFaces(faces.astype(np.int32), np.where(np.isfinite(standoff), standoff, 0.0))


def _cross(a: Float, b: Float) -> Float:
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _middle(a: Float, b: Float, c: Float) -> Float:
    """(n,) the second of three."""
    return np.asarray(np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c)))


def has_equal_ranges(range: Float, faces: Faces) -> Bool:
    """(m,) whether the corners of triangles are as far away as each other, but for noise.

    Args:
        range: (n,) metres.
        faces: (m, 3).
    """
    a, b, c = (range[faces[:, k]] for k in (0, 1, 2))
    between = np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c)
    return np.asarray(between <= _NOISES * range_std(range, faces))


def range_std(range: Float, faces: Faces) -> float:
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


def vertex_normals(normals: Float, faces: Faces, n: int, rounds: int) -> Float:
    """(3, n) of length one at each point: the mean of those of the triangles around.

    Args:
        normals: (3, m) of the triangles, of length one.
        faces: (m, 3).
        n: how many points there are.
        rounds: how often they are averaged again over the triangles' corners.
    """
    corner = faces.ravel().astype(np.intp)
    a, b, c = (np.ascontiguousarray(k) for k in faces.T)
    out = _gathered(normals, corner, n)
    for _ in range(rounds):
        mean = _of_length_one(np.stack([x[a] + x[b] + x[c] for x in out]))
        out = _gathered(mean, corner, n)
    return out


def _gathered(normals: Float, corner: NDArray[np.intp], n: int) -> Float:
    out = np.empty((3, n))
    for d, along in enumerate(normals):
        out[d] = np.bincount(corner, np.repeat(along, 3), n)
    return _of_length_one(out)


def _of_length_one(vectors: Float) -> Float:
    length = np.sqrt(_dot(vectors, vectors))
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0))


def _length(vectors: Float) -> Float:
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)))


_BACK = 0.1  # rad, by which the next row begins again

_STEADY = 0.95  # share of the steps within rows that go on

_FEWEST, _SHORTEST = 4, 16  # rows, and beams in half of them

_STEP = 0.05  # rad, the usual step within a row, at most

_WHOLE = 0.2  # rad that a turn lacks, at most


class Rows(NamedTuple):
    """R rows of beams.

    Attributes:
        first: (R+1,) row r has the beams first[r]:first[r + 1].
        angle: (n,) rad along the row, mostly rising within each.
        closed: whether rows go all around.
    """

    first: Index
    angle: Float
    closed: bool


def split_rows(looking: Float) -> Rows | None:
    """Rows along which the azimuth, or the elevation, goes on, until it begins again.

    Args:
        looking: (n, 3) directions of length one, in their order.
    """
    if len(looking) < _FEWEST * _SHORTEST:
        return None
    azimuth = np.arctan2(looking[:, 1], looking[:, 0])
    for angle in (azimuth, np.arcsin(np.clip(looking[:, 2], -1.0, 1.0))):
        turned = (np.diff(angle) + np.pi) % (2.0 * np.pi) - np.pi
        sense = 1.0 if np.median(turned) > 0.0 else -1.0
        # the recording begins with a row
        along = (sense * (angle - angle[0])) % (2.0 * np.pi) if angle is azimuth else sense * angle
        step = np.diff(along)
        breaks = np.flatnonzero(step < -_BACK) + 1
        first = np.concatenate([[0], breaks, [len(looking)]]).astype(np.intp)
        within = np.delete(step, breaks - 1)
        steady = np.mean((within > 0.0) & (within < 10.0 * _STEP)) > _STEADY
        usual = float(np.median(np.abs(step)))
        if steady and usual < _STEP and len(breaks) + 1 >= _FEWEST:
            if np.median(np.diff(first)) < _SHORTEST:
                continue
            span = float(np.median([np.ptp(along[a:b]) for a, b in pairwise(first)]))
            return Rows(first, along, span > 2.0 * np.pi - _WHOLE)
    return None


def triangulate_strips(rows: Rows) -> NDArray[np.int32]:
    """(m, 3) triangles between each row and the next: from beam to beam on either side in turn.

    After the last row comes the first one, which may be far away.
    """
    parts = [np.zeros((0, 3), np.intp)]
    ordered = [_ordered(rows, r) for r in range(len(rows.first) - 1)]
    for (one, at_one), (other, at_other) in pairwise([*ordered, ordered[0]]):
        beam = np.concatenate([one, other])
        side = np.repeat([0, 1], [len(one), len(other)])
        order = np.argsort(np.concatenate([at_one, at_other]), kind="stable")
        beam, side = beam[order], side[order]
        # the last beam so far of either row, before each one
        last = np.stack([_last(beam, side == k) for k in (0, 1)])
        mine, opposite = last[side, np.arange(len(beam))], last[1 - side, np.arange(len(beam))]
        known = (mine >= 0) & (opposite >= 0)
        parts.append(np.stack([mine, beam, opposite], axis=1)[known])
    return np.concatenate(parts).astype(np.int32)


def _ordered(rows: Rows, row: int) -> tuple[Index, Float]:
    """The beams of a row by their angle, and these; the first one again at the end of a turn."""
    beam = np.arange(rows.first[row], rows.first[row + 1])
    at = rows.angle[beam]
    order = np.argsort(at, kind="stable")
    beam, at = beam[order], at[order]
    if rows.closed and len(beam):
        beam, at = np.append(beam, beam[0]), np.append(at, at[0] + 2.0 * np.pi)
    return beam, at


def _last(beam: Index, some: NDArray[np.bool_]) -> Index:
    """(n,) of the beams before each the last one that is of some; -1: none."""
    place = np.where(some, np.arange(len(beam)), -1)
    before = np.concatenate([[-1], np.maximum.accumulate(place)[:-1]]).astype(np.intp)
    return np.where(before >= 0, beam[before], -1)
