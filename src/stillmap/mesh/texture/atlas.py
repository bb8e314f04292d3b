"""Where on the pages of a texture each face lies.

A chart is what one picture paints in one piece, cut out of the picture as it is: faces that a
picture shows do not overlap in it, so that nothing has to be unfolded, and a texel is a pixel
unless that would be finer than is asked for. xatlas finds the places of the charts.

A mesh with pictures on it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import stillmap._core as _core
from stillmap.core import camera
from stillmap.core.errors import import_extra
from stillmap.mesh.options import TextureOptions
from stillmap.mesh.texture.views import View
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]

Index = NDArray[np.int32]

Number = NDArray[np.int64]

Picture = NDArray[np.uint8]

_LEAST = 1e-4  # square pixels: what a picture shows at its edge only is not painted by it

_FULL = 0.6  # of the pages that charts fill, at first sight

_SMALLER = 0.85  # scale after each time that they need more pages


class AtlasLayout(NamedTuple):
    """Places of F faces on P pages.

    Attributes:
        vertex: (U,) int32 of the mesh; one that several charts share is there once for each.
        faces: (F, 3) int32 into these.
        uv: (U, 2) texels from a page's left and top edge, centres at halves; 0 on no page.
        page: (F,) int32, -1: of no picture.
        view: (F,) int32, whose picture is there, -1: none.
        scale: (F,) texels per pixel of the picture, along an edge.
        sizes: (P, 2) int64, width and height of the pages.
    """

    vertex: Index
    faces: Index
    uv: Float
    page: Index
    view: Index
    scale: Float
    sizes: Number


def build_layout(
    mesh: Mesh, view_of_face: Index, views: list[View], options: TextureOptions
) -> AtlasLayout:
    """Charts of all faces that a picture paints, on as many pages as they need.

    Args:
        mesh: V vertices, F faces.
        view_of_face: (F,) which of `views` paints each, -1: none.
        views: of lenses of which `lens.unusable` says nothing.
        options: see TextureOptions.

    Raises:
        MissingExtra: xatlas is not installed.
    """
    view, pixels = _in_pictures(mesh, view_of_face, views)
    chart = find_charts(mesh, view)
    painted = np.flatnonzero(chart >= 0)
    # a vertex of each chart: what charts share, they share no longer
    key = chart[painted, None] * np.int64(len(mesh.vertices)) + mesh.faces[painted]
    key, first, corner = np.unique(key, return_index=True, return_inverse=True)
    corner = corner.reshape(-1, 3).astype(np.int64)
    vertex, of_chart = key % max(len(mesh.vertices), 1), key // max(len(mesh.vertices), 1)
    uv = pixels[painted].reshape(-1, 2)[first]
    n_charts = int(chart.max(initial=-1)) + 1
    scale = _scales(mesh.areas()[painted], uv[corner], chart[painted], n_charts, options)
    placed, page, scale = _packed(uv, corner, of_chart, scale, options)
    return _with_grey(mesh, view, painted, vertex, corner, placed, page, scale[of_chart], options)


def find_charts(mesh: Mesh, view: Index) -> Number:
    """(F,) int64 the chart of each face: faces side by side with one picture; -1 without one."""
    F = len(mesh)
    pairs = mesh.adjacent_faces()
    pairs = pairs[(view[pairs[:, 0]] == view[pairs[:, 1]]) & (view[pairs[:, 0]] >= 0)]
    beside = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(F, F))
    chart = connected_components(beside, directed=False)[1].astype(np.int64) if F else view
    chart = np.where(view >= 0, chart, -1)
    _, number = np.unique(chart[chart >= 0], return_inverse=True)
    out = np.full(F, -1, np.int64)
    out[chart >= 0] = number
    return out


def _in_pictures(mesh: Mesh, view_of_face: Index, views: list[View]) -> tuple[Index, Float]:
    """(F,) the view of each face, -1 too where its picture does not show it; and where in the
    picture its corners are, (F, 3, 2)."""
    view = np.array(view_of_face, np.int32)
    pixels = np.zeros((len(mesh), 3, 2))
    order = np.argsort(view, kind="stable")
    bounds = np.searchsorted(view[order], np.arange(len(views) + 1))
    for number, one in enumerate(views):
        mine = order[bounds[number] : bounds[number + 1]]
        used, at = np.unique(mesh.faces[mine], return_inverse=True)
        uv, ok = camera.project(one.camera, one.to_camera(mesh.vertices[used]))
        corners = uv[at.reshape(-1, 3)]
        shown = ok[at.reshape(-1, 3)].all(axis=1) & (_areas(corners) > _LEAST)
        pixels[mine[shown]] = corners[shown]
        view[mine[~shown]] = -1
    return view, pixels


def _areas(corners: Float) -> Float:
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _scales(
    area: Float, corners: Float, chart: Number, n_charts: int, options: TextureOptions
) -> Float:
    """(C,) texels per pixel of each chart: one, less where pixels are finer than asked for, where
    a chart is larger than a page, and where all of them are more than the pages may hold."""
    pixels = np.bincount(chart, _areas(corners), n_charts)
    metres = np.bincount(chart, area, n_charts)
    scale = np.minimum(1.0, np.sqrt(metres / np.maximum(pixels, 1e-300)) / options.texel)
    low, high = np.full((n_charts, 2), np.inf), np.full((n_charts, 2), -np.inf)
    np.minimum.at(low, chart, corners.min(axis=1))
    np.maximum.at(high, chart, corners.max(axis=1))
    room = _room(options)
    scale = np.minimum(scale, (room - 3.0) / np.maximum((high - low).max(axis=1), 1.0))
    texels = float(np.sum(pixels * scale * scale))
    fit = np.sqrt(_FULL * options.pages * room * room / max(texels, 1.0))
    return np.asarray(scale * min(1.0, float(fit)))


def _room(options: TextureOptions) -> int:
    """Texels along the edge of a page that charts may use."""
    return options.page - 2 * options.gutter


def _packed(
    uv: Float, corner: Number, of_chart: Number, scale: Float, options: TextureOptions
) -> tuple[Float, Number, Float]:
    """Places (n, 2) in texels and pages (n,) of the vertices of all charts, and what scales the
    charts (C,) came to.

    A page's texels have the centres of the picture's pixels where the scale is one.
    """
    while True:
        pixels = (uv + 0.5) * scale[of_chart, None]
        low = np.full((len(scale), 2), np.inf)
        np.minimum.at(low, of_chart, pixels)
        local = pixels - np.floor(low)[of_chart]
        at, page = _places(local, corner, of_chart, options)
        if page.max(initial=-1) < options.pages:
            break
        scale = scale * _SMALLER
    low = np.full((len(scale), 2), np.inf)
    np.minimum.at(low, of_chart, at)
    return local + np.rint(low - 0.5)[of_chart] + options.gutter, page, scale


def _places(
    local: Float, corner: Number, of_chart: Number, options: TextureOptions
) -> tuple[Float, Number]:
    """Where xatlas puts the vertices of charts, (n, 2) texels, and on which pages (n,); -1: not.

    It stretches charts by less than a texel, which the caller undoes.
    """
    if not len(corner):
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    xatlas: Any = import_extra("xatlas", "mesh.glb", "textured", group="mesh")
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(
        np.ascontiguousarray(local, np.float32),
        np.ascontiguousarray(corner, np.uint32),
        np.ascontiguousarray(of_chart[corner[:, :1]], np.uint32),
    )
    pack = xatlas.PackOptions()
    pack.resolution = _room(options)
    pack.texels_per_unit = 1.0
    pack.padding = 2 * options.gutter
    pack.bilinear = True
    pack.rotate_charts = pack.rotate_charts_to_axis = False
    atlas.generate(xatlas.ChartOptions(), pack)
    vertex, _, uv = atlas.get_mesh(0)
    at, page = np.zeros(local.shape), np.full(len(local), -1, np.int64)
    at[vertex] = uv * np.array([atlas.width, atlas.height])
    page[vertex] = atlas.get_mesh_vertex_assignment(0)[0].astype(np.int32)
    return at, page


def _with_grey(
    mesh: Mesh,
    view: Index,
    painted: NDArray[np.intp],
    vertex: Number,
    corner: Number,
    placed: Float,
    page: Number,
    scale: Float,
    options: TextureOptions,
) -> AtlasLayout:
    """The layout of all faces: those that have a place, and the others with vertices of their
    own."""
    there = (page[corner] >= 0).all(axis=1)
    painted, corner = painted[there], corner[there]
    P = int(page.max(initial=-1)) + 1
    sizes = np.zeros((P, 2), np.int64)
    np.maximum.at(sizes, page[page >= 0], np.ceil(placed[page >= 0]).astype(np.int64))
    sizes = np.minimum(-16 * (-(sizes + options.gutter) // 16), options.page)
    faces = np.zeros((len(mesh), 3), np.int64)
    page_of_face, scale_of_face = np.full(len(mesh), -1, np.int32), np.ones(len(mesh))
    faces[painted] = corner
    page_of_face[painted], scale_of_face[painted] = page[corner[:, 0]], scale[corner[:, 0]]
    grey = page_of_face < 0
    used, at = np.unique(mesh.faces[grey], return_inverse=True)
    faces[grey] = at.reshape(-1, 3) + len(vertex)
    return AtlasLayout(
        np.concatenate([vertex, used]).astype(np.int32),
        faces.astype(np.int32),
        np.concatenate([placed, np.zeros((len(used), 2))]),
        page_of_face,
        np.where(grey, -1, view).astype(np.int32),
        scale_of_face,
        sizes,
    )


GRAY = (128, 128, 128)  # what no picture shows


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """F faces over U vertices, and P pages of texels.

    Where pieces of the texture meet, vertices stand there once for each piece.

    Attributes:
        vertices: (U, 3) float64 metres.
        faces: (F, 3) int32, in the order of the mesh they were made from.
        uv: (U, 2) float64, share of the page's width from the left and of its height from the top;
            0 where no page is used.
        page: (F,) int32, -1: grey.
        pages: P pictures (h, w, 3) uint8, as photographed (sRGB).
        view: (F,) int32, which view's picture is on each face, -1: none.
        vertex: (U,) int32, of the mesh it was made from; -1: it was not.
        unread: one line for each picture that could not be read; its faces are painted grey.
    """

    vertices: Float
    faces: Index
    uv: Float
    page: Index
    pages: tuple[Picture, ...]
    view: Index
    vertex: Index
    unread: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.faces)

    def face_of_texel(self, page: int) -> Index:
        """(h, w) int32, which face each texel of a page is of; -1: of none, but beside one."""
        h, w = self.pages[page].shape[:2]
        out = np.full(h * w, -1, np.int32)
        mine = np.flatnonzero(self.page == page)
        corners = self.uv[self.faces[mine]] * np.array([w, h], float)
        texel, of, _ = _core.rasterise_texels(corners, w, h)
        out[texel] = mine[of]
        return out.reshape(h, w)


def replace_faces(whole: TexturedMesh, of: NDArray[np.bool_], part: TexturedMesh) -> TexturedMesh:
    """A mesh some of whose faces are painted otherwise.

    Args:
        whole: F faces.
        of: (F,) which of them are those of `part`, in their order.
        part: as many faces as `of` names.
    """
    if of.shape != (len(whole),) or np.count_nonzero(of) != len(part):
        raise ValueError(f"of: expected ({len(whole)},) with {len(part)} faces")
    faces, page, view = whole.faces.copy(), whole.page.copy(), whole.view.copy()
    faces[of] = part.faces + np.int32(len(whole.vertices))
    page[of] = np.where(part.page >= 0, part.page + np.int32(len(whole.pages)), part.page)
    view[of] = part.view
    return TexturedMesh(
        np.concatenate([whole.vertices, part.vertices]),
        faces,
        np.concatenate([whole.uv, part.uv]),
        page,
        (*whole.pages, *part.pages),
        view,
        np.concatenate([whole.vertex, np.full(len(part.vertices), -1, np.int32)]),
        (*whole.unread, *part.unread),
    )
