"""Extrinsic calibration of the color camera against the depth camera from images alone.

Some RGB-D folders hold depth registered to color; others (7-Scenes) hold unregistered pairs of
two cameras some centimetres apart with different focal lengths. Depth edges coincide with color
edges where they are projected correctly, so the color camera maximizes the mean color gradient at
depth discontinuities.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stillmap.core.array_types import Float, Float32
from stillmap.core.camera import Camera
from stillmap.core.errors import InputError
from stillmap.io import cameras

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
    gradient: Float32


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
    best = _maximize_score(guess, edges)
    tx, ty, f, cx, cy = (round(float(value), 4) for value in best)
    T = np.eye(4)
    T[:2, 3] = -tx, -ty
    assert depth.T_base_camera is not None
    K = np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
    camera = replace(depth, K=K, T_base_camera=depth.T_base_camera @ T)
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
    best = fmin(
        cost,
        guess,
        xtol=0.02,  # pixels
        ftol=1e-4,
        maxiter=_MAX_ITERATIONS,
        disp=False,
        initial_simplex=np.vstack([guess, guess + np.diag(steps)]),
    )
    best = np.asarray(best, np.float64)
    return best if _shift(best, guess, edges) <= _MAX_SHIFT * guess[2] else guess


def _find_edges(K: Float, scale: float, pairs: Sequence[tuple[Path, Path]]) -> list[_Edges]:
    from scipy.ndimage import gaussian_filter

    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(_MAX_IMAGES, len(pairs))).astype(np.intp))
    out = []
    for pair in chosen.tolist():
        try:
            depth, color = (cameras.read_image(file) for file in pairs[pair])
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
    return [edges for edges in out if len(edges.points)]


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


def _shift(best: Float, guess: Float, edges: Sequence[_Edges]) -> float:
    """90 % quantile of the pixels by which the edges move between two cameras."""
    points = np.concatenate([edge.points for edge in edges])
    (u, v), (u0, v0) = _project(best, points), _project(guess, points)
    return float(np.quantile(np.hypot(u - u0, v - v0), 0.9))
