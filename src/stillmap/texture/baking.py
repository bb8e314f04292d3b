"""Puts pictures onto a mesh: every texel is a place in space, seen by the picture of its face."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.errors import InputError
from stillmap.surface.mesh import Mesh
from stillmap.texture import lens
from stillmap.texture.atlas import Layout, laid_out
from stillmap.texture.gutters import fill_gutters
from stillmap.texture.options import TextureOptions
from stillmap.texture.sampling import bilinear, halved
from stillmap.texture.textured import GREY, Textured
from stillmap.texture.view import View
from stillmap.texture.views import of_colours

Index = NDArray[np.int32]

_AT_ONCE = 1 << 17  # texels


def baked(
    mesh: Mesh,
    view_of_face: Index,
    views: list[View],
    read: Callable[[int], NDArray[Any]],
    options: TextureOptions | None = None,
) -> Textured:
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
    layout = laid_out(mesh, view_of_face, views, options)
    pages = [np.full((h, w, 3), GREY[0], np.uint8) for w, h in layout.sizes.tolist()]
    painted = [np.zeros(page.shape[:2], np.bool_) for page in pages]
    vertices, view = mesh.vertices[layout.vertex], layout.view.copy()
    unread: list[str] = []
    for number, faces in _by_view(layout):
        one = views[number]
        try:
            picture = of_colours(read(one.image), one)
        except InputError as error:
            unread.append(str(error))
            view[faces] = -1
            picture = np.broadcast_to(np.uint8(GREY[0]), (1, 1, 3))
        _paint(pages, painted, layout, vertices, faces, one, picture)
    for page, mask in zip(pages, painted, strict=True):
        fill_gutters(page, mask, options.gutter)
    uv = layout.uv.copy()
    for page_number, size in enumerate(layout.sizes):
        on_page = np.unique(layout.faces[layout.page == page_number])
        uv[on_page] /= size
    return Textured(
        vertices, layout.faces, uv, layout.page, tuple(pages), view, layout.vertex, tuple(unread)
    )


def _check(mesh: Mesh, view_of_face: Index, n_views: int) -> None:
    if view_of_face.shape != (len(mesh),) or view_of_face.dtype != np.int32:
        got = f"{view_of_face.shape} {view_of_face.dtype}"
        raise ValueError(f"view_of_face: expected ({len(mesh)},) int32, got {got}")
    if len(mesh) and not -1 <= view_of_face.min() <= view_of_face.max() < n_views:
        raise ValueError(f"view_of_face: a view that is not there, of {n_views}")


def _by_view(layout: Layout) -> Iterator[tuple[int, NDArray[np.intp]]]:
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
    layout: Layout,
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
        smaller = np.ascontiguousarray(picture) if level == 0 else halved(picture, int(level))
        for number in np.unique(layout.page[faces]):
            mine = faces[(times == level) & (layout.page[faces] == number)]
            h, w = painted[number].shape
            corners = layout.faces[mine]
            texel, of, weight = _core.texels(layout.uv[corners], w, h)
            places = view.in_camera(vertices[corners].reshape(-1, 3)).reshape(-1, 3, 3)
            flat, mask = pages[number].reshape(-1, 3), painted[number].reshape(-1)
            for first in range(0, len(texel), _AT_ONCE):
                part = slice(first, first + _AT_ONCE)
                a, b, c = np.moveaxis(places[of[part]], 1, 0)
                j, k = weight[part, :1], weight[part, 1:]
                uv, _ = lens.project(view.camera, a + j * (b - a) + k * (c - a))
                colour = bilinear(smaller, (uv + 0.5) * 0.5**level - 0.5)
                flat[texel[part]] = np.rint(colour)
                mask[texel[part]] = True
