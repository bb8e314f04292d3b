"""Scores of a textured mesh against a simulation: its surface, and the sources of its texture.

Shares are of areas, estimated at points that are uniform over the area.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Camera, is_in_image, project
from stillmap.core.errors import import_extra
from stillmap.eval import mesh_distance
from stillmap.eval.labels import NAN, Bool, Float, Scores, mean
from stillmap.eval.true_surfaces import project_to_static
from stillmap.sim.appearance import compute_static_color
from stillmap.sim.camera import SKY
from stillmap.sim.geometry import StaticSurfaces

Index = NDArray[np.int32]

SAMPLES = 200_000
COMPLETE = 0.05  # m
GREY, STATIC, NOTHING = -3, -1, -2  # source of a sample without texture, no mover, or the sky
_MIN_COSINE = 0.17  # of the viewing angle: 80 degrees
_TOLERANCE, _MAX_TOLERANCE = 0.05, 0.5  # m between a surface and the depth of its pixel


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
    on_mesh = mesh_distance.sample_surface(vertices, faces, SAMPLES).points
    distance, _ = project_to_static(standing, transform_points(T_world_map, on_mesh))
    in_world = transform_points(T_world_map, vertices)
    gaps = mesh_distance.distance_to_mesh(places, in_world, faces, COMPLETE)
    return SurfaceScores(
        faces=len(faces),
        area=float(mesh_distance.triangle_areas(vertices, faces).sum()),
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
    on_mesh = mesh_distance.sample_surface(record.vertices, record.faces, SAMPLES)
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
    record: TextureRecord, samples: mesh_distance.SurfaceSamples, pictures: TrueImages
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
    samples: mesh_distance.SurfaceSamples,
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
    normals = mesh_distance.triangle_normals(vertices, record.faces)[samples.face]
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
