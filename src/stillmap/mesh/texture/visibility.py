"""Faces of a mesh that are visible in an image.

Occlusion is tested against the z-buffer of an ideal (undistorted) image; the camera model decides
what lies within the image.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

import stillmap._core as _core
from stillmap.core.camera import Camera, project, unproject
from stillmap.mesh.texture.views import View
from stillmap.mesh.triangle_mesh import Mesh, cross_columns, dot_columns, normalize_columns
from stillmap.mesh.types import Bool, Float, Float32, Index, Int32

DEPTH_SCALE = 0.5  # pixels of the z-buffer per pixel of the image
NEAR = 0.05  # m ahead of a camera: nothing nearer is visible
IMAGE_MARGIN = 2.0  # pixels inside the image's border
_MIN_COSINE = 0.03  # of the angle between normal and line of sight
_MIN_AREA = 0.25  # square pixels of a face
_DEPTH_TOLERANCE = 0.01  # m by which a face may lie behind the z-buffer
_RELATIVE_TOLERANCE = 0.005  # m more per metre of distance
_SLOPE_TOLERANCE = 0.05  # m per metre of distance, at most, for slanted faces
_DILATION = 1  # pixels around a face in which much nearer depth occludes it: poses are inexact
_SAMPLE_SPACING = 8.0  # pixels of the z-buffer between samples of a large face
_CORNER_INSET = 0.2  # share of the way to the center by which samples at corners are pulled in
_SEARCH_MARGIN = 1.05  # times the field of view in which points are projected
_BORDER_SAMPLES = 33  # along each edge of an image, for its field of view
_MAX_SUBDIVISION = 32  # sample intervals along the edge of a large face


@dataclass(frozen=True, eq=False)
class DepthBuffer:
    """The z-buffer of a mesh in an ideal image of a view.

    Attributes:
        K: (3, 3) of that image, which may be smaller and wider than the recorded one.
        depth: (h, w) float32 metres ahead, inf: nothing.
        face: (h, w) int32, -1: nothing.
    """

    K: Float
    depth: Float32
    face: Int32


def scale_intrinsics(K: Float, scale: float) -> Float:
    """(3, 3) calibration of the same image with `scale` times the pixels along each edge.

    Pixel centers have whole numbers, so the image's border lies half a pixel beside them.
    """
    out = K.copy()
    out[:2] *= scale
    out[:2, 2] += 0.5 * scale - 0.5
    return out


def find_visible_faces(mesh: Mesh, view: View) -> Float32:
    """(F,) square pixels of the faces that an image shows whole, unoccluded and from in front.

    0 for all others.

    Args:
        mesh: V vertices, F faces.
        view: with a calibration that `calibration_error` accepts.
    """
    points = view.to_camera(mesh.vertices)
    uv, inside = _project_near(view, points)
    a, b, c = mesh.faces.T
    faces = np.flatnonzero(inside[a] & inside[b] & inside[c])
    columns = np.ascontiguousarray(points.T)
    # (3, 3, n) by corner and coordinate: long rows are fast
    corners = np.stack([columns[:, mesh.faces[faces, k]] for k in range(3)])
    pixels = _pixel_areas(uv, mesh.faces[faces])
    kept = (_view_cosines(corners) > _MIN_COSINE) & (pixels >= _MIN_AREA)
    faces, pixels, corners = faces[kept], pixels[kept], corners[..., kept]
    out = np.zeros(len(mesh), np.float32)
    if len(faces):
        used = np.zeros(len(points), np.bool_)
        used[mesh.faces[faces]] = True
        buffer = render_depth(mesh, view, points[used], DEPTH_SCALE)
        free = _is_unoccluded(buffer, corners)
        out[faces[free]] = pixels[free]
    return out


def render_depth(mesh: Mesh, view: View, shown: Float, scale: float) -> DepthBuffer:
    """The z-buffer of an ideal image that is just large enough.

    Args:
        mesh: V vertices, F faces.
        view: camera and pose.
        shown: (n, 3) metres in the camera's frame, in front of it: points to be in the image.
        scale: pixels along an edge, per pixel of the recorded image.
    """
    assert view.camera.K is not None
    K = scale_intrinsics(view.camera.K, scale)
    K[1, 0], K[2] = 0.0, (0.0, 0.0, 1.0)  # which may be anything in files
    at = np.column_stack(project_pinhole(K, shown.T))
    # wide lenses: 80 degrees off axis is six times as far out as 45 degrees
    most = 2.0 * scale * np.array([view.camera.width, view.camera.height])
    middle = K[:2, 2]
    low = np.floor(np.maximum(at.min(axis=0), middle - most)) - 2.0
    high = np.ceil(np.minimum(at.max(axis=0), middle + most)) + 2.0
    K[:2, 2] -= low
    width, height = (int(size) for size in np.maximum(high - low + 1.0, 1.0))
    near_by = _faces_in_frustum(mesh, view, K, width, height)
    depth, face = _core.render_z_buffer(
        np.ascontiguousarray(mesh.vertices),
        np.ascontiguousarray(mesh.faces[near_by]),
        K,
        np.ascontiguousarray(view.T_camera_map, np.float64),
        width,
        height,
        near=NEAR,
    )
    number = np.append(near_by, -1).astype(np.int32)
    return DepthBuffer(K, depth, number[face])


def _faces_in_frustum(mesh: Mesh, view: View, K: Float, width: int, height: int) -> Index:
    """Faces that are not beyond one border of an image, or behind it, with all their corners."""
    x, y, z = np.ascontiguousarray(view.to_camera(mesh.vertices).T)
    u, v = K[0, 0] * x + K[0, 1] * y + K[0, 2] * z, K[1, 1] * y + K[1, 2] * z
    # a pixel more: the kernel rounds otherwise at borders
    sides = (u < -z, v < -z, u > width * z, v > height * z, z < 0.0)
    beyond = np.zeros(len(z), np.uint8)
    for bit, side in enumerate(sides):
        beyond |= side.astype(np.uint8) << np.uint8(bit)
    a, b, c = mesh.faces.T
    return np.flatnonzero((beyond[a] & beyond[b] & beyond[c]) == 0)


def project_pinhole(K: Float, points: Float) -> tuple[Float, Float]:
    """(n,) columns and rows of points (3, n) in front of an ideal camera."""
    x, y = points[0] / points[2], points[1] / points[2]
    return K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]


def _project_near(view: View, points: Float) -> tuple[Float, Bool]:
    """(V, 2) pixels of points (V, 3) in the camera's frame, and whether they are in the image.

    NaN far outside of the field of view, where lens models do not hold.
    """
    uv, ok = np.full((len(points), 2), np.nan), np.zeros(len(points), np.bool_)
    x, y, z = points.T
    tangent = _SEARCH_MARGIN * _max_view_tangent(view.camera)
    near = np.flatnonzero((z > 0.0) & (x * x + y * y <= (tangent * z) ** 2))
    uv[near], ok[near] = project(view.camera, points[near])
    u, v = uv.T
    width, height = view.camera.width - 1.0 - IMAGE_MARGIN, view.camera.height - 1.0 - IMAGE_MARGIN
    with np.errstate(invalid="ignore"):  # NaN: not in the image
        ok &= (u >= IMAGE_MARGIN) & (u <= width) & (v >= IMAGE_MARGIN) & (v <= height)
    return uv, ok


def _max_view_tangent(camera: Camera) -> float:
    """Tangent of the widest angle between the optical axis and a ray; inf: unknown."""
    t = np.linspace(0.0, 1.0, _BORDER_SAMPLES)
    low, high = np.zeros_like(t), np.ones_like(t)
    u, v = np.concatenate([t, t, low, high]), np.concatenate([low, high, t, t])
    size = np.array([camera.width - 1.0, camera.height - 1.0])
    found = unproject(camera, np.column_stack([u, v]) * size)
    far = float(np.hypot(found[:, 0], found[:, 1]).max())
    return far if np.isfinite(far) else np.inf


def _view_cosines(corners: Float) -> Float32:
    """(n,) of the angle between normals and lines of sight, for corners (3, 3, n)."""
    normal, center = _face_normals(corners), corners.sum(axis=0) / 3.0
    dot, length = -dot_columns(center, normal), np.sqrt(dot_columns(center, center))
    return np.asarray(dot / np.where(length > 0.0, length, 1.0), np.float32)


def _face_normals(corners: Float) -> Float:
    """(3, n) unit vectors, zero for faces without area."""
    return normalize_columns(cross_columns(corners[1] - corners[0], corners[2] - corners[0]))


def _pixel_areas(uv: Float, faces: Int32) -> Float32:
    """(n,) square pixels of triangles (n, 3) over pixels (V, 2)."""
    u, v = (np.ascontiguousarray(column) for column in uv.T)
    a, b, c = faces.T
    au, av, bu, bv = u[b] - u[a], v[b] - v[a], u[c] - u[a], v[c] - v[a]
    return np.asarray(0.5 * np.abs(au * bv - av * bu), np.float32)


def _is_unoccluded(buffer: DepthBuffer, corners: Float) -> Bool:
    """(n,) whether nothing lies in front of triangles (3, 3, n) in the camera's frame."""
    free = np.ones(corners.shape[2], np.bool_)
    normal = _face_normals(corners)
    # (h, w) minimum depth within some pixels along rows and columns
    around = ndimage.minimum_filter(buffer.depth, 2 * _DILATION + 1, mode="nearest")
    for chosen, weights in _sample_faces(buffer, corners):
        left, of, normals = chosen, corners[..., chosen], normal[:, chosen]
        for weight in weights:
            point = weight[0] * of[0] + weight[1] * of[1] + weight[2] * of[2]
            passes = _passes_depth_test(buffer, around, point, normals)
            if not passes.all():
                free[left[~passes]] = False
                left, of, normals = left[passes], of[..., passes], normals[:, passes]
    return free


def _sample_faces(buffer: DepthBuffer, corners: Float) -> Iterator[tuple[Index, Float]]:
    """Faces by number, and the weights (k, 3) of their corners at their samples.

    Larger faces have more samples: `_SAMPLE_SPACING` pixels apart along the longest edge.
    """
    uv = [project_pinhole(buffer.K, corner) for corner in corners]
    edges = [np.hypot(uv[k][0] - uv[k - 1][0], uv[k][1] - uv[k - 1][1]) for k in range(3)]
    edge = np.maximum(np.maximum(edges[0], edges[1]), edges[2])
    halvings = np.ceil(np.log2(np.maximum(edge / _SAMPLE_SPACING, 1.0)))
    halvings = np.minimum(halvings, np.log2(_MAX_SUBDIVISION)).astype(np.intp)
    for times in np.flatnonzero(np.bincount(halvings)):
        n = 2**times
        i, j = (a.ravel() for a in np.mgrid[: n + 1, : n + 1])
        lattice = np.stack([i, j, n - i - j], axis=1)[i + j <= n] / n
        center = np.full((1, 3), 1.0 / 3.0)
        inset = lattice + _CORNER_INSET * (center - lattice)
        yield np.flatnonzero(halvings == times), np.concatenate([center, inset])


def _passes_depth_test(buffer: DepthBuffer, around: Float32, points: Float, normals: Float) -> Bool:
    """(n,) whether points (3, n) in the camera's frame are no farther than the depth at their
    pixel, and not much farther than that of the pixels around.

    Within its pixel a face may be nearer by the slope of depth along rows and columns.
    """
    h, w = around.shape
    u, v = (np.rint(a).astype(np.int64) for a in project_pinhole(buffer.K, points))
    inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
    at = np.clip(v, 0, h - 1) * w + np.clip(u, 0, w - 1)
    z = points[2]
    along = np.abs(dot_columns(normals, points)) / z
    slope = np.abs(normals[0]) / buffer.K[0, 0] + np.abs(normals[1]) / buffer.K[1, 1]
    rise = z * slope / np.maximum(along, 1e-6)
    allowed = _DEPTH_TOLERANCE + _RELATIVE_TOLERANCE * z
    here = allowed + np.minimum(0.5 * rise, _SLOPE_TOLERANCE * z)
    # neighboring faces may be steeper
    beside = allowed + np.minimum((2 * _DILATION + 1) * rise, 2.0 * _SLOPE_TOLERANCE * z)
    return np.asarray(
        inside & (z <= buffer.depth.ravel()[at] + here) & (z <= around.ravel()[at] + beside)
    )
