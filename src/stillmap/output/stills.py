"""Pictures of a textured model, by its z-buffer: what the report shows of it."""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.surface.mesh import Mesh

Float = NDArray[np.float64]
Picture = NDArray[np.uint8]

BACKGROUND = (236, 238, 241)
_FINER = 2  # pixels along an edge that are drawn for one that is shown: textures are finer still
_NEAR = 0.05  # m
_GREY = 150.0  # of faces without a picture, seen straight
_SLANTED = 70.0  # their grey seen along them: edges show
_BLOCK = 1 << 17  # pixels that are painted together


class TexturedLike(Protocol):
    """A mesh with F faces, and what each looks like.

    Attributes:
        mesh: the faces.
        uv: (F, 3, 2), of each corner: the share of the page's width from the left, and of its
            height from the top.
        page: (F,) which page a face is painted from; -1: none shows it.
        pages: (H, W, 3) uint8 each.
    """

    @property
    def mesh(self) -> Mesh: ...
    @property
    def uv(self) -> NDArray[np.float32]: ...
    @property
    def page(self) -> NDArray[np.int32]: ...
    @property
    def pages(self) -> Sequence[Picture]: ...


def pinhole(size: tuple[int, int], field_of_view: float) -> Float:
    """(3, 3) of a picture of (width, height) pixels that sees so many radians from left to right.

    Centres of pixels have whole numbers.
    """
    width, height = size
    f = 0.5 * width / math.tan(0.5 * field_of_view)
    return np.array([[f, 0.0, 0.5 * width - 0.5], [0.0, f, 0.5 * height - 0.5], [0.0, 0.0, 1.0]])


def still(
    textured: TexturedLike,
    T_camera_map: Float,
    K: Float,
    size: tuple[int, int],
    *,
    from_behind: bool = True,
    threads: int = 1,
) -> Picture:
    """What an ideal camera would see of a model, unlit: its textures, grey where it has none.

    Args:
        textured: see TexturedLike.
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
    mesh, kept = textured.mesh, np.arange(len(textured.mesh))
    if not from_behind:
        eye = -T_camera_map[:3, :3].T @ T_camera_map[:3, 3]
        front = np.einsum("ij,ij->i", eye - mesh.centres, mesh.normals()) > 0.0
        kept = np.flatnonzero(front)
    faces = np.ascontiguousarray(mesh.faces[kept])
    vertices, T = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(T_camera_map)
    _, face = _core.z_buffer(vertices, faces, fine, T, width, height, near=_NEAR, threads=threads)
    picture = np.empty((height * width, 3), np.float32)
    picture[:] = BACKGROUND
    seen = np.flatnonzero(face >= 0)
    corners = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    for first in range(0, len(seen), _BLOCK):
        at = seen[first : first + _BLOCK]
        row, column = np.divmod(at, width)
        rays = _rays(fine, column, row)
        picture[at] = _painted(textured, kept[face.ravel()[at]], corners, rays)
    parts = picture.reshape(size[1], _FINER, size[0], _FINER, 3)
    small: NDArray[np.float32] = parts.mean(axis=(1, 3))
    return np.rint(small).astype(np.uint8)


def painted_share(
    textured: TexturedLike, T_camera_map: Float, K: Float, size: tuple[int, int], threads: int = 1
) -> float:
    """Share of the pixels of such a picture that some page paints."""
    vertices = np.ascontiguousarray(textured.mesh.vertices)
    faces, T = np.ascontiguousarray(textured.mesh.faces), np.ascontiguousarray(T_camera_map)
    _, face = _core.z_buffer(vertices, faces, K, T, *size, near=_NEAR, threads=threads)
    return float((textured.page[face[face >= 0]] >= 0).sum() / face.size)


def _rays(K: Float, column: NDArray[np.intp], row: NDArray[np.intp]) -> Float:
    """(n, 3) through the middles of pixels, one ahead."""
    y = (row - K[1, 2]) / K[1, 1]
    x = (column - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y, np.ones(len(x))], axis=1)


def _painted(
    textured: TexturedLike, faces: NDArray[np.intp], corners: Float, rays: Float
) -> NDArray[np.float32]:
    """(n, 3) colours where rays meet the faces (n,) that they see.

    Args:
        textured: see TexturedLike.
        faces: (n,).
        corners: (V, 3) metres in the camera's frame.
        rays: (n, 3) in the camera's frame.
    """
    a, b, c = (corners[textured.mesh.faces[faces, k]] for k in range(3))
    # where a ray meets a plane, by Cramer's rule: see reference/z_buffer.py
    parts = (np.cross(b, c), np.cross(c, a), np.cross(a, b))
    across = np.stack([np.einsum("ij,ij->i", rays, part) for part in parts], axis=1)
    total = across.sum(axis=1, keepdims=True)
    weights = np.clip(across / np.where(total == 0.0, 1.0, total), 0.0, 1.0)
    colours = _shaded(parts[0] + parts[1] + parts[2], rays)
    page = textured.page[faces]
    for number, texture in enumerate(textured.pages):
        on = np.flatnonzero(page == number)
        uv = np.einsum("ij,ijk->ik", weights[on], textured.uv[faces[on]])
        colours[on] = _sampled(texture, uv)
    return colours


def _shaded(normals: Float, rays: Float) -> NDArray[np.float32]:
    """(n, 3) greys of faces with normals (n, 3) of any length, the darker the more aslant."""
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", normals, rays)) / np.where(lengths == 0.0, 1.0, lengths)
    grey = _SLANTED + (_GREY - _SLANTED) * cosine
    return np.repeat(grey[:, None], 3, axis=1).astype(np.float32)


def _sampled(texture: Picture, uv: Float) -> NDArray[np.float32]:
    """(n, 3) colours between the middles of texels."""
    height, width = texture.shape[:2]
    at = uv * (width, height) - 0.5
    low = np.floor(at).astype(np.int64)
    share = (at - low).astype(np.float32)
    out = np.zeros((len(uv), 3), np.float32)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = np.clip(low[:, 0] + dx, 0, width - 1), np.clip(low[:, 1] + dy, 0, height - 1)
        weight = (share[:, 0] if dx else 1.0 - share[:, 0]) * (
            share[:, 1] if dy else 1.0 - share[:, 1]
        )
        out += weight[:, None] * texture[y, x]
    return out


def looking_at(eye: Float, target: Float) -> Float:
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
