"""The texture of a mesh: charts cut out of images, packed onto pages, and baked; its colors."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Index, Int32, Int64
from stillmap.core.camera import project
from stillmap.core.errors import import_extra
from stillmap.core.short_repr import ShortRepr
from stillmap.mesh.triangle_mesh import Image, Mesh, planar_areas, row_lengths, subdivide
from stillmap.mesh.views import View

GRAY = (128, 128, 128)  # of faces that no image textures
GUTTER = 4  # texels around each chart that continue its colors
_MAX_PAGES = 8  # where charts need more, texels are coarser
_MIN_TEXEL = 0.001  # m, edge of a texel where pixels are finer
_MIN_AREA = 1e-4  # square pixels of a textured face
_FILL = 0.6  # share of the pages that charts are expected to fill
_SHRINK = 0.85  # of the scale, each time charts need too many pages
_SAMPLE_EDGE = 0.15  # m, edges of the parts of faces among which the nearest is looked up
_SAMPLES = 4  # nearest of these parts that are compared


class AtlasLayout(NamedTuple):
    """Places of F faces on P pages.

    Attributes:
        vertex: (U,) int32 vertices of the mesh, one copy for each chart that shares them.
        faces: (F, 3) int32 into these.
        uv: (U, 2) texels from a page's left and top edge, centers at halves; 0 on no page.
        page: (F,) int32, -1: no image.
        view: (F,) int32, -1: none.
        scale: (N,) texels per pixel of each view, along an edge.
        sizes: (P, 2) int64, width and height of the pages.
    """

    vertex: Int32
    faces: Int32
    uv: Float
    page: Int32
    view: Int32
    scale: Float
    sizes: Int64


@dataclass(frozen=True, eq=False)
class TexturedMesh(ShortRepr):
    """F faces over U vertices, and P texture pages.

    Vertices shared by several charts are repeated for each.

    Attributes:
        vertices: (U, 3) float64 metres.
        faces: (F, 3) int32, in the order of the mesh they were made from.
        uv: (U, 2) float64, share of the page's width from the left and of its height from the top;
            0 where no page is used.
        page: (F,) int32, -1: gray.
        pages: P images (h, w, 3) uint8, sRGB.
        view: (F,) int32, number of the view on each face, -1: none.
    """

    vertices: Float
    faces: Int32
    uv: Float
    page: Int32
    pages: tuple[Image, ...]
    view: Int32

    def __len__(self) -> int:
        return len(self.faces)


def build_layout(
    mesh: Mesh, view_of_face: Int32, views: list[View], texture_size: int = 4096
) -> AtlasLayout:
    """Packs the charts of all textured faces onto as many pages as they need.

    Args:
        mesh: V vertices, F faces.
        view_of_face: (F,) view of each face, -1: none.
        views: with calibrations that `calibration_error` accepts.
        texture_size: maximum edge of a page, texels.

    Raises:
        MissingExtra: xatlas is not installed.
    """
    view, shown = _project_faces(mesh, view_of_face, views)
    textured = np.flatnonzero(view >= 0)
    # a copy of each vertex for each view
    key = view[textured, None] * np.int64(len(mesh.vertices)) + mesh.faces[textured]
    key, first, corner = np.unique(key, return_index=True, return_inverse=True)
    corner, uv = corner.reshape(-1, 3), shown[textured].reshape(-1, 2)[first]
    room = texture_size - 2 * GUTTER
    scale = _initial_scales(mesh.areas()[textured], uv[corner], view[textured], views, room)
    while True:
        pixels = (uv + 0.5) * scale[key // max(len(mesh.vertices), 1), None]
        source, faces, at, page = _run_xatlas(pixels, corner, view[textured], room)
        if page.max(initial=-1) < _MAX_PAGES:
            break
        scale = scale * _SHRINK
    sizes = np.zeros((int(page.max(initial=-1)) + 1, 2), np.int64)
    np.maximum.at(sizes, page[page >= 0], np.ceil(at[page >= 0]).astype(np.int64) + 2 * GUTTER)
    sizes = np.minimum(-16 * (-sizes // 16), texture_size)
    # faces without a place on a page get vertices of their own
    gray = np.setdiff1d(np.arange(len(mesh)), textured)
    used, number = np.unique(mesh.faces[gray], return_inverse=True)
    all_faces = np.empty((len(mesh), 3), np.int32)
    all_faces[textured], all_faces[gray] = faces, number.reshape(-1, 3) + len(source)
    page_of_face = np.full(len(mesh), -1, np.int32)
    page_of_face[textured] = page[faces[:, 0]]
    return AtlasLayout(
        np.concatenate([key[source] % max(len(mesh.vertices), 1), used]).astype(np.int32),
        all_faces,
        np.concatenate([at + GUTTER, np.zeros((len(used), 2))]),
        page_of_face,
        np.where(page_of_face >= 0, view, np.int32(-1)),
        scale,
        sizes,
    )


def _project_faces(mesh: Mesh, view_of_face: Int32, views: list[View]) -> tuple[Int32, Float]:
    """(F,) the view of each face, -1 also where its image does not show it; and the corners of the
    face in the image, (F, 3, 2)."""
    view = np.array(view_of_face, np.int32)
    pixels = np.zeros((len(mesh), 3, 2))
    order = np.argsort(view, kind="stable")
    bounds = np.searchsorted(view[order], np.arange(len(views) + 1))
    for number, one in enumerate(views):
        mine = order[bounds[number] : bounds[number + 1]]
        used, at = np.unique(mesh.faces[mine], return_inverse=True)
        uv, ok = project(one.camera, one.to_camera(mesh.vertices[used]))
        corners = uv[at.reshape(-1, 3)]
        shown = ok[at.reshape(-1, 3)].all(axis=1) & (planar_areas(corners) > _MIN_AREA)
        pixels[mine[shown]] = corners[shown]
        view[mine[~shown]] = -1
    return view, pixels


def _initial_scales(
    area: Float, corners: Float, view: Int32, views: list[View], room: int
) -> Float:
    """(N,) texels per pixel of each view: 1, less where pixels are finer than `_MIN_TEXEL`, where
    an image exceeds a page, and where all charts exceed the pages."""
    pixels = np.bincount(view, planar_areas(corners), len(views))
    metres = np.bincount(view, area, len(views))
    edge = np.array([max(one.camera.width, one.camera.height) for one in views])
    scale = np.minimum(np.sqrt(metres / np.maximum(pixels, 1e-300)) / _MIN_TEXEL, 1.0)
    scale = np.minimum(scale, (room - 3.0) / np.maximum(edge, 1))
    texels = float(np.sum(pixels * scale * scale))
    fitting = float(np.sqrt(_FILL * _MAX_PAGES * room * room / max(texels, 1.0)))
    return np.asarray(scale * min(1.0, fitting))


def _run_xatlas(
    uv: Float, corner: Index, view: Int32, room: int
) -> tuple[Index, Int32, Float, Int32]:
    """Packs charts, which are connected faces of one view: vertices (U,) that it copies, faces
    (F, 3) of the copies, and their positions (U, 2) in texels and pages (U,); -1: none.

    xatlas stretches charts by less than a texel, which is undone.
    """
    if not len(corner):
        empty = np.zeros(0, np.int32)
        return np.zeros(0, np.intp), empty.reshape(0, 3), np.zeros((0, 2)), empty
    xatlas: Any = import_extra("xatlas", "mesh.glb", "textured", group="mesh")
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(
        np.ascontiguousarray(uv, np.float32),
        np.ascontiguousarray(corner, np.uint32),
        np.ascontiguousarray(view[:, None], np.uint32),
    )
    pack = xatlas.PackOptions()
    pack.resolution = room
    pack.texels_per_unit = 1.0
    pack.padding = 2 * GUTTER
    pack.bilinear = True
    pack.rotate_charts = pack.rotate_charts_to_axis = False
    atlas.generate(xatlas.ChartOptions(), pack)
    vertex, faces, at = atlas.get_mesh(0)
    page, chart = (a.astype(np.int32) for a in atlas.get_mesh_vertex_assignment(0))
    chart[page < 0] = chart.max() + 1
    texels = at.astype(np.float64) * np.array([atlas.width, atlas.height])
    # charts are as they were, shifted by whole texels, so that at scale 1 texels are pixels
    local = uv[vertex]
    shift = np.rint(_chart_corners(texels, chart) - 0.5) - np.floor(_chart_corners(local, chart))
    return vertex.astype(np.intp), faces.astype(np.int32), local + shift[chart], page


def _chart_corners(positions: Float, chart: Int32) -> Float:
    """(C, 2) lowest coordinates of each chart."""
    out = np.full((int(chart.max()) + 1, 2), np.inf)
    np.minimum.at(out, chart, positions)
    return out


_TEXELS_PER_BLOCK = 1 << 17
_OTHER_GRAY = (128, 128, 127)  # stands for an image's gray, as GRAY means no color


def bake_texture(
    mesh: Mesh,
    view_of_face: Int32,
    views: list[View],
    read: Callable[[View], Image],
    texture_size: int = 4096,
) -> TexturedMesh:
    """A mesh textured by images, one of which is in memory at a time.

    Args:
        mesh: V vertices, F faces.
        view_of_face: (F,) int32, view of each face, -1: none; it stays gray.
        views: with calibrations that `calibration_error` accepts.
        read: (h, w, 3) the image of a view.
        texture_size: maximum edge of a page, texels.

    Raises:
        MissingExtra: xatlas is not installed.
    """
    layout = build_layout(mesh, view_of_face, views, texture_size)
    pages = [np.full((h, w, 3), GRAY[0], np.uint8) for w, h in layout.sizes.tolist()]
    filled = [np.zeros(page.shape[:2], np.bool_) for page in pages]
    vertices = mesh.vertices[layout.vertex]
    for number in np.unique(layout.view[layout.view >= 0]).tolist():
        _bake_view(pages, filled, layout, vertices, number, views[number], read(views[number]))
    for page, mask in zip(pages, filled, strict=True):
        fill_gutters(page, mask, GUTTER)
    uv = layout.uv.copy()
    for page_number, size in enumerate(layout.sizes):
        on_page = np.unique(layout.faces[layout.page == page_number])
        uv[on_page] /= size
    return TexturedMesh(vertices, layout.faces, uv, layout.page, tuple(pages), layout.view)


def _bake_view(
    pages: list[Image],
    filled: list[Bool],
    layout: AtlasLayout,
    vertices: Float,
    number: int,
    view: View,
    image: Image,
) -> None:
    """Bakes the faces of the view with a number, page by page."""
    level = max(round(np.log2(1.0 / layout.scale[number])), 0)
    smaller = np.asarray(PIL.Image.fromarray(image).reduce(2**level))
    of_view = layout.view == number
    for page in np.unique(layout.page[of_view]).tolist():
        corners = layout.faces[of_view & (layout.page == page)]
        h, w = filled[page].shape
        texel, of, weight = _core.rasterise_texels(layout.uv[corners], w, h)
        places = view.to_camera(vertices[corners].reshape(-1, 3)).reshape(-1, 3, 3)
        flat, mask = pages[page].reshape(-1, 3), filled[page].reshape(-1)
        for first in range(0, len(texel), _TEXELS_PER_BLOCK):
            part = slice(first, first + _TEXELS_PER_BLOCK)
            a, b, c = np.moveaxis(places[of[part]], 1, 0)
            j, k = weight[part, :1], weight[part, 1:]
            uv, _ = project(view.camera, a + j * (b - a) + k * (c - a))
            flat[texel[part]] = np.rint(sample_bilinear(smaller, (uv + 0.5) * 0.5**level - 0.5))
            mask[texel[part]] = True


def fill_gutters(page: Image, filled: Bool, gutter: int) -> None:
    """Extends colors outwards by `gutter` texels and fills the rest with their mean; in place.

    So filtering between texels shows no seams.

    Args:
        page: (h, w, 3).
        filled: (h, w) texels that have a color; extended as well.
        gutter: texels.
    """
    if not filled.any():
        page[:] = GRAY
        return
    mean = np.rint(page[filled].mean(axis=0)).astype(np.uint8)
    away, nearest = ndimage.distance_transform_cdt(~filled, "chessboard", return_indices=True)
    row, column = np.nonzero((away > 0) & (away <= gutter))
    page[row, column] = page[nearest[0][row, column], nearest[1][row, column]]
    filled[row, column] = True
    page[~filled] = mean


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
        self._of, self._max_distance = textured, max_distance
        self._mesh = Mesh(textured.vertices, textured.faces)
        self._normals = self._mesh.normals()
        self._triangles: Any = import_extra("trimesh.triangles", "mesh.glb", "made", group="mesh")
        shown = np.flatnonzero((textured.view >= 0) & (textured.page >= 0))
        samples, of = subdivide(self._mesh.select(shown), _SAMPLE_EDGE)
        self._face = shown[of]
        self._samples = cKDTree(samples.centers)

    def colors(self, points: Float, origins: Float) -> tuple[Image, Bool]:
        """(n, 3) uint8 colors, none of them GRAY, and whether (n,) there are any.

        The color at the closest place on faces that face the point's sensor.

        Args:
            points: (n, 3) metres.
            origins: (n, 3) position of the sensor for each.
        """
        face, weight = self._closest_faces(points, origins)
        out = np.zeros((len(points), 3), np.uint8)
        for page, texels in enumerate(self._of.pages):
            mine = np.flatnonzero((face >= 0) & (self._of.page[face] == page))
            uv = np.einsum("nk,nkd->nd", weight[mine], self._of.uv[self._of.faces[face[mine]]])
            h, w = texels.shape[:2]
            out[mine] = np.rint(sample_bilinear(texels, uv * np.array([w, h], np.float64) - 0.5))
        return avoid_gray(out), face >= 0

    def _closest_faces(self, points: Float, origins: Float) -> tuple[Index, Float]:
        """(n,) the textured face, -1: none, and (n, 3) the weights of its corners at the place."""
        best, face = np.full(len(points), np.inf), np.full(len(points), -1)
        weight = np.zeros((len(points), 3))
        reach = self._max_distance + _SAMPLE_EDGE
        _, nearest = self._samples.query(points, _SAMPLES, distance_upper_bound=reach)
        for sample in np.asarray(nearest).T:
            some = np.flatnonzero(sample < self._samples.n)
            mine = self._face[sample[some]]
            share = self._triangles.points_to_barycentric(self._mesh.corners[mine], points[some])
            share = np.maximum(share, 0.0)
            share /= share.sum(axis=1, keepdims=True)
            place = np.einsum("nk,nkd->nd", share, self._mesh.corners[mine])
            away = row_lengths(points[some] - place)
            facing = np.einsum("nd,nd->n", self._normals[mine], origins[some] - place) > 0.0
            better = facing & (away <= self._max_distance) & (away < best[some])
            best[some[better]], face[some[better]] = away[better], mine[better]
            weight[some[better]] = share[better]
        return face, weight


def avoid_gray(colors: Image) -> Image:
    """(n, 3) the colors with GRAY, which means that there is none, replaced by its neighbor."""
    is_gray = (colors == GRAY).all(axis=1, keepdims=True)
    return np.where(is_gray, np.array(_OTHER_GRAY, np.uint8), colors)
