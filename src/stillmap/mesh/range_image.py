"""Triangulation of range images: neighboring beams that hit the same surface (Sect. 4.5).

The neighborhood of beams is derived from their directions, whatever format they were read from:

- scans in a plane through the sensor are rows, and successive scans are neighbors;
- rings and columns of lidars, and rows of depth images: strips between one and the next;
- all others: the Delaunay triangulation of the directions on the sphere.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from stillmap.core.array_types import Bool, Float, Index, Int32
from stillmap.core.recording import Recording
from stillmap.mesh.beam_rows import split_rows, triangulate_strips
from stillmap.mesh.triangle_mesh import cross_columns, dot_columns, normalize_columns, row_lengths
from stillmap.slam.deskew import MAX_SCAN_GAP

_MAX_RADIUS_RATIO = 3.0  # of a triangle's circumcircle to the median: else it spans a hole
_MIN_BEAMS = 4  # of a scan whose layout can be told
_JITTER = 1e-6  # rad: four directions on a circle, as in grids, take Qhull ten times longer
_FLATNESS = 0.04  # rad from a plane: a planar laser may sit off its joint
_MIN_SPREAD = 0.2  # rad within the plane
_TESTED_SCANS = 9  # that tell whether scans are planar
_ROWS_PER_PATCH = 128  # planar scans triangulated together
_CELL_KEYS = np.array([1 << 42, 1 << 21, 1])  # make one number of a cell of directions

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


class Patch(NamedTuple):
    """Triangles of a range image, or of successive planar scans.

    Attributes:
        points: (n, 3) metres.
        faces: (m, 3) int32, counter-clockwise as seen from the sensor.
        beam: (n,) number of each point's beam in the recording.
        origin: (n, 3) sensor position, in the frame of the points.
        standoff: (n,) metres from there to the surface's tangent plane at the point.
    """

    points: Float
    faces: Int32
    beam: Index
    origin: Float
    standoff: Float


class ScanLayout(NamedTuple):
    """Layout of a recording's scans as range images.

    Attributes:
        is_planar: whether each scan is a row.
        groups: scans of each range image.
        min_angle: rad between beams that are used, about, but for planar scans; 0: all are.
    """

    is_planar: bool
    groups: list[Index]
    min_angle: float = 0.0


def beam_directions(points: NDArray[np.floating]) -> Float:
    """(n, 3) unit vectors, NaN where points (n, 3) are, or lie in the sensor."""
    wide = points.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.asarray(wide / np.where(length > 0.0, length, np.nan))


def is_planar(directions: Float) -> bool:
    """True if beams with directions (n, 3), NaN where unknown, lie in one plane."""
    known = directions[np.isfinite(directions).all(axis=1)]
    if len(known) < _MIN_BEAMS:
        return False
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(known.T @ known / len(known)), 0.0))
    return bool(spread[0] < _FLATNESS and spread[1] > _MIN_SPREAD)


def has_planar_scans(recording: Recording) -> bool:
    """True if most scans of a 3D recording are planar, as those of a tilting laser."""
    n = recording.n_scans
    tested = np.unique(np.linspace(0, n - 1, min(n, _TESTED_SCANS)).astype(np.intp))
    planar = [is_planar(beam_directions(recording.points[recording.beams_of(t)])) for t in tested]
    return sum(planar) * 2 > len(planar)


def is_row_scanner(recording: Recording) -> bool:
    """True if scans are planar and of one length, so that each is a row of a range image."""
    counts = np.diff(recording.offset)
    return has_planar_scans(recording) and len(np.unique(counts[counts > 0])) == 1


def median_angle(one: Float, other: Float) -> float:
    """rad, median angle between directions (n, 3) and (n, 3); NaN where no pair is known."""
    chord = np.linalg.norm(one - other, axis=1)
    known = chord[np.isfinite(chord)]
    return float(2.0 * np.arcsin(0.5 * np.median(known))) if len(known) else float("nan")


def find_scan_layout(recording: Recording) -> ScanLayout:
    """The range images of all scans of a 3D recording."""
    if is_row_scanner(recording):
        return ScanLayout(True, _split_sequences(recording))
    return ScanLayout(False, list(np.flatnonzero(np.diff(recording.offset))[:, None]))


def _split_sequences(recording: Recording) -> list[Index]:
    """Successive planar scans, each sequence beginning with the last scan of the one before."""
    out = []
    # a laser on a joint may count as another sensor at each scan, where its pose differs
    once = np.bincount(recording.sensor, minlength=len(recording.T_base_sensor)) == 1
    of_sensor = np.where(once[recording.sensor], np.int32(-1), recording.sensor)
    for sensor in np.unique(of_sensor):
        scans = np.flatnonzero((of_sensor == sensor) & (np.diff(recording.offset) > 0))
        ends = np.flatnonzero(np.diff(recording.stamp_ns[scans]) > MAX_SCAN_GAP * 1e9) + 1
        for part in np.split(scans, ends):
            for first in range(0, max(len(part) - 1, 0), _ROWS_PER_PATCH):
                out.append(part[first : first + _ROWS_PER_PATCH + 1])
    return sorted(out, key=lambda part: int(part[0]))


def triangulate_scans(
    recording: Recording, poses: Float, layout: ScanLayout
) -> Iterator[Callable[[], Patch]]:
    """Functions that make each patch, in the order of the scans.

    Args:
        recording: 3D, deskewed.
        poses: (T, 4, 4) T_map_base.
        layout: see `find_scan_layout`.
    """
    for scans in layout.groups:
        yield partial(_make_patch, recording, poses, scans, layout)


def _make_patch(recording: Recording, poses: Float, scans: Index, layout: ScanLayout) -> Patch:
    beam = np.concatenate([np.arange(recording.offset[t], recording.offset[t + 1]) for t in scans])
    local, points = recording.points[beam].astype(np.float64), recording.end_points(beam, poses)
    T = poses[scans] @ recording.T_base_sensor[recording.sensor[scans]]
    origin = T[np.searchsorted(scans, recording.scans_of(beam)), :3, 3]
    # a return at the sensor itself has no direction
    use = recording.hit[beam] & np.isfinite(points).all(axis=1) & local.any(axis=1)
    points[~use] = 0.0  # in no triangle
    directions = beam_directions(local)
    if layout.is_planar:
        faces = _triangulate_rows(points, use, directions, len(scans))
    else:
        directions = directions @ recording.T_base_sensor[recording.sensor[scans[0]], :3, :3].T
        faces = _triangulate_directions(directions, use, layout.min_angle)
    faces, standoff = filter_faces(points, origin, faces)
    used, number = np.unique(faces, return_inverse=True)
    faces = number.reshape(-1, 3).astype(np.int32)
    return Patch(points[used], faces, beam[used], origin[used], standoff[used])


def _triangulate_rows(points: Float, use: Bool, directions: Float, rows: int) -> Int32:
    """(m, 3) triangles between successive planar scans of one length."""
    number = np.arange(len(points), dtype=np.int32).reshape(rows, -1)
    spacing = median_angle(directions[:-1], directions[1:])
    if median_angle(directions[number[:, -1]], directions[number[:, 0]]) < 2.0 * spacing:
        number = np.concatenate([number, number[:, :1]], axis=1)  # they go all around
    return triangulate_grid(points, use, number)


def _triangulate_directions(directions: Float, use: Bool, min_angle: float) -> Int32:
    """(m, 3) triangles of valid beams: strips between rows, else the Delaunay triangulation.

    On the sphere that is a convex hull. Lost returns whose directions are known take part, so that
    no triangle spans them.
    """
    beams = np.flatnonzero(np.isfinite(directions).all(axis=1))
    beams = beams[np.argsort(~use[beams], kind="stable")]  # of beams close together a valid one
    if min_angle > 0.0:
        cells = np.floor(directions[beams] / min_angle).astype(np.int64)
        beams = beams[np.unique(cells @ _CELL_KEYS, return_index=True)[1]]
    beams = np.sort(beams)
    if len(beams) < _MIN_BEAMS or is_planar(directions[beams]):
        return np.zeros((0, 3), np.int32)
    rng = np.random.default_rng(0)
    corners = beam_directions(directions[beams] + rng.normal(0.0, _JITTER, (len(beams), 3)))
    rows = split_rows(directions[beams])
    faces = ConvexHull(corners).simplices if rows is None else triangulate_strips(rows)
    edges = corners[faces] - corners[np.roll(faces, 1, axis=1)]
    area = 0.5 * row_lengths(np.cross(edges[:, 0], edges[:, 1]))
    radius = np.linalg.norm(edges, axis=2).prod(axis=1) / np.maximum(4.0 * area, 1e-300)
    kept = (radius <= _MAX_RADIUS_RATIO * np.median(radius)) & use[beams[faces]].all(axis=1)
    return np.asarray(beams[faces[kept]], np.int32)


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
    cross, sight = cross_columns(ca, ab), _columns(origin)[:, corners[0]] - (a + b + c) / 3.0
    area, range = np.sqrt(dot_columns(cross, cross)), np.sqrt(dot_columns(sight, sight))
    longest = np.sqrt(np.max([dot_columns(edge, edge) for edge in (ab, bc, ca)], axis=0))
    facing = dot_columns(cross, sight)
    # counter-clockwise as seen from the sensor
    away = facing < 0.0
    faces = np.where(away[:, None], faces[:, ::-1], faces)
    cosine = np.abs(facing) / np.maximum(area * range, 1e-300)
    level = has_equal_ranges(row_lengths(origin - points), faces)
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


def has_equal_ranges(range: Float, faces: Int32) -> Bool:
    """(m,) whether the corners of triangles are equally distant up to noise.

    Args:
        range: (n,) metres.
        faces: (m, 3).
    """
    between = np.ptp(range[faces.T], axis=0)
    return np.asarray(between <= _MAX_NOISE_RATIO * range_std(range, faces))


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
