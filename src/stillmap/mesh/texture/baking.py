"""Bakes images onto a mesh: each texel is projected into the image of its face."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.camera import project
from stillmap.core.errors import InputError
from stillmap.mesh.texture.atlas import GRAY, GUTTER, AtlasLayout, TexturedMesh, build_layout
from stillmap.mesh.texture.sampling import downsample, sample_bilinear
from stillmap.mesh.texture.views import View, as_color_image
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.types import Bool, Float, Image, Index, Int32

_AROUND = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c]
_TEXELS_PER_BLOCK = 1 << 17


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
        ValueError: faces and views do not fit together.
    """
    _check_views(mesh, view_of_face, len(views))
    layout = build_layout(mesh, view_of_face, views, texture_size)
    pages = [np.full((h, w, 3), GRAY[0], np.uint8) for w, h in layout.sizes.tolist()]
    filled = [np.zeros(page.shape[:2], np.bool_) for page in pages]
    vertices, view = mesh.vertices[layout.vertex], layout.view.copy()
    unread: list[str] = []
    for number, faces in _faces_by_view(layout):
        one = views[number]
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
    return TexturedMesh(
        vertices, layout.faces, uv, layout.page, tuple(pages), view, layout.vertex, tuple(unread)
    )


def _check_views(mesh: Mesh, view_of_face: Int32, n_views: int) -> None:
    if view_of_face.shape != (len(mesh),) or view_of_face.dtype != np.int32:
        got = f"{view_of_face.shape} {view_of_face.dtype}"
        raise ValueError(f"view_of_face: expected ({len(mesh)},) int32, got {got}")
    if len(mesh) and not -1 <= view_of_face.min() <= view_of_face.max() < n_views:
        raise ValueError(f"view_of_face: a view that is not there, of {n_views}")


def _faces_by_view(layout: AtlasLayout) -> Iterator[tuple[int, Index]]:
    """Views that texture anything, and their faces, rising."""
    order = np.argsort(layout.view, kind="stable")
    numbers, first = np.unique(layout.view[order], return_index=True)
    if not len(numbers):
        return
    for number, faces in zip(numbers.tolist(), np.split(order, first[1:]), strict=True):
        if number >= 0:
            yield number, faces


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
