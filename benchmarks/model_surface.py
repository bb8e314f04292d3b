"""Scores of a textured mesh against a simulation: its surface, and the sources of its texture.

Shares are of areas, estimated at points that are uniform over the area.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray
from true_surfaces import project_to_static

from stillmap.core.camera import Camera, is_in_image, project
from stillmap.core.errors import import_extra
from stillmap.results.eval.labels import NAN, Bool, Float, Scores, mean
from stillmap.sim.camera import SKY, compute_static_color
from stillmap.sim.geometry import StaticSurfaces

Index = NDArray[np.int32]
_CANDIDATES = 6  # triangles per point whose exact distance is computed
_BLOCK = 1 << 18  # points processed at once
_MAX_SAMPLES = 1 << 24  # of the lattice of a mesh
_TILE, _OVERLAP = 20.0, 2.0  # m, edge of a tile of a large mesh, and overlap of tiles
SAMPLES = 200_000
COMPLETE = 0.05  # m
GREY, STATIC, NOTHING = -3, -1, -2  # source of a sample without texture, no mover, or the sky
_MIN_COSINE = 0.17  # of the viewing angle: 80 degrees
_TOLERANCE, _MAX_TOLERANCE = 0.05, 0.5  # m between a surface and the depth of its pixel


class SurfaceSamples(NamedTuple):
    """n points on triangles.

    Attributes:
        points: (n, 3) metres.
        face: (n,) triangle of each.
        weight: (n, 3) barycentric coordinates.
    """

    points: Float
    face: NDArray[np.intp]
    weight: Float


def triangle_areas(vertices: Float, faces: Index) -> Float:
    """(F,) square metres."""
    return 0.5 * np.asarray(np.linalg.norm(_cross_products(vertices, faces), axis=1))


def triangle_normals(vertices: Float, faces: Index) -> Float:
    """(F, 3) unit normals; zero of triangles without area."""
    across = _cross_products(vertices, faces)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(across / np.where(length > 0.0, length, 1.0))


def sample_surface(vertices: Float, faces: Index, n: int, seed: int = 0) -> SurfaceSamples:
    """n points, uniform over the area, the same at every call.

    Triangles are sampled in order at even steps of area, so that the error of a share of the area
    is about 1 / n, not 1 / sqrt(n).
    """
    total = np.cumsum(triangle_areas(vertices, faces))
    if not len(total) or not total[-1] > 0.0:
        return SurfaceSamples(np.empty((0, 3)), np.empty(0, np.intp), np.empty((0, 3)))
    rng = np.random.default_rng(seed)
    at = (np.arange(n) + rng.random(n)) * (total[-1] / n)
    face = np.minimum(np.searchsorted(total, at, side="right"), len(faces) - 1)
    root, share = np.sqrt(rng.random(n)), rng.random(n)
    weight = np.stack([1.0 - root, root * (1.0 - share), root * share], axis=1)
    return SurfaceSamples(_at(vertices, faces, face, weight), face, weight)


def sample_lattice(vertices: Float, faces: Index, spacing: float) -> SurfaceSamples:
    """Points on a lattice within each triangle, at most `spacing` metres apart."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(longest / spacing), 1).astype(np.int64)
    if int((steps * steps).sum()) > _MAX_SAMPLES:
        raise ValueError(f"spacing: {spacing} m is too fine for so large a mesh")
    of_face, weights = [np.empty(0, np.intp)], [np.empty((0, 3))]
    for n in np.unique(steps).tolist():
        some, cell = np.flatnonzero(steps == n), _subtriangle_centers(n)
        of_face.append(np.repeat(some, len(cell)))
        weights.append(np.tile(cell, (len(some), 1)))
    face, weight = np.concatenate(of_face), np.concatenate(weights)
    return SurfaceSamples(_at(vertices, faces, face, weight), face, weight)


def distance_to_mesh(points: Float, vertices: Float, faces: Index, spacing: float) -> Float:
    """(n,) metres from points (n, 3) to the nearest triangle.

    Exact up to `spacing` except for slivers, because only the triangles with the nearest lattice
    points are candidates; beyond, possibly too large. Of a large mesh, points without a triangle
    within some metres have infinite distance.
    """
    out = np.full(len(points), np.inf)
    if not len(faces) or not len(points):
        return out
    corners = vertices[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    if float(np.ptp(vertices[np.unique(faces)][:, :2], axis=0).max()) <= _TILE:
        return _distance_to_tile(points, vertices, faces, spacing)
    tiles, of = np.unique(np.floor(points[:, :2] / _TILE), axis=0, return_inverse=True)
    for number, tile in enumerate(tiles):
        first, last = tile * _TILE - _OVERLAP, (tile + 1.0) * _TILE + _OVERLAP
        near = ((low[:, :2] <= last) & (high[:, :2] >= first)).all(axis=1)
        mine = np.flatnonzero(of.ravel() == number)
        out[mine] = _distance_to_tile(points[mine], vertices, faces[near], spacing)
    return out


def _distance_to_tile(points: Float, vertices: Float, faces: Index, spacing: float) -> Float:
    """(n,) metres to the nearest triangle of a mesh that is not large."""
    out = np.full(len(points), np.inf)
    if not len(faces):
        return out
    of_mesh = sample_lattice(vertices, faces, spacing)
    tree = scipy.spatial.cKDTree(of_mesh.points)
    few = min(_CANDIDATES, len(of_mesh.points))
    for first in range(0, len(points), _BLOCK):
        block = points[first : first + _BLOCK]
        _, near = tree.query(block, k=list(range(1, few + 1)))
        for column in of_mesh.face[near].T:
            found = _distance_to_triangles(block, vertices[faces[column]])
            np.minimum(out[first : first + _BLOCK], found, out=out[first : first + _BLOCK])
    return out


def first_per_voxel(points: Float, size: float) -> NDArray[np.intp]:
    """Indices, rising, of the first point in each voxel of edge `size`."""
    _, first = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)


def _cross_products(vertices: Float, faces: Index) -> Float:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def _at(vertices: Float, faces: Index, face: NDArray[np.intp], weight: Float) -> Float:
    return np.asarray(np.einsum("nk,nkd->nd", weight, vertices[faces[face]]))


def _subtriangle_centers(n: int) -> Float:
    """(n * n, 3) barycentric centers of the equal parts of a triangle whose sides are cut in n."""
    i, j = (one.ravel() for one in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    upward, downward = i + j < n, i + j < n - 1
    first = np.concatenate([i[upward] + 1 / 3, i[downward] + 2 / 3]) / n
    second = np.concatenate([j[upward] + 1 / 3, j[downward] + 2 / 3]) / n
    return np.stack([1.0 - first - second, first, second], axis=1)


def _distance_to_triangles(points: Float, corners: Float) -> Float:
    """(n,) metres from each point (n, 3) to its triangle (n, 3, 3)."""
    closest = import_extra("trimesh.triangles", "mesh", "compared with the truth", group="mesh")
    return np.asarray(np.linalg.norm(closest.closest_point(corners, points) - points, axis=1))


@dataclass(frozen=True)
class SurfaceScores(Scores):
    """Distances between a mesh and the static surfaces, metres. NaN: nothing to compare.

    Attributes:
        faces, area: of the mesh, square metres.
        mean, p95: distance of its points from the true surface.
        complete: share of the observed surface points within 5 cm of the mesh.
        places: number of observed surface points.
    """

    faces: int
    area: float
    mean: float
    p95: float
    complete: float
    places: int


@dataclass(frozen=True)
class TextureScores(Scores):
    """Sources and colors of a texture. NaN where there is nothing to compare.

    Attributes:
        textured: share of the area with a texture.
        mover: share of the textured area that shows a mover.
        nothing: share of the textured area that shows the sky.
        in_view: share of the area that some image shows, not occluded by a mover.
        covered: share of the area in view with a texture.
        colour_median, colour_p95: CIEDE2000 between texture and true color.
    """

    textured: float
    mover: float
    nothing: float
    in_view: float
    covered: float
    colour_median: float
    colour_p95: float


class TextureRecord(NamedTuple):
    """The source image of each triangle of a model.

    Attributes:
        vertices: (V, 3) metres, in the frame of the model: the map, or an object.
        faces: (F, 3).
        image: (F,) image number; -1: none.
        T_camera_model: (N, 4, 4) from that frame to the camera's, NaN of unused images.
    """

    vertices: Float
    faces: Index
    image: Index
    T_camera_model: Float


class TrueImages(NamedTuple):
    """N images with their truth.

    Attributes:
        cameras: the cameras.
        camera: (N,) camera of each.
        T_world_camera: (N, 4, 4) true poses.
        mask, distance: of an image, see `sim.ImageTruth`.
    """

    cameras: Sequence[Camera]
    camera: Index
    T_world_camera: Float
    mask: Callable[[int], NDArray[np.uint16]]
    distance: Callable[[int], NDArray[np.float32]]


class ColoredPoints(NamedTuple):
    """Points (n, 3) of a texture, in the map frame, and their colors (n, 3) uint8."""

    points: Float
    color: NDArray[np.uint8]


def score_surface(
    vertices: Float, faces: Index, standing: StaticSurfaces, places: Float, T_world_map: Float
) -> SurfaceScores:
    """Score a surface.

    Args:
        vertices, faces: (V, 3) metres in the map frame, (F, 3).
        standing: the true surfaces.
        places: (n, 3) observed points on them, in the world.
        T_world_map: (4, 4).
    """
    on_mesh = sample_surface(vertices, faces, SAMPLES).points
    distance, _ = project_to_static(standing, transform_points(T_world_map, on_mesh))
    in_world = transform_points(T_world_map, vertices)
    gaps = distance_to_mesh(places, in_world, faces, COMPLETE)
    return SurfaceScores(
        faces=len(faces),
        area=float(triangle_areas(vertices, faces).sum()),
        mean=mean(distance),
        p95=float(np.percentile(distance, 95)) if len(distance) else NAN,
        complete=mean(gaps <= COMPLETE),
        places=len(places),
    )


def score_texture(
    record: TextureRecord,
    coloured: ColoredPoints,
    pictures: TrueImages,
    standing: StaticSurfaces,
    colour_seed: int,
    T_world_map: Float,
    max_distance: float = float("inf"),
) -> TextureScores:
    """Score the texture of a surface.

    Args:
        record: of the model in the map frame.
        coloured: points of its texture.
        pictures: the images.
        standing, colour_seed: the true surfaces and their colors.
        T_world_map: (4, 4).
        max_distance: metres, beyond which an image does not show a surface.
    """
    on_mesh = sample_surface(record.vertices, record.faces, SAMPLES)
    source = look_up_texture_source(record, on_mesh, pictures)
    in_view = find_visible_samples(record, on_mesh, pictures, T_world_map, max_distance)
    textured = source != GREY
    error = compute_color_errors(coloured, standing, colour_seed, T_world_map)
    return TextureScores(
        textured=mean(textured),
        mover=mean(source[textured] >= 0),
        nothing=mean(source[textured] == NOTHING),
        in_view=mean(in_view),
        covered=mean(textured[in_view]),
        colour_median=float(np.median(error)) if len(error) else NAN,
        colour_p95=float(np.percentile(error, 95)) if len(error) else NAN,
    )


def look_up_texture_source(
    record: TextureRecord, samples: SurfaceSamples, pictures: TrueImages
) -> NDArray[np.int64]:
    """(n,) what the texture shows: a mover's number, STATIC, NOTHING (the sky) or GREY (no image).

    Samples outside of their image are GREY as well.
    """
    image, out = record.image[samples.face], np.full(len(samples.face), GREY)
    for number in np.unique(image[image >= 0]).tolist():
        some = np.flatnonzero(image == number)
        points = transform_points(record.T_camera_model[number], samples.points[some])
        pixel, inside = _pixels(pictures.cameras[pictures.camera[number]], points)
        column, row = pixel[inside].T
        value = pictures.mask(number)[row, column].astype(np.int64)
        out[some[inside]] = np.where(value == SKY, NOTHING, value - 1)
    return out


def find_visible_samples(
    record: TextureRecord,
    samples: SurfaceSamples,
    pictures: TrueImages,
    T_world_map: Float,
    max_distance: float = float("inf"),
) -> Bool:
    """(n,) whether some image shows a sample, not occluded by a mover.

    The surface faces the camera within 80 degrees and `max_distance` metres, and its distance
    agrees with the true depth of the pixel to 5 cm and a pixel.
    """
    points = transform_points(T_world_map, samples.points)
    vertices = transform_points(T_world_map, record.vertices)
    normals = triangle_normals(vertices, record.faces)[samples.face]
    out = np.zeros(len(points), bool)
    for number, T_world_camera in enumerate(pictures.T_world_camera):
        camera, center = pictures.cameras[pictures.camera[number]], T_world_camera[:3, 3]
        assert camera.K is not None
        left = np.flatnonzero(~out)
        towards = center - points[left]
        away = np.linalg.norm(towards, axis=1)
        cosine = (towards * normals[left]).sum(axis=1) / np.maximum(away, 1e-9)
        use = (cosine >= _MIN_COSINE) & (away <= max_distance)
        left, away, cosine = left[use], away[use], cosine[use]
        in_camera = transform_points(np.linalg.inv(T_world_camera), points[left])
        pixel, inside = _pixels(camera, in_camera)
        column, row = pixel[inside].T
        left, away, cosine = left[inside], away[inside], cosine[inside]
        off = np.abs(pictures.distance(number)[row, column] - away)
        limit = np.minimum((_TOLERANCE + away / camera.K[0, 0]) / cosine, _MAX_TOLERANCE)
        out[left] = (pictures.mask(number)[row, column] == 0) & (off <= limit)
    return out


def compute_color_errors(
    coloured: ColoredPoints, standing: StaticSurfaces, colour_seed: int, T_world_map: Float
) -> Float:
    """(n,) CIEDE2000 between a texture and the true color of the nearest static surface.

    Raises:
        MissingExtra: scikit-image is not installed.
    """
    _, places = project_to_static(standing, transform_points(T_world_map, coloured.points))
    return compute_color_difference(coloured.color, compute_static_color(places, colour_seed))


def compute_color_difference(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> Float:
    """(n,) CIEDE2000 between sRGB colors (n, 3)."""
    color = import_extra("skimage.color", "texture", "compared with the truth", group="mesh")
    labs = [color.rgb2lab(colour[None]) for colour in (one, other)]
    return np.asarray(color.deltaE_ciede2000(*labs)[0], np.float64)


def transform_points(T: Float, points: Float) -> Float:
    """(n, 3) points transformed by T (4, 4)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _pixels(camera: Camera, points: Float) -> tuple[NDArray[np.int64], Bool]:
    """Nearest pixels (n, 2) of points in the camera frame, and whether they lie in the image."""
    uv, ahead = project(camera, points)
    inside = ahead & is_in_image(camera, uv)
    return np.rint(np.where(inside[:, None], uv, 0.0)).astype(np.int64), inside
