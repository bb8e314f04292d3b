"""Gravity alignment of depth cameras: recorded poses rotated so that z points up.

The mean of the cameras' upward axes is up within about ten degrees. It is refined to the mode of
the surface normals near it (floors, tables, shelves), then to the normal of the largest such plane.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from stillmap.core import se3
from stillmap.core.array_types import Float
from stillmap.core.recording import Recording

_MAX_SCANS = 60  # scans used
_PATCHES = 32  # patches with a normal across an image
_MIN_MEAN_UP = 0.3  # norm of the mean upward axis; below, orientations are arbitrary
_MAX_TILT = np.tan(np.radians(40.0))  # of floor normals from the mean upward axis
_BIN = 0.035  # rad, of the histogram of normals: two degrees
_MIN_COSINE = np.cos(np.radians(5.0))  # between the normals of parallel surfaces
_MIN_SHARE = 0.05  # of all surfaces that share the mode
_LAYER = 0.05  # m, of the histogram of heights
_MIN_EXTENT = 0.2  # m, standard deviation along the shorter side of a plane
_MAX_REFINEMENTS = 5


def align_to_gravity(recording: Recording) -> Recording:
    """Rotate the recorded poses about their origin so that z points up.

    `source.details["levelled"]` holds the angle, the direction, and what determined it.

    Args:
        recording: any; only one of a depth camera, whose scans are grids, is not levelled yet.
    """
    T = recording.T_recorded_base
    if T is None or not _has_grids(recording) or "levelled" in recording.source.details:
        return recording
    mean = T[:, :3, 2].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < _MIN_MEAN_UP:
        return _with_note(recording, {"by": "nothing: the cameras have arbitrary orientations"})
    up, by = _refine_up(*_collect_surfaces(recording, T), mean / length)
    rotation = np.eye(4)
    rotation[:3, :3] = _rotation_to_z(up)
    angle = float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))
    note = {"by": by, "turned_deg": round(angle, 2), "up": [round(float(v), 6) for v in up]}
    return _with_note(replace(recording, T_recorded_base=rotation @ T), note)


def _has_grids(recording: Recording) -> bool:
    """True if all scans are grids as noted; a damaged folder may note any."""
    sensors = recording.source.sensors
    if not sensors or sensors[0].grid is None:
        return False
    rows, columns = sensors[0].grid
    return min(rows, columns) > 0 and bool(np.all(np.diff(recording.offset) == rows * columns))


def _with_note(recording: Recording, what: dict[str, Any]) -> Recording:
    details = {**recording.source.details, "levelled": what}
    return replace(recording, source=replace(recording.source, details=details))


def _collect_surfaces(recording: Recording, T: Float) -> tuple[Float, Float]:
    """(n, 3) surface points and unit normals in the recorded map frame."""
    grid = recording.source.sensors[0].grid
    assert grid is not None
    rows, columns = grid
    step = max(1, columns // _PATCHES)
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    scans = np.unique(np.linspace(0, recording.n_scans - 1, _MAX_SCANS).astype(np.intp))
    for scan in recording.iter_scans(scans.tolist()):
        image = recording.points[recording.beams_of(scan)].reshape(rows, columns, 3)
        hit = recording.hit[recording.beams_of(scan)].reshape(rows, columns)
        corners = np.where(hit[..., None], image, np.nan)[::step, ::step].astype(np.float64)
        corner, right, below = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1]
        normal = np.cross(below - corner, right - corner).reshape(-1, 3)
        length = np.linalg.norm(normal, axis=1)
        # patches across a depth edge are large
        depth = np.linalg.norm(corner.reshape(-1, 3), axis=1)
        good = (length > 0.0) & (length < (0.2 * depth) ** 2)
        in_map = corner.reshape(-1, 3)[good] @ T[scan, :3, :3].T + T[scan, :3, 3]
        points.append(in_map)
        normals.append((normal[good] / length[good, None]) @ T[scan, :3, :3].T)
    return np.concatenate(points), np.concatenate(normals)


def _refine_up(points: Float, normals: Float, up: Float) -> tuple[Float, str]:
    """Upward direction (3,), and what determined it."""
    from_cameras = up, "cameras"
    upward = normals @ up > 0.0
    if not upward.any():
        return from_cameras
    # gnomonic projection of the normals, centred at `up`
    R = _rotation_to_z(up)
    rotated = normals[upward] @ R.T
    flat = rotated[:, :2] / rotated[:, 2:]
    near = (np.abs(flat) < _MAX_TILT).all(axis=1)
    if not near.any():
        return from_cameras
    edges = np.arange(-_MAX_TILT, _MAX_TILT + _BIN, _BIN)
    counts = np.histogram2d(flat[near, 0], flat[near, 1], bins=[edges, edges])[0]
    peak = np.unravel_index(counts.argmax(), counts.shape)
    mode = R.T @ np.array([edges[peak[0]] + 0.5 * _BIN, edges[peak[1]] + 0.5 * _BIN, 1.0])
    mode /= np.linalg.norm(mode)
    for _ in range(_MAX_REFINEMENTS):
        aligned = normals @ mode > _MIN_COSINE
        if aligned.sum() < _MIN_SHARE * len(normals):
            return from_cameras
        mode = normals[aligned].mean(axis=0)
        mode /= np.linalg.norm(mode)
    return _fit_largest_plane(points, normals, mode)


def _fit_largest_plane(points: Float, normals: Float, up: Float) -> tuple[Float, str]:
    """Normal of the plane across `up` with most points; `up` where it is small."""
    for _ in range(_MAX_REFINEMENTS):
        level_points = points[normals @ up > _MIN_COSINE]
        height = level_points @ up
        bins = np.floor((height - height.min()) / _LAYER).astype(np.intp)
        level = height.min() + (np.bincount(bins).argmax() + 0.5) * _LAYER
        inliers = level_points[np.abs(height - level) < _LAYER]
        values, axes = (
            np.linalg.eigh(np.cov(inliers.T)) if len(inliers) > 3 else (np.zeros(3), np.eye(3))
        )
        if not values[1] > _MIN_EXTENT**2:
            return up, "surfaces"
        normal = axes[:, 0] * np.sign(axes[:, 0] @ up)
        if not normal @ up > _MIN_COSINE:
            return up, "surfaces"
        up = normal
    return up, "plane"


def _rotation_to_z(up: Float) -> Float:
    """(3, 3) smallest rotation that maps a unit vector onto the z axis."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    W = se3.skew(axis)
    return np.asarray(np.eye(3) + W + W @ W / (1.0 + cosine))
