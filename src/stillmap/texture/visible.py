"""Which faces of a mesh a picture shows, and how well.

What hides what is decided in an ideal picture, without distortion, by its z-buffer; what lies
within the picture's edges is decided by the lens.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.surface.mesh import Mesh
from stillmap.texture import lens
from stillmap.texture.options import VisibleOptions
from stillmap.texture.view import View

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_FINEST = 32  # parts that the edge of a large face is cut into, to look at each


class Seen(NamedTuple):
    """What one picture shows of F faces.

    Attributes:
        seen: (F,) whether all of a face is in the picture, from its front, nothing before it.
        pixels: (F,) float32, its area in the picture as it was recorded; 0 where not seen.
        cosine: (F,) float32, of the angle between its normal and the line of sight to its centre;
            below 0 from behind.
    """

    seen: Mask
    pixels: Float32
    cosine: Float32


@dataclass(frozen=True, eq=False)
class Depths:
    """The z-buffer of a mesh in an ideal picture of a view.

    Attributes:
        K: (3, 3) of that picture, which may be smaller and wider than the recorded one.
        depth: (h, w) float32 metres ahead, inf: nothing.
        face: (h, w) int32, -1: nothing.
    """

    K: Float
    depth: Float32
    face: NDArray[np.int32]


def scaled(K: Float, scale: float) -> Float:
    """(3, 3) of the same picture with `scale` times the pixels along each edge.

    Centres of pixels have whole numbers, so that edges lie half a pixel beside them.
    """
    out = K.copy()
    out[:2] *= scale
    out[:2, 2] += 0.5 * scale - 0.5
    return out


def visible(
    mesh: Mesh, view: View, options: VisibleOptions | None = None, threads: int = 1
) -> Seen:
    """Which faces a picture shows whole.

    Args:
        mesh: what stands there.
        view: of a lens of which `lens.unusable` says nothing.
        options: see VisibleOptions.
        threads: the result does not depend on them.
    """
    options = options or VisibleOptions()
    points = view.in_camera(mesh.vertices)
    uv, inside = _in_picture(view, points, options.margin)
    cosine = _cosines(mesh, view)
    faces = mesh.faces
    candidates = np.flatnonzero((cosine > options.cosine) & inside[faces].all(axis=1))
    pixels = _areas(uv[faces[candidates]])
    kept = pixels >= options.pixels
    candidates, pixels = candidates[kept], pixels[kept]
    seen, area = np.zeros(len(mesh), np.bool_), np.zeros(len(mesh), np.float32)
    if len(candidates):
        used = np.unique(faces[candidates])
        depths = depths_of(mesh, view, points[used], options.scale, options.near, threads)
        free = _unhidden(depths, points[faces[candidates]], options)
        seen[candidates[free]], area[candidates[free]] = True, pixels[free]
    return Seen(seen, area, cosine.astype(np.float32))


def depths_of(
    mesh: Mesh, view: View, shown: Float, scale: float, near: float, threads: int = 1
) -> Depths:
    """The z-buffer in an ideal picture that is just large enough.

    Args:
        mesh: V vertices, F faces.
        view: where from.
        shown: (n, 3) metres in the camera's frame, ahead of it: what the picture has to hold.
        scale: pixels along an edge, per pixel of the recorded picture.
        near: metres ahead, nothing before is seen.
        threads: the result does not depend on them.
    """
    assert view.camera.K is not None
    K = scaled(_upright(view.camera.K), scale)
    at = _ideal(K, shown)
    # wide lenses: what is 80 degrees aside is six times as far out as what is 45 degrees aside
    most = 2.0 * scale * np.array([view.camera.width, view.camera.height])
    middle = K[:2, 2]
    low = np.floor(np.maximum(at.min(axis=0), middle - most)) - 2.0
    high = np.ceil(np.minimum(at.max(axis=0), middle + most)) + 2.0
    K[:2, 2] -= low
    width, height = (int(size) for size in np.maximum(high - low + 1.0, 1.0))
    depth, face = _core.z_buffer(
        np.ascontiguousarray(mesh.vertices),
        np.ascontiguousarray(mesh.faces),
        K,
        np.ascontiguousarray(view.T_camera_map, np.float64),
        width,
        height,
        near=near,
        threads=threads,
    )
    return Depths(K, depth, face)


def _upright(K: Float) -> Float:
    """The calibration as the z-buffer takes it: its third row may be anything in files."""
    return np.array([[K[0, 0], K[0, 1], K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]])


def _ideal(K: Float, points: Float) -> Float:
    """(n, 2) pixels of points (n, 3) ahead of an ideal camera."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    return np.column_stack([K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]])


def _in_picture(view: View, points: Float, margin: float) -> tuple[Float, Mask]:
    """(V, 2) pixels of points (V, 3) in the camera's frame, and whether they are in the picture."""
    uv, ok = lens.project(view.camera, points)
    size = np.array([view.camera.width, view.camera.height])
    with np.errstate(invalid="ignore"):  # NaN: nowhere
        ok = ok & ((uv >= margin) & (uv <= size - 1.0 - margin)).all(axis=1)
    return uv, ok


def _cosines(mesh: Mesh, view: View) -> Float:
    towards = view.place - mesh.centres
    length = np.linalg.norm(towards, axis=1)
    dot = np.einsum("ij,ij->i", towards, mesh.normals())
    return np.asarray(dot / np.where(length > 0.0, length, 1.0))


def _areas(uv: Float) -> Float32:
    """(n,) square pixels of triangles (n, 3, 2)."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return (0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])).astype(np.float32)


def _unhidden(depths: Depths, corners: Float, options: VisibleOptions) -> Mask:
    """(n,) whether nothing lies before triangles (n, 3, 3) in the camera's frame."""
    free = np.ones(len(corners), np.bool_)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0.0, length, 1.0)
    around = _nearest_around(depths.depth, options.beside)
    for chosen, weights in _samples(depths, corners, options):
        for weight in weights:
            left = chosen[free[chosen]]
            point = np.einsum("j,ijk->ik", weight, corners[left])
            free[left] = _passes(depths, around, point, normal[left], options)
    return free


def _nearest_around(depth: Float32, reach: int) -> Float32:
    """(h, w) least depth within `reach` pixels along rows and columns."""
    for axis in (0, 1):
        padded = np.pad(
            depth, [(reach, reach) if a == axis else (0, 0) for a in (0, 1)], mode="edge"
        )
        size = depth.shape[axis]
        parts = [np.take(padded, range(k, k + size), axis) for k in range(2 * reach + 1)]
        depth = np.minimum.reduce(parts)
    return depth


def _samples(
    depths: Depths, corners: Float, options: VisibleOptions
) -> Iterator[tuple[Index, Float]]:
    """Faces by number, and the weights (k, 3) of their corners at the points to look at.

    The finer, the larger they are: `options.spacing` pixels apart along the longest edge.
    """
    uv = _ideal(depths.K, corners.reshape(-1, 3)).reshape(-1, 3, 2)
    edge = np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=2).max(axis=1)
    parts = np.ceil(np.log2(np.maximum(edge / options.spacing, 1.0)))
    parts = 2 ** np.minimum(parts, np.log2(_FINEST)).astype(np.int64)
    for n in np.unique(parts):
        i, j = (a.ravel() for a in np.mgrid[: n + 1, : n + 1])
        lattice = np.stack([i, j, n - i - j], axis=1)[i + j <= n] / n
        middle = np.full((1, 3), 1.0 / 3.0)
        inwards = lattice + options.inwards * (middle - lattice)
        yield np.flatnonzero(parts == n), np.concatenate([middle, inwards])


def _passes(
    depths: Depths, around: Float32, points: Float, normals: Float, options: VisibleOptions
) -> Mask:
    """(n,) whether points (n, 3) in the camera's frame are no farther than what is seen there,
    and not much farther than what is seen beside.

    Within its pixel a face may be nearer by the slope of depth along rows and columns.
    """
    h, w = around.shape
    at = np.rint(_ideal(depths.K, points)).astype(np.int64)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < w) & (at[:, 1] < h)
    column, row = np.clip(at[:, 0], 0, w - 1), np.clip(at[:, 1], 0, h - 1)
    z = points[:, 2]
    along = np.abs(np.einsum("ij,ij->i", normals, points / z[:, None]))
    slope = np.abs(normals[:, 0]) / depths.K[0, 0] + np.abs(normals[:, 1]) / depths.K[1, 1]
    rise = z * slope / np.maximum(along, 1e-6)
    allowed = options.tolerance + options.relative * z
    here = allowed + np.minimum(0.5 * rise, options.steepest * z)
    # neighbouring faces may be steeper
    beside = allowed + np.minimum((2 * options.beside + 1) * rise, 2.0 * options.steepest * z)
    return np.asarray(
        inside & (z <= depths.depth[row, column] + here) & (z <= around[row, column] + beside)
    )
