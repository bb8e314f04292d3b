"""Which faces of a mesh a picture shows, and how well.

What hides what is decided in an ideal picture, without distortion, by its z-buffer; what lies
within the picture's edges is decided by the lens.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.camera import Camera, project, unproject
from stillmap.mesh.options import VisibleOptions
from stillmap.mesh.texture.views import View
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_ASIDE = 1.05  # times what a picture shows at its border, in which faces are looked for
_BORDER = 33  # places along each edge of a picture that are asked how far aside they look
_FINEST = 32  # parts that the edge of a large face is cut into, to look at each


class VisibleFaces(NamedTuple):
    """What one picture shows of F faces.

    Attributes:
        seen: (F,) whether all of a face is in the picture, from its front, nothing before it.
        pixels: (F,) float32, its area in the picture as it was recorded; 0 where not seen.
        cosine: (F,) float32, of the angle between its normal and the line of sight to its centre;
            below 0 from behind; 0 where it is not all in the picture.
    """

    visible: Mask
    pixels: Float32
    cosine: Float32


@dataclass(frozen=True, eq=False)
class DepthBuffer:
    """The z-buffer of a mesh in an ideal picture of a view.

    Attributes:
        K: (3, 3) of that picture, which may be smaller and wider than the recorded one.
        depth: (h, w) float32 metres ahead, inf: nothing.
        face: (h, w) int32, -1: nothing.
    """

    K: Float
    depth: Float32
    face: NDArray[np.int32]


def scale_intrinsics(K: Float, scale: float) -> Float:
    """(3, 3) of the same picture with `scale` times the pixels along each edge.

    Centres of pixels have whole numbers, so that edges lie half a pixel beside them.
    """
    out = K.copy()
    out[:2] *= scale
    out[:2, 2] += 0.5 * scale - 0.5
    return out


def find_visible_faces(
    mesh: Mesh, view: View, options: VisibleOptions | None = None, threads: int = 1
) -> VisibleFaces:
    """Which faces a picture shows whole.

    Args:
        mesh: what stands there.
        view: of a lens of which `lens.unusable` says nothing.
        options: see VisibleOptions.
        threads: the result does not depend on them.
    """
    options = options or VisibleOptions()
    points = view.to_camera(mesh.vertices)
    uv, inside = _in_picture(view, points, options.margin)
    a, b, c = mesh.faces.T
    candidates = np.flatnonzero(inside[a] & inside[b] & inside[c])
    corners = _corners(points, mesh.faces[candidates])
    cosine = np.zeros(len(mesh), np.float32)
    cosine[candidates] = facing = _cosines(corners)
    pixels = _areas(uv, mesh.faces[candidates])
    kept = (facing > options.cosine) & (pixels >= options.pixels)
    candidates, pixels, corners = candidates[kept], pixels[kept], corners[..., kept]
    seen, area = np.zeros(len(mesh), np.bool_), np.zeros(len(mesh), np.float32)
    if len(candidates):
        used = np.zeros(len(points), np.bool_)
        used[mesh.faces[candidates]] = True
        depths = render_depth(mesh, view, points[used], options.scale, options.near, threads)
        free = _unhidden(depths, corners, options)
        seen[candidates[free]], area[candidates[free]] = True, pixels[free]
    return VisibleFaces(seen, area, cosine)


def _corners(points: Float, faces: NDArray[np.int32]) -> Float:
    """(3, 3, n) the corners of faces (n, 3), by corner and coordinate: long rows are fast."""
    columns = np.ascontiguousarray(points.T)
    return np.stack([columns[:, faces[:, k]] for k in range(3)])


def render_depth(
    mesh: Mesh, view: View, shown: Float, scale: float, near: float, threads: int = 1
) -> DepthBuffer:
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
    K = scale_intrinsics(_upright(view.camera.K), scale)
    at = np.column_stack(project_pinhole(K, shown.T))
    # wide lenses: what is 80 degrees aside is six times as far out as what is 45 degrees aside
    most = 2.0 * scale * np.array([view.camera.width, view.camera.height])
    middle = K[:2, 2]
    low = np.floor(np.maximum(at.min(axis=0), middle - most)) - 2.0
    high = np.ceil(np.minimum(at.max(axis=0), middle + most)) + 2.0
    K[:2, 2] -= low
    width, height = (int(size) for size in np.maximum(high - low + 1.0, 1.0))
    near_by = _within_frustum(mesh, view, K, width, height)
    depth, face = _core.render_z_buffer(
        np.ascontiguousarray(mesh.vertices),
        np.ascontiguousarray(mesh.faces[near_by]),
        K,
        np.ascontiguousarray(view.T_camera_map, np.float64),
        width,
        height,
        near=near,
        threads=threads,
    )
    number = np.append(near_by, -1).astype(np.int32)
    return DepthBuffer(K, depth, number[face])


def _within_frustum(mesh: Mesh, view: View, K: Float, width: int, height: int) -> Index:
    """The faces that are not beyond one edge of a picture, or behind it, with all their corners."""
    x, y, z = np.ascontiguousarray(view.to_camera(mesh.vertices).T)
    u, v = K[0, 0] * x + K[0, 1] * y + K[0, 2] * z, K[1, 1] * y + K[1, 2] * z
    # a pixel more: edges are met exactly elsewhere
    sides = (u < -z, v < -z, u > width * z, v > height * z, z < 0.0)
    beyond = np.zeros(len(z), np.uint8)
    for bit, side in enumerate(sides):
        beyond |= side.astype(np.uint8) << np.uint8(bit)
    a, b, c = mesh.faces.T
    return np.flatnonzero((beyond[a] & beyond[b] & beyond[c]) == 0)


def _upright(K: Float) -> Float:
    """The calibration as the z-buffer takes it: its third row may be anything in files."""
    return np.array([[K[0, 0], K[0, 1], K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]])


def project_pinhole(K: Float, points: Float) -> tuple[Float, Float]:
    """(n,) columns and rows of points (3, n) ahead of an ideal camera."""
    x, y = points[0] / points[2], points[1] / points[2]
    return K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]


def _in_picture(view: View, points: Float, margin: float) -> tuple[Float, Mask]:
    """(V, 2) pixels of points (V, 3) in the camera's frame, and whether they are in the picture.

    NaN where they are far from it.
    """
    uv, ok = np.full((len(points), 2), np.nan), np.zeros(len(points), np.bool_)
    x, y, z = points.T
    near = np.flatnonzero((z > 0.0) & (x * x + y * y <= (_ASIDE * _reach(view.camera) * z) ** 2))
    uv[near], ok[near] = project(view.camera, points[near])
    u, v = uv.T
    width, height = view.camera.width - 1.0 - margin, view.camera.height - 1.0 - margin
    with np.errstate(invalid="ignore"):  # NaN: nowhere
        return uv, ok & (u >= margin) & (u <= width) & (v >= margin) & (v <= height)


def _reach(camera: Camera) -> float:
    """How far aside its pictures show things, per metre ahead; inf: it is not known."""
    t = np.linspace(0.0, 1.0, _BORDER)
    low, high = np.zeros_like(t), np.ones_like(t)
    u, v = np.concatenate([t, t, low, high]), np.concatenate([low, high, t, t])
    size = np.array([camera.width - 1.0, camera.height - 1.0])
    found = unproject(camera, np.column_stack([u, v]) * size)
    far = float(np.hypot(found[:, 0], found[:, 1]).max())
    return far if np.isfinite(far) else np.inf


def _cosines(corners: Float) -> Float32:
    """(n,) of the angle between normals and lines of sight, for corners (3, 3, n)."""
    normal, centre = _normals(corners), corners.sum(axis=0) / 3.0
    dot, length = -_dot(centre, normal), np.sqrt(_dot(centre, centre))
    return np.asarray(dot / np.where(length > 0.0, length, 1.0), np.float32)


def _normals(corners: Float) -> Float:
    """(3, n) of length one, zero for faces without area."""
    a, b = corners[1] - corners[0], corners[2] - corners[0]
    normal = np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
    length = np.sqrt(_dot(normal, normal))
    return np.asarray(normal / np.where(length > 0.0, length, 1.0))


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _areas(uv: Float, faces: NDArray[np.int32]) -> Float32:
    """(n,) square pixels of triangles (n, 3) over pixels (V, 2)."""
    u, v = (np.ascontiguousarray(column) for column in uv.T)
    a, b, c = faces.T
    au, av, bu, bv = u[b] - u[a], v[b] - v[a], u[c] - u[a], v[c] - v[a]
    return np.asarray(0.5 * np.abs(au * bv - av * bu), np.float32)


def _unhidden(depths: DepthBuffer, corners: Float, options: VisibleOptions) -> Mask:
    """(n,) whether nothing lies before triangles (3, 3, n) in the camera's frame."""
    free = np.ones(corners.shape[2], np.bool_)
    normal = _normals(corners)
    around = _nearest_around(depths.depth, options.beside)
    for chosen, weights in _samples(depths, corners, options):
        left, of, normals = chosen, corners[..., chosen], normal[:, chosen]
        for weight in weights:
            point = weight[0] * of[0] + weight[1] * of[1] + weight[2] * of[2]
            passes = _passes(depths, around, point, normals, options)
            if not passes.all():
                free[left[~passes]] = False
                left, of, normals = left[passes], of[..., passes], normals[:, passes]
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
    depths: DepthBuffer, corners: Float, options: VisibleOptions
) -> Iterator[tuple[Index, Float]]:
    """Faces by number, and the weights (k, 3) of their corners at the points to look at.

    The finer, the larger they are: `options.spacing` pixels apart along the longest edge.
    """
    uv = [project_pinhole(depths.K, corner) for corner in corners]
    edges = [np.hypot(uv[k][0] - uv[k - 1][0], uv[k][1] - uv[k - 1][1]) for k in range(3)]
    edge = np.maximum(np.maximum(edges[0], edges[1]), edges[2])
    halvings = np.ceil(np.log2(np.maximum(edge / options.spacing, 1.0)))
    halvings = np.minimum(halvings, np.log2(_FINEST)).astype(np.intp)
    for times in np.flatnonzero(np.bincount(halvings)):
        n = 2**times
        i, j = (a.ravel() for a in np.mgrid[: n + 1, : n + 1])
        lattice = np.stack([i, j, n - i - j], axis=1)[i + j <= n] / n
        middle = np.full((1, 3), 1.0 / 3.0)
        inwards = lattice + options.inwards * (middle - lattice)
        yield np.flatnonzero(halvings == times), np.concatenate([middle, inwards])


def _passes(
    depths: DepthBuffer, around: Float32, points: Float, normals: Float, options: VisibleOptions
) -> Mask:
    """(n,) whether points (3, n) in the camera's frame are no farther than what is seen there,
    and not much farther than what is seen beside.

    Within its pixel a face may be nearer by the slope of depth along rows and columns.
    """
    h, w = around.shape
    u, v = (np.rint(a).astype(np.int64) for a in project_pinhole(depths.K, points))
    inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
    at = np.clip(v, 0, h - 1) * w + np.clip(u, 0, w - 1)
    z = points[2]
    along = np.abs(_dot(normals, points)) / z
    slope = np.abs(normals[0]) / depths.K[0, 0] + np.abs(normals[1]) / depths.K[1, 1]
    rise = z * slope / np.maximum(along, 1e-6)
    allowed = options.tolerance + options.relative * z
    here = allowed + np.minimum(0.5 * rise, options.steepest * z)
    # neighbouring faces may be steeper
    beside = allowed + np.minimum((2 * options.beside + 1) * rise, 2.0 * options.steepest * z)
    return np.asarray(
        inside & (z <= depths.depth.ravel()[at] + here) & (z <= around.ravel()[at] + beside)
    )
