"""Triangulation of range images: neighboring beams that hit the same surface (Sect. 4.5).

The neighborhood of beams is derived from their directions, whatever format they were read from:

- scans in a plane through the sensor are rows, and successive scans are neighbors;
- scans divisible into rows of equal length, as depth images and columns of lidars, are grids;
- scans in rows of different lengths, as rings of lidars without lost returns, are strips;
- all others: the Delaunay triangulation of the directions.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from stillmap.core.array_types import Bool, Float, Index, Int32
from stillmap.core.recording import Recording
from stillmap.mesh import triangulation
from stillmap.slam.deskew import MAX_SCAN_GAP

_MAX_SPACING_RATIO = 3.0  # of an unordered triangle's longest edge to the median: else a hole
_SAMPLES = 2000  # beams by which row lengths are tested
_MIN_ROW_LENGTH = 4  # beams
_MAX_SPACING = 0.15  # rad between neighbors in a row or in a column
_MAX_ROW_RATIO = 30.0  # of the angle between rows to that between beams
_MAX_ROW_COSINE = 0.5  # between the directions of rows and columns
_FLATNESS = 0.04  # rad from a plane: a planar laser may sit off its joint
_MIN_SPREAD = 0.2  # rad within the plane
_TESTED_SCANS = 9  # that tell whether scans are planar
_ROWS_PER_PATCH = 128  # planar scans triangulated together


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
        stride: every how many-th row and column is used, but for planar scans.
    """

    is_planar: bool
    groups: list[Index]
    stride: int = 1


def beam_directions(points: NDArray[np.floating]) -> Float:
    """(n, 3) unit vectors, NaN where points (n, 3) are, or lie in the sensor."""
    wide = points.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.asarray(wide / np.where(length > 0.0, length, np.nan))


def find_row_length(directions: Float) -> int:
    """Number of beams in each row of a range image; 0: the scan is no grid.

    Within rows directions change little, and from row to row at a right angle to that. The
    shortest divisor of the number of beams for which this holds.

    Args:
        directions: (n, 3) row by row, NaN where unknown.
    """
    n = len(directions)
    step = max(n // _SAMPLES, 1)
    for length in range(_MIN_ROW_LENGTH, n // 2 + 1):
        if n % length == 0 and _is_row_length(directions, length, step):
            return length
    return 0


def _is_row_length(directions: Float, length: int, step: int) -> bool:
    # not all in one column
    k = np.arange(0, len(directions) - length - 1, step)
    k += np.arange(len(k)) % 7
    k = k[(k + length < len(directions)) & (k % length != length - 1)]
    along, across = directions[k + 1] - directions[k], directions[k + length] - directions[k]
    known = np.isfinite(along).all(axis=1) & np.isfinite(across).all(axis=1)
    if np.count_nonzero(known) < max(8, len(k) // 20):
        return False
    along, across = along[known], across[known]
    one, other = np.linalg.norm(along, axis=1), np.linalg.norm(across, axis=1)
    spacing, widest = float(np.median(one)), float(np.percentile(other, 90))
    if not 0.0 < spacing <= _MAX_SPACING:
        return False
    if not 0.0 < widest <= min(_MAX_SPACING, _MAX_ROW_RATIO * spacing):
        return False
    cosine = np.abs(np.einsum("ni,ni->n", along, across)) / np.maximum(one * other, 1e-300)
    return float(np.median(cosine)) < _MAX_ROW_COSINE


def is_planar(directions: Float) -> bool:
    """True if beams with directions (n, 3), NaN where unknown, lie in one plane."""
    known = directions[np.isfinite(directions).all(axis=1)]
    if len(known) < _MIN_ROW_LENGTH:
        return False
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(known.T @ known / len(known)), 0.0))
    return bool(spread[0] < _FLATNESS and spread[1] > _MIN_SPREAD)


def has_planar_scans(recording: Recording) -> bool:
    """True if most scans of a 3D recording are planar, as those of a tilting laser."""
    n = recording.n_scans
    tested = np.unique(np.linspace(0, n - 1, min(n, _TESTED_SCANS)).astype(np.intp))
    planar = [is_planar(beam_directions(recording.points[recording.beams_of(t)])) for t in tested]
    return sum(planar) * 2 > len(planar)


def median_angle(one: Float, other: Float) -> float:
    """rad, median angle between directions (n, 3) and (n, 3); NaN where no pair is known."""
    chord = np.linalg.norm(one - other, axis=1)
    known = chord[np.isfinite(chord)]
    return float(2.0 * np.arcsin(0.5 * np.median(known))) if len(known) else float("nan")


def find_scan_layout(recording: Recording, chosen: Index) -> ScanLayout:
    """The range images of a 3D recording.

    Args:
        recording: 3D.
        chosen: scans to be used; where scans are rows, all are.
    """
    counts = np.diff(recording.offset)
    # planar scans of one length are rows of range images
    if has_planar_scans(recording) and len(np.unique(counts[counts > 0])) == 1:
        return ScanLayout(True, _split_sequences(recording))
    return ScanLayout(False, [np.array([t]) for t in chosen if counts[t]])


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
    row_lengths: dict[tuple[int, int], int] = {}
    for scans in layout.groups:
        yield partial(_make_patch, recording, poses, scans, layout, row_lengths)


def _make_patch(
    recording: Recording,
    poses: Float,
    scans: Index,
    layout: ScanLayout,
    row_lengths: dict[tuple[int, int], int],
) -> Patch:
    beam = np.concatenate([np.arange(recording.offset[t], recording.offset[t + 1]) for t in scans])
    local, points = recording.points[beam].astype(np.float64), recording.end_points(beam, poses)
    sensor, scan = recording.sensor[scans], np.searchsorted(scans, recording.scans_of(beam))
    T = poses[scans] @ recording.T_base_sensor[sensor]
    origin = T[scan, :3, 3]
    x, y, z = points.T
    # a return at the sensor itself has no direction
    use = recording.hit[beam] & np.isfinite(x + y + z) & local.any(axis=1)
    points[~use] = 0.0  # in no triangle
    directions = beam_directions(local)
    if layout.is_planar:
        R = recording.T_base_sensor[sensor, :3, :3]
        directions = np.einsum("nij,nj->ni", R[scan], directions)
        row_length = len(beam) // len(scans)
    else:
        key = (int(sensor[0]), len(beam))
        if key not in row_lengths:
            row_lengths[key] = find_row_length(directions)
        row_length = row_lengths[key]
    faces = _triangulate_image(points, use, directions, row_length, layout)
    faces, standoff = triangulation.filter_faces(points, origin, faces)
    used = np.zeros(len(points), np.bool_)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return Patch(points[used], number[faces], beam[used], origin[used], standoff[used])


def _triangulate_image(
    points: Float, use: Bool, directions: Float, row_length: int, layout: ScanLayout
) -> Int32:
    """Triangles of a range image; a row length of 0 means that it is no grid."""
    if not row_length:
        return _triangulate_without_grid(use, directions)
    number = np.arange(len(points), dtype=np.int32).reshape(-1, row_length)
    along = median_angle(directions[:-1], directions[1:])
    across = median_angle(directions[:-row_length], directions[row_length:])
    if median_angle(directions[number[:, -1]], directions[number[:, 0]]) < 2.0 * along:
        number = np.concatenate([number, number[:, :1]], axis=1)
    if layout.is_planar:
        return triangulation.triangulate_grid(points, use, number)
    around = median_angle(directions[number[-1]], directions[number[0]])
    if len(number) > 2 and around < 2.0 * across:
        number = np.concatenate([number, number[:1]])
    return triangulation.triangulate_grid(points, use, number[:: layout.stride, :: layout.stride])


def _triangulate_without_grid(use: Bool, directions: Float) -> Int32:
    """Triangles between valid beams that form strips or no grid; long triangles are left out."""
    beams = np.flatnonzero(use)
    if len(beams) < 3:
        return np.zeros((0, 3), np.int32)
    valid = directions[beams]
    rows = triangulation.split_rows(valid)
    faces = (
        triangulate_directions(valid) if rows is None else triangulation.triangulate_strips(rows)
    )
    if not len(faces):
        return faces
    chord = np.linalg.norm(valid[faces] - np.roll(valid[faces], 1, axis=1), axis=2).max(axis=1)
    faces = faces[chord <= _MAX_SPACING_RATIO * np.median(chord)]
    return np.asarray(beams[faces], np.int32)


def triangulate_directions(directions: Float) -> Int32:
    """(m, 3) the Delaunay triangulation of unit vectors (n, 3) on the sphere: their convex hull."""
    try:
        return ConvexHull(directions).simplices.astype(np.int32)
    except QhullError:  # all in one plane
        return np.zeros((0, 3), np.int32)
