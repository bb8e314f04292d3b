"""Extrinsic calibration of the color camera against the depth camera from images alone.

Some RGB-D folders hold depth registered to color; others (7-Scenes) hold unregistered pairs of
two cameras some centimetres apart with different focal lengths. Depth edges coincide with color
edges where they are projected correctly, so the color camera maximizes the mean color gradient at
depth discontinuities.

Gravity alignment: recorded poses rotated so that z points up.

The mean of the cameras' upward axes is up within about ten degrees. It is refined to the mode of
the surface normals near it (floors, tables, shelves), then to the normal of the largest such plane.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Camera
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io import images

Float = NDArray[np.float64]

# initial guess, of a Kinect: focal length per pixel of width, and baseline in metres
_FOCAL, _BASELINE = 525.0 / 640.0, -0.025
_MAX_IMAGES = 16  # image pairs used
_MAX_EDGES = 1500  # per image and direction
_MIN_LOG_STEP = 0.1  # of depth, between pixels _STEP_WIDTH apart
_STEP_WIDTH = 3.0 / 640.0  # of the image width
_MIN_GAIN = 1.1  # score of the initial guess over that of registered depth, to calibrate at all
_MAX_SHIFT = 0.025  # of the focal length: a result farther from the initial guess is discarded
_MAX_ITERATIONS = 300
_MIN_SIZE = 8  # pixels of an image with edges


class _Edges(NamedTuple):
    """Depth edges of one image: (n, 3) points in the depth camera, (h, w) color gradient across."""

    points: Float
    gradient: NDArray[np.float32]


def calibrate_color_camera(
    depth: Camera, scale: float, pairs: Sequence[tuple[Path, Path]]
) -> tuple[Camera, str]:
    """Calibrate the color camera (baseline, focal length, principal point) against depth.

    Args:
        depth: the depth camera, without distortion; both cameras have the same orientation.
        scale: depth units per metre.
        pairs: files of depth and color images of the same stamp.

    Returns:
        The color camera and a warning; the depth camera and "" where depth is registered to color.
    """
    assert depth.K is not None
    guess = np.array([_BASELINE, 0.0, _FOCAL * depth.width, depth.K[0, 2], depth.K[1, 2]])
    registered = np.array([0.0, 0.0, depth.K[0, 0], depth.K[0, 2], depth.K[1, 2]])
    edges = _find_edges(depth.K, scale, pairs)
    score, score_apart = _score(registered, edges), _score(guess, edges)
    if not score_apart > _MIN_GAIN * score:
        return depth, ""
    found = _maximize_score(guess, edges)
    tx, ty, f, cx, cy = (round(float(value), 4) for value in found)
    T = np.eye(4)
    T[:2, 3] = -tx, -ty
    assert depth.T_base_camera is not None
    camera = replace(
        depth,
        K=np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]]),
        T_base_camera=depth.T_base_camera @ T,
    )
    warning = (
        "depth is not registered to color: calibrated from edges, the color camera sits "
        f"{1e3 * np.hypot(tx, ty):.0f} mm beside the depth camera and has a focal length of "
        f"{f:.0f} pixels; read.cameras overrides this"
    )
    return camera, warning


def _maximize_score(guess: Float, edges: Sequence[_Edges]) -> Float:
    """Parameters of the best score near the guess (Nelder-Mead); the guess if they are far off."""
    from scipy.optimize import fmin

    def cost(numbers: Any) -> float:
        return -_score(numbers, edges)

    steps = np.array([0.005, 0.005, *(guess[2] * np.array([0.01, 0.006, 0.006]))])
    found = fmin(
        cost,
        guess,
        xtol=0.02,  # pixels
        ftol=1e-4,
        maxiter=_MAX_ITERATIONS,
        disp=False,
        initial_simplex=np.vstack([guess, guess + np.diag(steps)]),
    )
    found = np.asarray(found, np.float64)
    return found if _shift(found, guess, edges) <= _MAX_SHIFT * guess[2] else guess


def _find_edges(K: Float, scale: float, pairs: Sequence[tuple[Path, Path]]) -> list[_Edges]:
    from scipy.ndimage import gaussian_filter

    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(_MAX_IMAGES, len(pairs))).astype(np.intp))
    out = []
    for pair in chosen.tolist():
        try:
            depth, color = (images.read_image(file) for file in pairs[pair])
        except InputError:
            continue
        is_pair = depth.dtype == np.uint16 and depth.ndim == 2 and color.shape[:2] == depth.shape
        if not is_pair or min(depth.shape) < _MIN_SIZE:
            continue
        grey = color.astype(np.float32).mean(axis=2) if color.ndim == 3 else color
        smooth = gaussian_filter(grey.astype(np.float32), 1.0)
        for axis in (0, 1):
            gradient = np.abs(np.gradient(smooth, axis=axis))
            out.append(_Edges(_depth_edges(depth / scale, K, axis), gradient))
    return [one for one in out if len(one.points)]


def _depth_edges(depth: Float, K: Float, axis: int) -> Float:
    """(n, 3) points half-way between pixels across a depth edge, at the smaller depth."""
    apart = max(1, round(_STEP_WIDTH * depth.shape[1]))
    last = depth.shape[axis] - apart
    first, second = (np.take(depth, range(n, n + last), axis) for n in (0, apart))
    known = (first > 0.0) & (second > 0.0)
    ratio = np.log(np.where(known, first, 1.0) / np.where(known, second, 1.0))
    pixels = np.argwhere(np.abs(ratio) > _MIN_LOG_STEP)
    pixels = pixels[:: max(1, len(pixels) // _MAX_EDGES)]
    z = np.minimum(first, second)[tuple(pixels.T)]
    position = pixels.astype(np.float64)
    position[:, axis] += 0.5 * apart
    x = (position[:, 1] - K[0, 2]) / K[0, 0] * z
    return np.column_stack([x, (position[:, 0] - K[1, 2]) / K[1, 1] * z, z])


def _project(parameters: Float, points: Float) -> tuple[Float, Float]:
    """Columns and rows of points (n, 3); parameters tx, ty (m), f, cx, cy (pixels)."""
    tx, ty, f, cx, cy = parameters
    return (
        f * (points[:, 0] + tx) / points[:, 2] + cx,
        f * (points[:, 1] + ty) / points[:, 2] + cy,
    )


def _score(parameters: Float, edges: Sequence[_Edges]) -> float:
    """Mean color gradient at the depth edges, with bilinear interpolation."""
    total, count = 0.0, 0
    for points, gradient in edges:
        column, row = _project(parameters, points)
        height, width = gradient.shape
        inside = (column >= 0.0) & (column < width - 1) & (row >= 0.0) & (row < height - 1)
        column, row = column[inside], row[inside]
        j, i = column.astype(np.intp), row.astype(np.intp)
        a, b = column - j, row - i
        upper = gradient[i, j] * (1.0 - a) + gradient[i, j + 1] * a
        lower = gradient[i + 1, j] * (1.0 - a) + gradient[i + 1, j + 1] * a
        total += float(np.sum(upper * (1.0 - b) + lower * b))
        count += len(j)
    return total / max(count, 1)


def _shift(found: Float, guess: Float, edges: Sequence[_Edges]) -> float:
    """90 % quantile of the pixels by which the edges move between two cameras."""
    points = np.concatenate([one.points for one in edges])
    (u, v), (u0, v0) = _project(found, points), _project(guess, points)
    return float(np.quantile(np.hypot(u - u0, v - v0), 0.9))


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


class _Surfaces(NamedTuple):
    """(n, 3) surface points and unit normals in the recorded map frame."""

    points: Float
    normals: Float


def align_to_gravity(recording: Recording) -> Recording:
    """Rotate the recorded poses about their origin so that z points up.

    `source["levelled"]` holds the angle, the direction, and what determined it.

    Args:
        recording: its scans are grids, see `source["sensors"]`.
    """
    T = recording.T_recorded_base
    if T is None:
        return recording
    mean = T[:, :3, 2].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < _MIN_MEAN_UP:
        return _with_note(recording, {"by": "nothing: the cameras have arbitrary orientations"})
    up, by = _refine_up(_collect_surfaces(recording, T), mean / length)
    rotation = np.eye(4)
    rotation[:3, :3] = _rotation_to_z(up)
    angle = float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))
    note = {"by": by, "turned_deg": round(angle, 2), "up": [round(float(v), 6) for v in up]}
    return _with_note(replace(recording, T_recorded_base=rotation @ T), note)


def _with_note(recording: Recording, what: dict[str, Any]) -> Recording:
    return replace(recording, source={**recording.source, "levelled": what})


def _collect_surfaces(recording: Recording, T: Float) -> _Surfaces:
    rows, columns = recording.source["sensors"][0]["grid"]
    step = max(1, columns // _PATCHES)
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    scans = np.unique(np.linspace(0, recording.n_scans - 1, _MAX_SCANS).astype(np.intp))
    for scan in recording.iter_scans(scans.tolist()):
        grid = recording.points[recording.beams_of(scan)].reshape(rows, columns, 3)
        hit = recording.hit[recording.beams_of(scan)].reshape(rows, columns)
        corners = np.where(hit[..., None], grid, np.nan)[::step, ::step].astype(np.float64)
        corner, right, below = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1]
        normal = np.cross(below - corner, right - corner).reshape(-1, 3)
        length = np.linalg.norm(normal, axis=1)
        # patches across a depth edge are large
        depth = np.linalg.norm(corner.reshape(-1, 3), axis=1)
        good = (length > 0.0) & (length < (0.2 * depth) ** 2)
        in_map = corner.reshape(-1, 3)[good] @ T[scan, :3, :3].T + T[scan, :3, 3]
        points.append(in_map)
        normals.append((normal[good] / length[good, None]) @ T[scan, :3, :3].T)
    return _Surfaces(np.concatenate(points), np.concatenate(normals))


def _refine_up(surfaces: _Surfaces, up: Float) -> tuple[Float, str]:
    """Upward direction (3,), and what determined it."""
    from_cameras = up, "cameras"
    upward = surfaces.normals @ up > 0.0
    if not upward.any():
        return from_cameras
    # gnomonic projection of the normals, centred at `up`
    R = _rotation_to_z(up)
    rotated = surfaces.normals[upward] @ R.T
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
        aligned = surfaces.normals @ mode > _MIN_COSINE
        if aligned.sum() < _MIN_SHARE * len(surfaces.normals):
            return from_cameras
        mode = surfaces.normals[aligned].mean(axis=0)
        mode /= np.linalg.norm(mode)
    return _fit_largest_plane(surfaces, mode)


def _fit_largest_plane(surfaces: _Surfaces, up: Float) -> tuple[Float, str]:
    """Normal of the plane across `up` with most points; `up` where it is small."""
    for _ in range(_MAX_REFINEMENTS):
        points = surfaces.points[surfaces.normals @ up > _MIN_COSINE]
        height = points @ up
        bins = np.floor((height - height.min()) / _LAYER).astype(np.intp)
        level = height.min() + (np.bincount(bins).argmax() + 0.5) * _LAYER
        inliers = points[np.abs(height - level) < _LAYER]
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
    x, y, w = axis
    W = np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + W + W @ W / (1.0 + cosine))
