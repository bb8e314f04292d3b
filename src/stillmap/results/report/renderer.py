"""Render textured meshes with a z-buffer, unlit."""

import math

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.mesh.texture.atlas import TexturedMesh
from stillmap.mesh.texture.baking import sample_bilinear
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]
Picture = NDArray[np.uint8]

BACKGROUND = (236, 238, 241)
_SUPERSAMPLING = 2  # pixels along each edge that are averaged into one
_NEAR = 0.05  # m, near plane
_GREY_FACING, _GREY_GRAZING = 150.0, 70.0  # of faces without texture, by the viewing angle
_MARGIN = 1.05  # around fitted points
_BLOCK = 1 << 17  # pixels shaded at a time


def camera_matrix(size: tuple[int, int], field_of_view: float) -> Float:
    """K (3, 3) of a (width, height) image with a horizontal field of view in rad.

    Pixel centers have integer coordinates.
    """
    width, height = size
    f = 0.5 * width / math.tan(0.5 * field_of_view)
    return np.array([[f, 0.0, 0.5 * width - 0.5], [0.0, f, 0.5 * height - 0.5], [0.0, 0.0, 1.0]])


def render(
    textured: TexturedMesh,
    T_camera_map: Float,
    K: Float,
    size: tuple[int, int],
    *,
    back_faces: bool = True,
    threads: int = 1,
) -> Picture:
    """Render a model: its textures, shaded grey where it has none.

    Args:
        textured: the model.
        T_camera_map: (4, 4), x right, y down, z forward in the camera.
        K: (3, 3) camera matrix.
        size: width and height in pixels.
        back_faces: draw faces seen from behind as well; without them rooms have no ceiling.
        threads: the result does not depend on them.

    Returns:
        (height, width, 3) uint8.
    """
    width, height = (_SUPERSAMPLING * n for n in size)
    fine = K.copy()
    fine[:2] *= _SUPERSAMPLING
    fine[:2, 2] += 0.5 * _SUPERSAMPLING - 0.5
    drawn, T = _select_faces(textured, T_camera_map, back_faces), np.ascontiguousarray(T_camera_map)
    face = _rasterize(textured, drawn, T, fine, (width, height), threads)
    picture = np.empty((height * width, 3), np.float32)
    picture[:] = BACKGROUND
    seen = np.flatnonzero(face >= 0)
    planes, which = _edge_functions(textured, T, drawn, face.ravel()[seen])
    for first in range(0, len(seen), _BLOCK):
        at = slice(first, first + _BLOCK)
        row, column = np.divmod(seen[at], width)
        ids = drawn[face.ravel()[seen[at]]]
        rays = _pixel_rays(fine, column, row)
        picture[seen[at]] = _sample_colors(textured, ids, planes[which[at]], rays)
    parts = picture.reshape(size[1], _SUPERSAMPLING, size[0], _SUPERSAMPLING, 3)
    small: NDArray[np.float32] = parts.mean(axis=(1, 3))
    return np.rint(small).astype(np.uint8)


def visible_share(
    textured: TexturedMesh,
    T_camera_map: Float,
    K: Float,
    size: tuple[int, int],
    *,
    back_faces: bool = True,
    textured_only: bool = False,
    threads: int = 1,
) -> float:
    """Share of the pixels of the image that show the model, or its texture; see `render`."""
    drawn = _select_faces(textured, T_camera_map, back_faces)
    face = _rasterize(textured, drawn, T_camera_map, K, size, threads)
    shown = face >= 0
    if textured_only:
        shown[shown] = textured.page[drawn[face[shown]]] >= 0
    return float(shown.mean())


def _select_faces(
    textured: TexturedMesh, T_camera_map: Float, back_faces: bool
) -> NDArray[np.intp]:
    """Indices of the faces to draw: all, or those that face the camera."""
    if back_faces:
        return np.arange(len(textured))
    mesh = Mesh(textured.vertices, textured.faces)
    eye = -T_camera_map[:3, :3].T @ T_camera_map[:3, 3]
    return np.flatnonzero(np.einsum("ij,ij->i", eye - mesh.centers, mesh.normals()) > 0.0)


def _rasterize(
    textured: TexturedMesh,
    drawn: NDArray[np.intp],
    T_camera_map: Float,
    K: Float,
    size: tuple[int, int],
    threads: int,
) -> NDArray[np.int32]:
    """(height, width) index into `drawn` of the face in each pixel; -1: none."""
    vertices, T = np.ascontiguousarray(textured.vertices), np.ascontiguousarray(T_camera_map)
    faces = np.ascontiguousarray(textured.faces[drawn])
    _, face = _core.render_z_buffer(vertices, faces, K, T, *size, near=_NEAR, threads=threads)
    return face


def _pixel_rays(K: Float, column: NDArray[np.intp], row: NDArray[np.intp]) -> Float:
    """(n, 3) rays through pixel centers, z = 1."""
    y = (row - K[1, 2]) / K[1, 1]
    x = (column - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y, np.ones(len(x))], axis=1)


def _edge_functions(
    textured: TexturedMesh, T: Float, drawn: NDArray[np.intp], seen: NDArray[np.int32]
) -> tuple[Float, NDArray[np.intp]]:
    """Edge functions (k, 3, 3) of the visible faces, and (n,) the row for each pixel.

    The products of a ray with b x c, c x a and a x b are proportional to the barycentric
    coordinates of its intersection with the face a, b, c.

    Args:
        textured: the model.
        T: (4, 4) T_camera_map.
        drawn: (F',) faces that were drawn.
        seen: (n,) index into `drawn` for each pixel.
    """
    used = np.zeros(len(drawn), np.bool_)
    used[seen] = True
    number = np.cumsum(used) - 1
    corners = textured.vertices[textured.faces[drawn[used]]] @ T[:3, :3].T + T[:3, 3]
    a, b, c = (corners[:, k] for k in range(3))
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1), number[seen]


def _sample_colors(
    textured: TexturedMesh, faces: NDArray[np.intp], planes: Float, rays: Float
) -> NDArray[np.float32]:
    """(n, 3) colors at the intersections of rays with their faces.

    Args:
        textured: the model.
        faces: (n,).
        planes: (n, 3, 3), see `_edge_functions`.
        rays: (n, 3) in the camera frame.
    """
    products = np.matmul(planes, rays[:, :, None])[..., 0]
    total = products.sum(axis=1, keepdims=True)
    weights = np.clip(products / np.where(total == 0.0, 1.0, total), 0.0, 1.0)
    page, colors = textured.page[faces], np.empty((len(faces), 3), np.float32)
    bare = np.flatnonzero(page < 0)
    colors[bare] = _shade_grey(planes[bare].sum(axis=1), rays[bare])
    for number, texture in enumerate(textured.pages):
        on = np.flatnonzero(page == number)
        if len(on):
            corners = textured.uv[textured.faces[faces[on]]]
            uv = np.matmul(weights[on, None, :], corners)[:, 0]
            colors[on] = sample_bilinear(texture, uv * texture.shape[1::-1] - 0.5)
    return colors


def _shade_grey(normals: Float, rays: Float) -> NDArray[np.float32]:
    """(n, 3) grey of faces with normals (n, 3) of any length, darker at grazing angles."""
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", normals, rays)) / np.where(lengths == 0.0, 1.0, lengths)
    grey = _GREY_GRAZING + (_GREY_FACING - _GREY_GRAZING) * cosine
    return np.repeat(grey[:, None], 3, axis=1).astype(np.float32)


def fit_camera(points: Float, direction: Float, K: Float, size: tuple[int, int]) -> Float:
    """T_camera_map (4, 4) of the closest camera whose image contains all points (n, 3), centered.

    In camera axes, with s the slope of the edge of the field of view, a point (x, y, z) is inside
    the right edge of a camera at e if x - e_x <= s (z - e_z), and inside the left edge if
    e_x - x <= s (z - e_z). The extreme points of both conditions bound e_z; likewise for y.

    Args:
        points: m.
        direction: (3,) from the points towards the camera.
        K: (3, 3) camera matrix.
        size: width and height in pixels.
    """
    T = look_at(direction, np.zeros(3))
    local = points @ T[:3, :3].T
    slopes = 0.5 * np.array(size) / np.array([K[0, 0], K[1, 1]]) / _MARGIN
    right = (local[:, :2] - slopes * local[:, 2:]).max(axis=0)
    left = (-local[:, :2] - slopes * local[:, 2:]).max(axis=0)
    z = min(float((-(left + right) / (2.0 * slopes)).min()), local[:, 2].min() - 2.0 * _NEAR)
    eye = T[:3, :3].T @ np.array([*(0.5 * (right - left)), z])
    return look_at(eye, eye - direction)


def main_corners(textured: TexturedMesh, direction: Float, share: float) -> Float:
    """Corners (n, 3) of the faces visible from `direction` (3,), without outlying ones.

    In that view a share of the visible area is cut off at each end of the three axes, so that
    distant islands do not count. All corners where no face is visible.
    """
    mesh, towards = Mesh(textured.vertices, textured.faces), direction / np.linalg.norm(direction)
    area = mesh.areas() * np.maximum(mesh.normals() @ towards, 0.0)
    if not area.any():
        return mesh.corners.reshape(-1, 3)
    kept = area > 0.0
    for place in (mesh.centers @ look_at(direction, np.zeros(3))[:3, :3].T).T:
        order = np.argsort(place, kind="stable")
        below = (np.cumsum(area[order]) - 0.5 * area[order]) / area.sum()
        first, last = np.searchsorted(below, [share, 1.0 - share])
        kept &= (place >= place[order[first]]) & (place <= place[order[max(last - 1, 0)]])
    return mesh.corners[kept if kept.any() else area > 0.0].reshape(-1, 3)


def look_at(eye: Float, target: Float) -> Float:
    """T_camera_map (4, 4) of a camera at `eye` (3,) that looks at `target` (3,).

    Up in the image is z of the map, or y for a camera that looks straight down.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = right, np.cross(forward, right), forward
    T[:3, 3] = -T[:3, :3] @ eye
    return T
