"""Faces of a mesh that are visible in an image, and what movers hide of it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Index, Int32
from stillmap.core.camera import project
from stillmap.mesh.inputs import OUTLINE_MARGIN
from stillmap.mesh.triangle_mesh import Mesh, dot_columns, planar_areas, row_lengths
from stillmap.mesh.views import View

DEPTH_SCALE = 0.5  # pixels of the z-buffer per pixel of the image
NEAR = 0.05  # m ahead of a camera: nothing nearer is visible
_IMAGE_MARGIN = 2.0  # pixels inside the image's border
_MIN_COSINE = 0.03  # of the angle between normal and line of sight
_MIN_AREA = 0.25  # square pixels of a face
_DEPTH_TOLERANCE = 0.01  # m by which a face may lie behind the z-buffer
_RELATIVE_TOLERANCE = 0.005  # m more per metre of distance
_SLOPE_TOLERANCE = 0.05  # m per metre of distance, at most, for slanted faces
_DILATION = 1  # pixels around a face in which much nearer depth occludes it: poses are inexact

# ninths, weights of the corners at the samples of a face: center, near corners, near edges' middles
_NINTHS = (3, 3, 3), (7, 1, 1), (1, 7, 1), (1, 1, 7), (4, 4, 1), (1, 4, 4), (4, 1, 4)
_SAMPLES = np.array(_NINTHS, np.float64) / 9.0


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
    uv, inside = project_inside(view, points)
    a, b, c = mesh.faces.T
    faces = np.flatnonzero(inside[a] & inside[b] & inside[c])
    local = Mesh(points, mesh.faces[faces])
    pixels, normals, centers = planar_areas(uv[local.faces]), local.normals(), local.centers
    cosine = -np.einsum("ni,ni->n", normals, centers) / row_lengths(centers)
    kept = (cosine > _MIN_COSINE) & (pixels >= _MIN_AREA)
    faces, pixels, normals = faces[kept], pixels[kept], normals[kept]
    out = np.zeros(len(mesh), np.float32)
    if len(faces):
        used = np.zeros(len(points), np.bool_)
        used[mesh.faces[faces]] = True
        buffer = render_depth(mesh, view, points[used], DEPTH_SCALE)
        free = _is_unoccluded(buffer, points[mesh.faces[faces]], normals)
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
    vertices, faces = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces)
    T = np.ascontiguousarray(view.T_camera_map, np.float64)
    depth, face = _core.render_z_buffer(vertices, faces, K, T, width, height, near=NEAR)
    return DepthBuffer(K, depth, face)


def project_pinhole(K: Float, points: Float) -> tuple[Float, Float]:
    """(n,) columns and rows of points (3, n) in front of an ideal camera."""
    x, y = points[0] / points[2], points[1] / points[2]
    return K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]


def project_inside(view: View, points: Float) -> tuple[Float, Bool]:
    """(V, 2) pixels of points (V, 3) in the camera's frame, and whether they are in the image."""
    uv, ok = project(view.camera, points)
    size = np.array([view.camera.width, view.camera.height])
    with np.errstate(invalid="ignore"):  # NaN: not in the image
        ok &= ((uv >= _IMAGE_MARGIN) & (uv <= size - 1.0 - _IMAGE_MARGIN)).all(axis=1)
    return uv, ok


def _is_unoccluded(buffer: DepthBuffer, corners: Float, normals: Float) -> Bool:
    """(n,) whether nothing lies in front of triangles (n, 3, 3) in the camera's frame."""
    free = np.ones(len(corners), np.bool_)
    # (h, w) minimum depth within some pixels along rows and columns
    around = ndimage.minimum_filter(buffer.depth, 2 * _DILATION + 1, mode="nearest")
    for weight in _SAMPLES:
        points = np.einsum("k,nki->in", weight, corners[free])
        free[free] = _passes_depth_test(buffer, around, points, normals[free].T)
    return free


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
    passes = (z <= buffer.depth.ravel()[at] + here) & (z <= around.ravel()[at] + beside)
    return np.asarray(inside & passes)


_COLUMNS = 80  # cells over the width of an image
_BEAM_DIVERGENCE = 0.01  # m per metre by which the footprint of a return grows
_SUPPORT_SIGMA = 1.5  # cells over which a static return supports its neighbors
_MIN_DEPTH = 0.05  # m from the camera: nearer returns are the camera itself
_MAX_RADIUS = 12  # cells by which a return is dilated


class OcclusionMask(NamedTuple):
    """Depth map of movers in an image, on a grid of h by w cells.

    Attributes:
        cell: pixels, edge of a cell.
        depth: (h, w) metres ahead of the camera, nearest dynamic return; inf: none.
        dynamic: (h, w) its P(dynamic).
        support: (h, w) approximate number of static returns.
    """

    cell: float
    depth: Float
    dynamic: Float
    support: Float

    def p_unoccluded(self, uv: Float, depth: Float, prior: Float) -> Float:
        """(n,) probability that the image shows static surface at each point.

        Static returns raise the prior: each shows that no mover is in front. A dynamic return in
        front limits it to 1 - P(dynamic).

        Args:
            uv: (n, 2) pixels within the image.
            depth: (n,) metres ahead of the camera.
            prior: (n,) probability where no return tells.
        """
        h, w = self.depth.shape
        column = np.clip((uv[:, 0] / self.cell).astype(np.intp), 0, w - 1)
        row = np.clip((uv[:, 1] / self.cell).astype(np.intp), 0, h - 1)
        static = 1.0 - (1.0 - prior) * np.exp(-self.support[row, column])
        hidden = self.depth[row, column] < depth + OUTLINE_MARGIN
        return np.where(hidden, np.minimum(static, 1.0 - self.dynamic[row, column]), static)


def build_occlusion_mask(view: View, points: Float, p_static: Float32) -> OcclusionMask:
    """The occlusion mask of an image from the returns near its timestamp.

    Args:
        view: the image.
        points: (n, 3) metres in the map frame, motion-compensated returns.
        p_static: (n,) their P(c = 1); those below one half occlude.
    """
    camera = view.camera
    assert camera.K is not None
    size = camera.width / _COLUMNS
    shape = max(round(camera.height / size), 1), _COLUMNS
    local = view.to_camera(points)
    uv, ok = project(camera, local)
    ok &= local[:, 2] > _MIN_DEPTH
    ok[ok] = ((uv[ok] >= 0.0) & (uv[ok] < size * np.array(shape[::-1]))).all(axis=1)
    column, row = np.floor(uv[ok] / size).astype(np.intp).T
    away, p_dynamic = local[ok, 2], 1.0 - p_static[ok]
    static = p_dynamic <= 0.5
    support = np.zeros(shape)
    np.add.at(support, (row[static], column[static]), 2.0 * np.pi * _SUPPORT_SIGMA**2)
    support = ndimage.gaussian_filter(support, _SUPPORT_SIGMA, mode="constant")
    movers = np.flatnonzero(~static)
    movers = movers[np.argsort(away[movers], kind="stable")]
    row, column, away, p_dynamic = row[movers], column[movers], away[movers], p_dynamic[movers]
    radius = (OUTLINE_MARGIN / away + _BEAM_DIVERGENCE) * (float(camera.K[0, 0]) / size)
    nearest = _nearest_discs(row, column, np.ceil(np.minimum(radius, _MAX_RADIUS) - 0.5), shape)
    depth, dynamic = np.append(away, np.inf)[nearest], np.append(p_dynamic, 0.0)[nearest]
    return OcclusionMask(size, depth, dynamic, support)


def _nearest_discs(row: Index, column: Index, radius: Float, shape: tuple[int, int]) -> Index:
    """(h, w) the first of n discs, with a radius in cells, that covers a cell; n: none."""
    nearest = np.full(shape, len(row))
    steps = np.arange(-_MAX_RADIUS, _MAX_RADIUS + 1)
    square = steps[:, None] ** 2 + steps**2
    for r in np.unique(radius).tolist():
        some = np.flatnonzero(radius == r)[::-1]  # the first is written last
        centers = np.full(shape, len(row))
        centers[row[some], column[some]] = some
        disc = square <= (r + 0.5) ** 2
        covered = ndimage.minimum_filter(centers, footprint=disc, mode="constant", cval=len(row))
        nearest = np.minimum(nearest, covered)
    return nearest
