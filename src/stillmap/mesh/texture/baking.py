"""Puts pictures onto a mesh: every texel is a place in space, seen by the picture of its face.

What lies between the charts of a page, so that looking it up between texels shows no seams.

Colours of pictures between their pixels.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import camera
from stillmap.core.errors import InputError
from stillmap.mesh.options import TextureOptions
from stillmap.mesh.texture.atlas import GRAY, AtlasLayout, TexturedMesh, build_layout
from stillmap.mesh.texture.views import View, as_color_image
from stillmap.mesh.triangle_mesh import Mesh

Index = NDArray[np.int32]

Float = NDArray[np.float64]

Float32 = NDArray[np.float32]

Picture = NDArray[np.uint8]

_AROUND = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c]


def fill_gutters(page: NDArray[np.uint8], painted: NDArray[np.bool_], gutter: int) -> None:
    """Carries colours outwards over `gutter` texels, and gives the rest their mean; in place.

    Args:
        page: (h, w, 3).
        painted: (h, w) texels that have a colour; those that get one by being beside others are
            marked.
        gutter: how far.
    """
    h, w = painted.shape
    flat, mask = page.reshape(-1, 3), painted.reshape(-1)
    rest = flat[mask].mean(axis=0) if mask.any() else np.full(3, 128.0)
    for _ in range(gutter):
        row, column = np.nonzero(_grown(painted) & ~painted)
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


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those, and the eight around each."""
    out = mask.copy()
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    wide = out.copy()
    wide[:, 1:] |= out[:, :-1]
    wide[:, :-1] |= out[:, 1:]
    return wide


def downsample(picture: NDArray[np.generic], times: int) -> Float32:
    """(h / 2^times, w / 2^times, 3) float32 means of squares; what is left at the edges counts as
    often as it takes to fill them."""
    out: Float32 = np.asarray(picture, np.float32)
    for _ in range(times):
        h, w = out.shape[:2]
        out = np.pad(out, [(0, h % 2), (0, w % 2), (0, 0)], mode="edge")
        out = 0.25 * (out[::2, ::2] + out[1::2, ::2] + out[::2, 1::2] + out[1::2, 1::2])
    return out


def sample_bilinear(picture: NDArray[np.generic], uv: Float) -> Float32:
    """(n, 3) values of a picture (h, w, 3) at (n, 2) columns and rows, centres of pixels having
    whole numbers; beyond the outermost centres, of what is nearest there.

    Values are mixed as they are stored.
    """
    h, w = picture.shape[:2]
    u, v = np.clip(uv[:, 0], 0.0, w - 1.0), np.clip(uv[:, 1], 0.0, h - 1.0)
    left, top = np.minimum(u.astype(np.int64), max(w - 2, 0)), v.astype(np.int64)
    top = np.minimum(top, max(h - 2, 0))
    a, b = (u - left).astype(np.float32)[:, None], (v - top).astype(np.float32)[:, None]
    right, down = min(1, w - 1), min(1, h - 1) * w
    flat, at = picture.reshape(-1, 3), top * w + left
    upper = flat[at] * (1 - a) + flat[at + right] * a
    lower = flat[at + down] * (1 - a) + flat[at + down + right] * a
    return np.asarray(upper * (1 - b) + lower * b, np.float32)


_AT_ONCE = 1 << 17  # texels


def bake_texture(
    mesh: Mesh,
    view_of_face: Index,
    views: list[View],
    read: Callable[[int], NDArray[Any]],
    options: TextureOptions | None = None,
) -> TexturedMesh:
    """A mesh with the pictures on it, one of which is in memory at a time.

    Args:
        mesh: V vertices, F faces.
        view_of_face: (F,) int32, which of `views` paints each, -1: none; it stays grey.
        views: the pictures; of lenses of which `lens.unusable` says nothing.
        read: the picture of a number, see `Images.read`; (h, w[, 3]) uint8.
        options: see TextureOptions.

    Raises:
        MissingExtra: xatlas is not installed.
        ValueError: faces and views do not fit together.
    """
    options = options or TextureOptions()
    _check(mesh, view_of_face, len(views))
    layout = build_layout(mesh, view_of_face, views, options)
    pages = [np.full((h, w, 3), GRAY[0], np.uint8) for w, h in layout.sizes.tolist()]
    painted = [np.zeros(page.shape[:2], np.bool_) for page in pages]
    vertices, view = mesh.vertices[layout.vertex], layout.view.copy()
    unread: list[str] = []
    for number, faces in _by_view(layout):
        one = views[number]
        try:
            picture = as_color_image(read(one.image), one)
        except InputError as error:
            unread.append(str(error))
            view[faces] = -1
            picture = np.broadcast_to(np.uint8(GRAY[0]), (1, 1, 3))
        _paint(pages, painted, layout, vertices, faces, one, picture)
    for page, mask in zip(pages, painted, strict=True):
        fill_gutters(page, mask, options.gutter)
    uv = layout.uv.copy()
    for page_number, size in enumerate(layout.sizes):
        on_page = np.unique(layout.faces[layout.page == page_number])
        uv[on_page] /= size
    return TexturedMesh(
        vertices, layout.faces, uv, layout.page, tuple(pages), view, layout.vertex, tuple(unread)
    )


def _check(mesh: Mesh, view_of_face: Index, n_views: int) -> None:
    if view_of_face.shape != (len(mesh),) or view_of_face.dtype != np.int32:
        got = f"{view_of_face.shape} {view_of_face.dtype}"
        raise ValueError(f"view_of_face: expected ({len(mesh)},) int32, got {got}")
    if len(mesh) and not -1 <= view_of_face.min() <= view_of_face.max() < n_views:
        raise ValueError(f"view_of_face: a view that is not there, of {n_views}")


def _by_view(layout: AtlasLayout) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Views that paint anything, and the faces that they do, rising."""
    order = np.argsort(layout.view, kind="stable")
    numbers, first = np.unique(layout.view[order], return_index=True)
    if not len(numbers):
        return
    for number, faces in zip(numbers.tolist(), np.split(order, first[1:]), strict=True):
        if number >= 0:
            yield number, faces


def _paint(
    pages: list[NDArray[np.uint8]],
    painted: list[NDArray[np.bool_]],
    layout: AtlasLayout,
    vertices: NDArray[np.float64],
    faces: NDArray[np.intp],
    view: View,
    picture: NDArray[np.uint8],
) -> None:
    """Paints the faces of one view, those of each page and scale together."""
    times = np.floor(np.log2(1.0 / layout.scale[faces]) + 0.5).astype(np.int64)
    if picture.size == 3:
        times[:] = 0
    for level in np.unique(times):
        smaller = np.ascontiguousarray(picture) if level == 0 else downsample(picture, int(level))
        for number in np.unique(layout.page[faces]):
            mine = faces[(times == level) & (layout.page[faces] == number)]
            h, w = painted[number].shape
            corners = layout.faces[mine]
            texel, of, weight = _core.rasterise_texels(layout.uv[corners], w, h)
            places = view.to_camera(vertices[corners].reshape(-1, 3)).reshape(-1, 3, 3)
            flat, mask = pages[number].reshape(-1, 3), painted[number].reshape(-1)
            for first in range(0, len(texel), _AT_ONCE):
                part = slice(first, first + _AT_ONCE)
                a, b, c = np.moveaxis(places[of[part]], 1, 0)
                j, k = weight[part, :1], weight[part, 1:]
                uv, _ = camera.project(view.camera, a + j * (b - a) + k * (c - a))
                colour = sample_bilinear(smaller, (uv + 0.5) * 0.5**level - 0.5)
                flat[texel[part]] = np.rint(colour)
                mask[texel[part]] = True
