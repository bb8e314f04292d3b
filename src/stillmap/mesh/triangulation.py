"""Triangles between neighboring beams, and which of them are surface."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Float, Index, Int32
from stillmap.mesh.triangle_mesh import dot_columns, normalize_columns, row_lengths

_MAX_EDGE = 1.5  # m: longer edges span holes
_MAX_EDGE_SHARE = 0.15  # of the range, likewise
_MAX_INCIDENCE = 1.5  # rad between line of sight and normal
_STEEP = 1.22  # rad of incidence from which on a triangle must be coplanar with those around
_MAX_BEND = 0.35  # rad between the normals of such a triangle and those around
SMOOTHING_ROUNDS = 2  # in which vertex normals are averaged with their neighbors'
_FULL_FAN = 6  # triangles around a vertex with neighbors on all sides
# median of |x - mean of six neighbors| over the noise's standard deviation: 0.6745 sqrt(7 / 6)
_MEDIAN_DEVIATION = 0.73
_MAX_NOISE_RATIO = 5.0  # standard deviations between the ranges of three corners

_ROW_RESET = 0.1  # rad by which the angle falls where the next row begins
_MIN_STEADY = 0.95  # share of the steps within rows that go on
_MIN_ROWS, _MIN_ROW_LENGTH = 4, 16  # rows, and median number of beams in them
_MAX_STEP = 0.05  # rad, median step within a row
_MAX_OPENING = 0.2  # rad that a full turn may lack


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


def triangulate_grid(points: Float, use: Bool, number: Int32) -> Int32:
    """(m, 3) two triangles per cell of a range image, one where a corner is missing.

    Cells are split along the shorter diagonal.

    Args:
        points: (n, 3) metres.
        use: (n,) which points are valid.
        number: (H, W) of the point at each pixel.
    """
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    d, c = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    some = np.flatnonzero(use[a].astype(np.int8) + use[b] + use[c] + use[d] >= 3)
    a, b, c, d = a[some], b[some], c[some], d[some]
    ua, ub, uc, ud = use[a], use[b], use[c], use[d]
    columns = _columns(points)
    with np.errstate(invalid="ignore"):
        shorter = _squared_distances(columns, a, c) <= _squared_distances(columns, b, d)
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


def _squared_distances(columns: Float, a: Int32, b: Int32) -> Float:
    return np.asarray(sum((x[a] - x[b]) ** 2 for x in columns))


def filter_faces(points: Float, origin: Float, faces: Int32) -> tuple[Int32, Float]:
    """The triangles that do not span holes or depth discontinuities.

    A triangle at grazing incidence is either part of such a surface, as distant floor, and then
    coplanar with those around; or it leads from an object's edge to the background. If its corners
    are equally distant up to range noise, its angle is not meaningful, and it stays.

    Args:
        points: (n, 3) metres.
        origin: (n, 3) sensor position of each.
        faces: (m, 3).

    Returns:
        (m, 3) counter-clockwise as seen from the sensor; (n,) metres from the sensor to the tangent
        plane at each point, 0 where there is no triangle.
    """
    columns, corners = _columns(points), [np.ascontiguousarray(k) for k in faces.T]
    a, b, c = (columns[:, k] for k in corners)
    ab, bc, ca = b - a, c - b, a - c
    cross, sight = np.cross(ca, ab, axis=0), _columns(origin)[:, corners[0]] - (a + b + c) / 3.0
    area, range = np.sqrt(dot_columns(cross, cross)), np.sqrt(dot_columns(sight, sight))
    longest = np.sqrt(np.max([dot_columns(edge, edge) for edge in (ab, bc, ca)], axis=0))
    facing = dot_columns(cross, sight)
    # counter-clockwise as seen from the sensor
    away = facing < 0.0
    faces = np.where(away[:, None], faces[:, ::-1], faces)
    cosine = np.abs(facing) / np.maximum(area * range, 1e-300)
    ranges = row_lengths(origin - points)
    level = np.ptp(ranges[faces.T], axis=0) <= _MAX_NOISE_RATIO * range_std(ranges, faces)
    limit = np.minimum(_MAX_EDGE, _MAX_EDGE_SHARE * range)
    kept = (longest <= limit) & (level | (cosine >= np.cos(_MAX_INCIDENCE))) & (area > 0.0)
    faces, cosine = faces[kept], cosine[kept]
    normals = cross[:, kept] * (np.where(away, -1.0, 1.0) / np.maximum(area, 1e-300))[kept]
    steep = np.flatnonzero((cosine < np.cos(_STEEP)) & ~level[kept])
    at_points = vertex_normals(normals, faces, len(points), 0)
    along = [dot_columns(at_points[:, faces[steep, k]], normals[:, steep]) for k in (0, 1, 2)]
    fits = np.ones(len(faces), np.bool_)
    # at two corners: the third may lie in the corner of a room
    fits[steep] = np.sort(along, axis=0)[1] >= np.cos(_MAX_BEND)
    faces, normals = faces[fits], normals[:, fits]
    smooth = vertex_normals(normals, faces, len(points), SMOOTHING_ROUNDS)
    standoff = dot_columns(smooth, _columns(origin - points))
    return faces.astype(np.int32), np.where(np.isfinite(standoff), standoff, 0.0)


def range_std(range: Float, faces: Int32) -> float:
    """Standard deviation of the noise of ranges (n,) in metres; 0 where it is unknown.

    From the median distance of each range from the mean of its neighbors.
    """
    count = np.bincount(faces.ravel(), minlength=len(range))
    each = range[faces[:, 0]] + range[faces[:, 1]] + range[faces[:, 2]]
    total = np.bincount(faces.ravel(), np.repeat(each, 3), len(range))
    inside = count >= _FULL_FAN
    if not inside.any():
        return 0.0
    # each triangle around counts the point itself, and each neighbor is in two
    around = (total[inside] - count[inside] * range[inside]) / (2 * count[inside])
    return float(np.median(np.abs(around - range[inside]))) / _MEDIAN_DEVIATION


def vertex_normals(normals: Float, faces: Int32, n: int, rounds: int) -> Float:
    """(3, n) unit normals of n points: the means of those of the triangles around.

    Args:
        normals: (3, m) normals of the triangles, whose lengths are weights.
        faces: (m, 3).
        n: number of points.
        rounds: how often they are averaged again over the triangles' corners.
    """
    corner = faces.ravel().astype(np.intp)
    a, b, c = (np.ascontiguousarray(k) for k in faces.T)
    out = _average_at_points(normals, corner, n)
    for _ in range(rounds):
        mean = normalize_columns(np.stack([x[a] + x[b] + x[c] for x in out]))
        out = _average_at_points(mean, corner, n)
    return out


def _average_at_points(normals: Float, corner: Index, n: int) -> Float:
    out = np.empty((3, n))
    for d, along in enumerate(normals):
        out[d] = np.bincount(corner, np.repeat(along, 3), n)
    return normalize_columns(out)


def split_rows(directions: Float) -> Rows | None:
    """Splits beams into rows along which azimuth or elevation goes on; None: there are no rows.

    Args:
        directions: (n, 3) unit vectors in recorded order.
    """
    if len(directions) < _MIN_ROWS * _MIN_ROW_LENGTH:
        return None
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    for angle in (azimuth, np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))):
        turned = (np.diff(angle) + np.pi) % (2.0 * np.pi) - np.pi
        sense = 1.0 if np.median(turned) > 0.0 else -1.0
        # the recording begins with a row
        along = (sense * (angle - angle[0])) % (2.0 * np.pi) if angle is azimuth else sense * angle
        step = np.diff(along)
        breaks = np.flatnonzero(step < -_ROW_RESET) + 1
        first = np.concatenate([[0], breaks, [len(directions)]]).astype(np.intp)
        within = np.delete(step, breaks - 1)
        steady = np.mean((within > 0.0) & (within < 10.0 * _MAX_STEP)) > _MIN_STEADY
        median_step = float(np.median(np.abs(step)))
        if steady and median_step < _MAX_STEP and len(breaks) + 1 >= _MIN_ROWS:
            if np.median(np.diff(first)) < _MIN_ROW_LENGTH:
                continue
            span = float(np.median([np.ptp(along[a:b]) for a, b in pairwise(first)]))
            return Rows(first, along, span > 2.0 * np.pi - _MAX_OPENING)
    return None


def triangulate_strips(rows: Rows) -> Int32:
    """(m, 3) triangle strips between successive rows, which may differ in length.

    After the last row comes the first one, which may be far away.
    """
    parts = [np.zeros((0, 3), np.intp)]
    ordered = [_sort_row(rows, r) for r in range(len(rows.first) - 1)]
    for (one, at_one), (other, at_other) in pairwise([*ordered, ordered[0]]):
        beam = np.concatenate([one, other])
        side = np.repeat([0, 1], [len(one), len(other)])
        order = np.argsort(np.concatenate([at_one, at_other]), kind="stable")
        beam, side = beam[order], side[order]
        # the last beam of either row before each beam
        last = np.stack([_previous_beam(beam, side == k) for k in (0, 1)])
        mine, opposite = last[side, np.arange(len(beam))], last[1 - side, np.arange(len(beam))]
        known = (mine >= 0) & (opposite >= 0)
        parts.append(np.stack([mine, beam, opposite], axis=1)[known])
    return np.concatenate(parts).astype(np.int32)


def _sort_row(rows: Rows, row: int) -> tuple[Index, Float]:
    """The beams of a row by angle, and the angles; closed rows end with their first beam."""
    beam = np.arange(rows.first[row], rows.first[row + 1])
    at = rows.angle[beam]
    order = np.argsort(at, kind="stable")
    beam, at = beam[order], at[order]
    if rows.closed and len(beam):
        beam, at = np.append(beam, beam[0]), np.append(at, at[0] + 2.0 * np.pi)
    return beam, at


def _previous_beam(beam: Index, some: Bool) -> Index:
    """(n,) the last beam before each that is marked in `some` (n,); -1: none."""
    place = np.where(some, np.arange(len(beam)), -1)
    before = np.concatenate([[-1], np.maximum.accumulate(place)[:-1]]).astype(np.intp)
    return np.where(before >= 0, beam[before], -1)
