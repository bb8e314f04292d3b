"""Bakes images onto a mesh, each texel projected into the image of its face; samples textures."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.camera import project
from stillmap.core.errors import InputError
from stillmap.mesh.texture.atlas import GRAY, GUTTER, AtlasLayout, TexturedMesh, build_layout
from stillmap.mesh.texture.views import View, as_color_image
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.types import Bool, Float, Float32, Image, Index, Int32

_AROUND = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c]
_TEXELS_PER_BLOCK = 1 << 17
_OTHER_GRAY = (128, 128, 127)  # stands for an image's gray, as GRAY means no color


def bake_texture(
    mesh: Mesh,
    view_of_face: Int32,
    views: list[View],
    read: Callable[[int], NDArray[Any]],
    texture_size: int = 4096,
) -> TexturedMesh:
    """A mesh textured by images, one of which is in memory at a time.

    Args:
        mesh: V vertices, F faces.
        view_of_face: (F,) int32, view of each face, -1: none; it stays gray.
        views: with calibrations that `calibration_error` accepts.
        read: the image of a number, see `Images.read`; (h, w[, 3]) uint8.
        texture_size: maximum edge of a page, texels.

    Raises:
        MissingExtra: xatlas is not installed.
    """
    layout = build_layout(mesh, view_of_face, views, texture_size)
    pages = [np.full((h, w, 3), GRAY[0], np.uint8) for w, h in layout.sizes.tolist()]
    filled = [np.zeros(page.shape[:2], np.bool_) for page in pages]
    vertices, view = mesh.vertices[layout.vertex], layout.view.copy()
    unread: list[str] = []
    for number in np.unique(view[view >= 0]).tolist():
        one, faces = views[number], np.flatnonzero(layout.view == number)
        try:
            image = as_color_image(read(one.image), one)
        except InputError as error:
            unread.append(str(error))
            view[faces] = -1
            image = np.broadcast_to(np.uint8(GRAY[0]), (1, 1, 3))
        _bake_view(pages, filled, layout, vertices, faces, one, image)
    for page, mask in zip(pages, filled, strict=True):
        fill_gutters(page, mask, GUTTER)
    uv = layout.uv.copy()
    for page_number, size in enumerate(layout.sizes):
        on_page = np.unique(layout.faces[layout.page == page_number])
        uv[on_page] /= size
    return TexturedMesh(vertices, layout.faces, uv, layout.page, tuple(pages), view, tuple(unread))


def _bake_view(
    pages: list[Image],
    filled: list[Bool],
    layout: AtlasLayout,
    vertices: Float,
    faces: Index,
    view: View,
    image: Image,
) -> None:
    """Bakes the faces of one view, those of each page and scale together."""
    times = np.floor(np.log2(1.0 / layout.scale[faces]) + 0.5).astype(np.int64)
    if image.size == 3:
        times[:] = 0
    for level in np.unique(times):
        smaller = np.ascontiguousarray(image) if level == 0 else downsample(image, int(level))
        for number in np.unique(layout.page[faces]):
            mine = faces[(times == level) & (layout.page[faces] == number)]
            h, w = filled[number].shape
            corners = layout.faces[mine]
            texel, of, weight = _core.rasterise_texels(layout.uv[corners], w, h)
            places = view.to_camera(vertices[corners].reshape(-1, 3)).reshape(-1, 3, 3)
            flat, mask = pages[number].reshape(-1, 3), filled[number].reshape(-1)
            for first in range(0, len(texel), _TEXELS_PER_BLOCK):
                part = slice(first, first + _TEXELS_PER_BLOCK)
                a, b, c = np.moveaxis(places[of[part]], 1, 0)
                j, k = weight[part, :1], weight[part, 1:]
                uv, _ = project(view.camera, a + j * (b - a) + k * (c - a))
                color = sample_bilinear(smaller, (uv + 0.5) * 0.5**level - 0.5)
                flat[texel[part]] = np.rint(color)
                mask[texel[part]] = True


def fill_gutters(page: Image, filled: Bool, gutter: int) -> None:
    """Extends colors outwards by `gutter` texels and fills the rest with their mean; in place.

    So filtering between texels shows no seams.

    Args:
        page: (h, w, 3).
        filled: (h, w) texels that have a color; extended as well.
        gutter: texels.
    """
    h, w = filled.shape
    flat, mask = page.reshape(-1, 3), filled.reshape(-1)
    rest = flat[mask].mean(axis=0) if mask.any() else np.full(3, 128.0)
    for _ in range(gutter):
        row, column = np.nonzero(_dilate(filled) & ~filled)
        total, count = np.zeros((len(row), 3), np.int32), np.zeros((len(row), 1), np.int32)
        for r, c in _AROUND:
            inside = (row + r >= 0) & (row + r < h) & (column + c >= 0) & (column + c < w)
            at = np.where(inside, (row + r) * w + column + c, 0)
            there = (mask[at] & inside)[:, None]
            total += np.where(there, flat[at], 0)
            count += there
        at = row * w + column
        flat[at] = (total + count // 2) // np.maximum(count, 1)
        mask[at] = True
    flat[~mask] = np.rint(rest).astype(np.uint8)


def _dilate(mask: Bool) -> Bool:
    """The mask with the eight neighbors of each texel."""
    out = mask.copy()
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    wide = out.copy()
    wide[:, 1:] |= out[:, :-1]
    wide[:, :-1] |= out[:, 1:]
    return wide


def downsample(image: NDArray[np.generic], times: int) -> Float32:
    """(h / 2^times, w / 2^times, 3) float32 means of squares; borders are repeated to fill them."""
    out: Float32 = np.asarray(image, np.float32)
    for _ in range(times):
        h, w = out.shape[:2]
        out = np.pad(out, [(0, h % 2), (0, w % 2), (0, 0)], mode="edge")
        out = 0.25 * (out[::2, ::2] + out[1::2, ::2] + out[::2, 1::2] + out[1::2, 1::2])
    return out


def sample_bilinear(image: NDArray[np.generic], uv: Float) -> Float32:
    """(n, 3) values of an image (h, w, 3) at columns and rows (n, 2), interpolated as stored.

    Pixel centers have whole numbers; beyond the outermost centers the nearest value counts.
    """
    h, w = image.shape[:2]
    u, v = np.clip(uv[:, 0], 0.0, w - 1.0), np.clip(uv[:, 1], 0.0, h - 1.0)
    left, top = np.minimum(u.astype(np.int64), max(w - 2, 0)), v.astype(np.int64)
    top = np.minimum(top, max(h - 2, 0))
    a, b = (u - left).astype(np.float32)[:, None], (v - top).astype(np.float32)[:, None]
    right, down = min(1, w - 1), min(1, h - 1) * w
    flat, at = image.reshape(-1, 3), top * w + left
    upper = flat[at] * (1 - a) + flat[at + right] * a
    lower = flat[at + down] * (1 - a) + flat[at + down + right] * a
    return np.asarray(upper * (1 - b) + lower * b, np.float32)


class TextureSampler:
    """Looks up the colors of points on a textured mesh.

    Args:
        textured: F faces.
        max_distance: metres of a point from a face.
    """

    def __init__(self, textured: TexturedMesh, max_distance: float) -> None:
        self._of = textured
        self._mesh = _core.MeshDistance(
            textured.vertices, textured.faces, max_distance=max_distance
        )
        # the last entry stands for no face
        self._page = np.append(np.where(textured.view >= 0, textured.page, -1), -1)

    def colors(self, points: Float, origins: Float) -> tuple[Image, Bool]:
        """(n, 3) uint8 colors, none of them GRAY, and whether (n,) there are any.

        The color at the closest place on faces that face the point's sensor.

        Args:
            points: (n, 3) metres.
            origins: (n, 3) position of the sensor for each.
        """
        places = np.ascontiguousarray(points), np.ascontiguousarray(origins)
        face, weight = self._mesh.closest_faces(*places)
        found = self._page[face]
        out = np.zeros((len(points), 3), np.uint8)
        for page, texels in enumerate(self._of.pages):
            mine = np.flatnonzero(found == page)
            corner, share = self._of.faces[face[mine]], weight[mine]
            uv = sum(share[:, k, None] * self._of.uv[corner[:, k]] for k in range(3))
            h, w = texels.shape[:2]
            out[mine] = np.rint(sample_bilinear(texels, uv * np.array([w, h], np.float64) - 0.5))
        return avoid_gray(out), found >= 0


def avoid_gray(colors: Image) -> Image:
    """(n, 3) the colors with GRAY, which means that there is none, replaced by its neighbor."""
    is_gray = (colors == GRAY).all(axis=1, keepdims=True)
    return np.where(is_gray, np.array(_OTHER_GRAY, np.uint8), colors)
