"""Where the colour camera sits beside the depth camera, where nobody says so.

Depth is laid over the colours in some folders and not in others (7-Scenes), whose two cameras sit
some centimetres apart and see with other focal lengths. Where depth leaps, things end; and there
the colours change, if they are looked up in the right place. So the mean steepness of the colours
at leaps of depth tells right from wrong, and is as large as can be for the right camera.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.core.camera import Camera
from stillmap.core.errors import InputError
from stillmap.io import images

Float = NDArray[np.float64]

# of the camera that such folders are made with (Kinect), per pixel of width, and in metres
_FOCAL, _ASIDE = 525.0 / 640.0, -0.025
_PICTURES = 16  # that are looked at
_EDGES = 1500  # of each, upright and level ones
_LEAP = 0.1  # of the logarithm of depth, over
_APART = 3.0 / 640.0  # of the width
_BETTER = 1.1  # by so much the colours are steeper where it is not laid over
_FAR = 0.025  # of the focal length: what is found farther from where it is usual is not believed
_STEPS = 300
_SMALLEST = 8  # pixels of a picture with edges


class _Edges(NamedTuple):
    """Leaps of depth in one picture: (n, 3) points in the depth camera, (h, w) steepness of the
    colours across such edges."""

    points: Float
    steepness: NDArray[np.float32]


def calibrate_color_camera(
    depth: Camera, scale: float, pairs: Sequence[tuple[Path, Path]]
) -> tuple[Camera, str]:
    """The colour camera, and what was found in words; depth's own and "" where it is laid over.

    Args:
        depth: its camera, without distortion; its place is turned as that of the colours is.
        scale: units of depth per metre.
        pairs: files of depth and colours that were taken together.
    """
    assert depth.K is not None
    usual = np.array([_ASIDE, 0.0, _FOCAL * depth.width, depth.K[0, 2], depth.K[1, 2]])
    over = np.array([0.0, 0.0, depth.K[0, 0], depth.K[0, 2], depth.K[1, 2]])
    edges = _edges(depth.K, scale, pairs)
    before, beside = _score(over, edges), _score(usual, edges)
    if not beside > _BETTER * before:
        return depth, ""
    found = _steepest(usual, edges)
    tx, ty, f, cx, cy = (round(float(value), 4) for value in found)
    T = np.eye(4)
    T[:2, 3] = -tx, -ty
    assert depth.T_base_camera is not None
    camera = replace(
        depth,
        K=np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]]),
        T_base_camera=depth.T_base_camera @ T,
    )
    said = (
        f"depth is not laid over the colours: by the edges of things, their camera sits "
        f"{1e3 * np.hypot(tx, ty):.0f} mm beside that of depth and has a focal length of {f:.0f} "
        "pixels; --cameras FILE knows better, read.register=false takes both for one"
    )
    return camera, said


def _steepest(usual: Float, edges: Sequence[_Edges]) -> Float:
    """The camera near the usual one that fits best; the usual one if that is far away."""

    def misfit(numbers: Any) -> float:
        return -_score(numbers, edges)

    steps = np.array([0.005, 0.005, *(usual[2] * np.array([0.01, 0.006, 0.006]))])
    found = scipy.optimize.fmin(
        misfit,
        usual,
        xtol=0.02,  # pixels
        ftol=1e-4,
        maxiter=_STEPS,
        disp=False,
        initial_simplex=np.vstack([usual, usual + np.diag(steps)]),
    )
    found = np.asarray(found, np.float64)
    return found if _farthest(found, usual, edges) <= _FAR * usual[2] else usual


def _edges(K: Float, scale: float, pairs: Sequence[tuple[Path, Path]]) -> list[_Edges]:
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(_PICTURES, len(pairs))).astype(np.intp))
    out = []
    for pair in chosen.tolist():
        try:
            depth, colours = (images.read_image(file) for file in pairs[pair])
        except InputError:
            continue
        alike = depth.dtype == np.uint16 and depth.ndim == 2 and colours.shape[:2] == depth.shape
        if not alike or min(depth.shape) < _SMALLEST:
            continue
        grey = colours.astype(np.float32).mean(axis=2) if colours.ndim == 3 else colours
        smooth = scipy.ndimage.gaussian_filter(grey.astype(np.float32), 1.0)
        for axis in (0, 1):
            steepness = np.abs(np.gradient(smooth, axis=axis))
            out.append(_Edges(_leaps(depth / scale, K, axis), steepness))
    return [one for one in out if len(one.points)]


def _leaps(depth: Float, K: Float, axis: int) -> Float:
    """(n, 3) points half-way between pixels of which one is much nearer, as far as that one is."""
    apart = max(1, round(_APART * depth.shape[1]))
    last = depth.shape[axis] - apart
    here, there = (np.take(depth, range(n, n + last), axis) for n in (0, apart))
    known = (here > 0.0) & (there > 0.0)
    ratio = np.log(np.where(known, here, 1.0) / np.where(known, there, 1.0))
    pixels = np.argwhere(np.abs(ratio) > _LEAP)
    pixels = pixels[:: max(1, len(pixels) // _EDGES)]
    z = np.minimum(here, there)[tuple(pixels.T)]
    place = pixels.astype(np.float64)
    place[:, axis] += 0.5 * apart
    x = (place[:, 1] - K[0, 2]) / K[0, 0] * z
    return np.column_stack([x, (place[:, 0] - K[1, 2]) / K[1, 1] * z, z])


def _places(numbers: Float, points: Float) -> tuple[Float, Float]:
    """Columns and rows of points (n, 3) in a camera: two metres aside, focal length, centre."""
    tx, ty, f, cx, cy = numbers
    return (
        f * (points[:, 0] + tx) / points[:, 2] + cx,
        f * (points[:, 1] + ty) / points[:, 2] + cy,
    )


def _score(numbers: Float, edges: Sequence[_Edges]) -> float:
    """Mean steepness of the colours at the leaps of depth; between pixels, linear."""
    total, count = 0.0, 0
    for points, steepness in edges:
        column, row = _places(numbers, points)
        height, width = steepness.shape
        inside = (column >= 0.0) & (column < width - 1) & (row >= 0.0) & (row < height - 1)
        column, row = column[inside], row[inside]
        j, i = column.astype(np.intp), row.astype(np.intp)
        a, b = column - j, row - i
        upper = steepness[i, j] * (1.0 - a) + steepness[i, j + 1] * a
        lower = steepness[i + 1, j] * (1.0 - a) + steepness[i + 1, j + 1] * a
        total += float(np.sum(upper * (1.0 - b) + lower * b))
        count += len(j)
    return total / max(count, 1)


def _farthest(found: Float, usual: Float, edges: Sequence[_Edges]) -> float:
    """Pixels between the places of the edges in two cameras, of nine in ten."""
    points = np.concatenate([one.points for one in edges])
    (u, v), (u0, v0) = _places(found, points), _places(usual, points)
    return float(np.quantile(np.hypot(u - u0, v - v0), 0.9))
