"""Pictures of a textured model, by its z-buffer: what the report shows of it."""

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
_FINER = 2  # pixels along an edge that are drawn for one that is shown: textures are finer still
_NEAR = 0.05  # m
_GREY = 150.0  # of faces without a picture, seen straight
_SLANTED = 70.0  # their grey seen along them: edges show
_MARGIN = 1.05
_BLOCK = 1 << 17  # pixels that are painted together


def camera_matrix(size: tuple[int, int], field_of_view: float) -> Float:
    """(3, 3) of a picture of (width, height) pixels that sees so many radians from left to right.

    Centres of pixels have whole numbers.
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
    from_behind: bool = True,
    threads: int = 1,
) -> Picture:
    """What an ideal camera would see of a model, unlit: its textures, grey where it has none.

    Args:
        textured: the model.
        T_camera_map: (4, 4), x right, y down, z ahead in the camera.
        K: (3, 3) of the picture, see `pinhole`.
        size: width and height in pixels.
        from_behind: show faces whose back is seen, too; without them rooms have no ceiling.
        threads: the result does not depend on them.

    Returns:
        (height, width, 3) uint8.
    """
    width, height = (_FINER * n for n in size)
    fine = K.copy()
    fine[:2] *= _FINER
    fine[:2, 2] += 0.5 * _FINER - 0.5
    kept, T = _drawn(textured, T_camera_map, from_behind), np.ascontiguousarray(T_camera_map)
    face = _nearest(textured, kept, T, fine, (width, height), threads)
    picture = np.empty((height * width, 3), np.float32)
    picture[:] = BACKGROUND
    seen = np.flatnonzero(face >= 0)
    planes, which = _planes(textured, T, kept, face.ravel()[seen])
    for first in range(0, len(seen), _BLOCK):
        at = slice(first, first + _BLOCK)
        row, column = np.divmod(seen[at], width)
        whose = kept[face.ravel()[seen[at]]]
        picture[seen[at]] = _painted(textured, whose, planes[which[at]], _rays(fine, column, row))
    parts = picture.reshape(size[1], _FINER, size[0], _FINER, 3)
    small: NDArray[np.float32] = parts.mean(axis=(1, 3))
    return np.rint(small).astype(np.uint8)


def textured_share(
    textured: TexturedMesh, T_camera_map: Float, K: Float, size: tuple[int, int], threads: int = 1
) -> float:
    """Share of the pixels of such a picture that some page paints."""
    face = _nearest(textured, np.arange(len(textured)), T_camera_map, K, size, threads)
    return float((textured.page[face[face >= 0]] >= 0).sum() / face.size)


def covered_share(
    textured: TexturedMesh,
    T_camera_map: Float,
    K: Float,
    size: tuple[int, int],
    *,
    from_behind: bool = True,
    threads: int = 1,
) -> float:
    """Share of the pixels of such a picture that show any of the model, see `still`."""
    kept = _drawn(textured, T_camera_map, from_behind)
    return float((_nearest(textured, kept, T_camera_map, K, size, threads) >= 0).mean())


def _drawn(textured: TexturedMesh, T_camera_map: Float, from_behind: bool) -> NDArray[np.intp]:
    """Faces that are drawn: all, or those whose front the camera sees."""
    if from_behind:
        return np.arange(len(textured))
    mesh = Mesh(textured.vertices, textured.faces)
    eye = -T_camera_map[:3, :3].T @ T_camera_map[:3, 3]
    return np.flatnonzero(np.einsum("ij,ij->i", eye - mesh.centers, mesh.normals()) > 0.0)


def _nearest(
    textured: TexturedMesh,
    kept: NDArray[np.intp],
    T_camera_map: Float,
    K: Float,
    size: tuple[int, int],
    threads: int,
) -> NDArray[np.int32]:
    """(height, width) which of the faces that are drawn each pixel sees, -1: none."""
    vertices, T = np.ascontiguousarray(textured.vertices), np.ascontiguousarray(T_camera_map)
    faces = np.ascontiguousarray(textured.faces[kept])
    _, face = _core.z_buffer(vertices, faces, K, T, *size, near=_NEAR, threads=threads)
    return face


def _rays(K: Float, column: NDArray[np.intp], row: NDArray[np.intp]) -> Float:
    """(n, 3) through the middles of pixels, one ahead."""
    y = (row - K[1, 2]) / K[1, 1]
    x = (column - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y, np.ones(len(x))], axis=1)


def _planes(
    textured: TexturedMesh, T: Float, kept: NDArray[np.intp], seen: NDArray[np.int32]
) -> tuple[Float, NDArray[np.intp]]:
    """(k, 3, 3) of the faces that are seen, and (n,) which of them each pixel sees.

    A ray meets a face a, b, c where its products with b x c, c x a and a x b say how near it is to
    a, b and c: see reference/z_buffer.py.

    Args:
        textured: the model.
        T: (4, 4) T_camera_map.
        kept: (F',) faces that were drawn.
        seen: (n,) which of these each pixel sees.
    """
    used = np.zeros(len(kept), np.bool_)
    used[seen] = True
    number = np.cumsum(used) - 1
    places = textured.vertices[textured.faces[kept[used]]] @ T[:3, :3].T + T[:3, 3]
    a, b, c = (places[:, k] for k in range(3))
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1), number[seen]


def _painted(
    textured: TexturedMesh, faces: NDArray[np.intp], planes: Float, rays: Float
) -> NDArray[np.float32]:
    """(n, 3) colours where rays meet the faces that they see.

    Args:
        textured: the model.
        faces: (n,).
        planes: (n, 3, 3), see `_planes`.
        rays: (n, 3) in the camera's frame.
    """
    across = np.matmul(planes, rays[:, :, None])[..., 0]
    total = across.sum(axis=1, keepdims=True)
    weights = np.clip(across / np.where(total == 0.0, 1.0, total), 0.0, 1.0)
    page, colours = textured.page[faces], np.empty((len(faces), 3), np.float32)
    plain = np.flatnonzero(page < 0)
    colours[plain] = _shaded(planes[plain].sum(axis=1), rays[plain])
    for number, texture in enumerate(textured.pages):
        on = np.flatnonzero(page == number)
        if len(on):
            corners = textured.uv[textured.faces[faces[on]]]
            uv = np.matmul(weights[on, None, :], corners)[:, 0]
            colours[on] = sample_bilinear(texture, uv * texture.shape[1::-1] - 0.5)
    return colours


def _shaded(normals: Float, rays: Float) -> NDArray[np.float32]:
    """(n, 3) greys of faces with normals (n, 3) of any length, the darker the more aslant."""
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", normals, rays)) / np.where(lengths == 0.0, 1.0, lengths)
    grey = _SLANTED + (_GREY - _SLANTED) * cosine
    return np.repeat(grey[:, None], 3, axis=1).astype(np.float32)


def fit_camera(points: Float, direction: Float, K: Float, size: tuple[int, int]) -> Float:
    """(4, 4) T_camera_map of a camera that sees from a direction (3,), as near as all points (n, 3)
    are in its picture, in the middle of it.

    A point (x, y, z) in the camera's axes is left of the right edge of what an eye at e sees where
    x - e_x <= s (z - e_z), and right of the left edge where e_x - x <= s (z - e_z). Of the points
    that lie outermost both together say how far ahead e_z may be; likewise up and down.

    Args:
        points: metres.
        direction: from them towards the camera.
        K: (3, 3) of the picture, see `pinhole`.
        size: width and height in pixels.
    """
    T = look_at(direction, np.zeros(3))
    own = points @ T[:3, :3].T
    slopes = 0.5 * np.array(size) / np.array([K[0, 0], K[1, 1]]) / _MARGIN
    right = (own[:, :2] - slopes * own[:, 2:]).max(axis=0)
    left = (-own[:, :2] - slopes * own[:, 2:]).max(axis=0)
    ahead = min(float((-(left + right) / (2.0 * slopes)).min()), own[:, 2].min() - 2.0 * _NEAR)
    eye = T[:3, :3].T @ np.array([*(0.5 * (right - left)), ahead])
    return look_at(eye, eye - direction)


def main_corners(textured: TexturedMesh, direction: Float, share: float) -> Float:
    """(n, 3) corners of the faces in which most is that is seen from a direction (3,).

    As seen from there, a share of the area lies farther left than any of them, and as much farther
    right, higher, lower, nearer and farther away: islands far out do not count. Where nothing is
    seen from there these are all corners.
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
    """(4, 4) T_camera_map of a camera at `eye` (3,) that looks at `target` (3,), z of the map
    upwards in its picture, or y where it looks straight down."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = right, np.cross(ahead, right), ahead
    T[:3, 3] = -T[:3, :3] @ eye
    return T
