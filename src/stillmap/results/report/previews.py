"""Rendered previews of the models: the place with and without moving objects (Fig. 11), and the
objects (Fig. 13)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from stillmap.mesh.texture.atlas import TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.results.report.figures import data_uri
from stillmap.results.report.renderer import (
    Float,
    Picture,
    camera_matrix,
    fit_camera,
    main_corners,
    render,
    visible_share,
)

PLACE_SIZE, OBJECT_SIZE = (640, 400), (300, 225)  # pixels
MAX_OBJECTS = 8
_MAX_CANDIDATES = 24  # camera poses tried for the views of the place
_REDUCTION = 8  # of the image size while trying
_MIN_DIFFERENCE = 60  # sum over RGB from which a pixel differs between the two textures
_TEXTURED_WEIGHT = 0.1  # of textured pixels against differing ones
_MIN_SEPARATION = 0.2  # of the two views, as a share of the camera poses
# field of view: place; overview and objects
_WIDE, _NARROW = math.radians(80.0), math.radians(45.0)
_OVERVIEW = np.array([-0.5, -0.75, 0.7])  # from the place to the camera
_OUTLIERS = 0.02  # share of the visible area beyond each side of the overview
# yaw of the camera around an object that looks along x
_SIDES = {
    "front": math.radians(-35.0),
    "left": math.radians(85.0),
    "rear": math.radians(205.0),
    "right": math.radians(-95.0),
}
_ELEVATION = math.radians(20.0)
_MAX_SIDES = 3
_MIN_FRONT_FACES = 0.5  # share of a view's pixels; the rest would be back faces
_JPEG_QUALITY = 85


@dataclass(frozen=True, eq=False)
class PlacePreview:
    """The place from one camera pose.

    Attributes:
        caption: which view it is.
        filtered: (h, w, 3) uint8, textured without moving objects.
        sharpest: the same, each face textured from its sharpest image; None where not computed.
    """

    caption: str
    filtered: Picture
    sharpest: Picture | None


@dataclass(frozen=True, eq=False)
class ObjectPreviews:
    """A moving object.

    Attributes:
        number: its id.
        size: length, width and height of its model in m.
        sides: (h, w, 3) uint8 by side.
    """

    number: int
    size: tuple[float, float, float]
    sides: dict[str, Picture]


@dataclass(frozen=True, eq=False)
class ModelPreviews:
    """All previews.

    Attributes:
        place: of the static surface.
        objects: of moving objects.
        untextured: share of the surface without texture.
        untextured_reason: why no image could texture anything; empty where one could.
    """

    place: list[PlacePreview]
    objects: list[ObjectPreviews]
    untextured: float
    untextured_reason: str = ""


def render_previews(
    filtered: TexturedMesh,
    sharpest: TexturedMesh | None,
    T_camera_map: Float,
    objects: Mapping[int, TexturedMesh],
    threads: int = 1,
    unusable: Mapping[str, int] | None = None,
) -> ModelPreviews:
    """Two views from the robot's cameras, an overview, and up to three sides of each object.

    Args:
        filtered: the place, textured without moving objects.
        sharpest: the place, each face textured from its sharpest image.
        T_camera_map: (N, 4, 4) camera poses of the usable images, in order of time.
        objects: by id, x ahead and z up in their own frames; the best textured ones are shown.
        threads: the result does not depend on them.
        unusable: number of other images by the reason why they cannot be used.
    """
    place = list[PlacePreview]()

    def add(caption: str, T: Float, field_of_view: float, back_faces: bool) -> None:
        K = camera_matrix(PLACE_SIZE, field_of_view)
        pictures = [
            render(one, T, K, PLACE_SIZE, back_faces=back_faces, threads=threads)
            for one in (filtered, sharpest)
            if one is not None
        ]
        place.append(
            PlacePreview(caption, pictures[0], pictures[1] if sharpest is not None else None)
        )

    if len(filtered):
        for T in _choose_views(filtered, sharpest, T_camera_map, threads):
            add("view of the robot's camera", T, _WIDE, True)
        points = main_corners(filtered, _OVERVIEW, _OUTLIERS)
        K = camera_matrix(PLACE_SIZE, _NARROW)
        add("overview", fit_camera(points, _OVERVIEW, K, PLACE_SIZE), _NARROW, False)
    rank = {n: _areas(one) for n, one in objects.items() if len(one)}
    shown = sorted(rank, key=lambda n: rank[n], reverse=True)[:MAX_OBJECTS]
    textured, total = _areas(filtered)
    return ModelPreviews(
        place,
        [render_object(n, objects[n], threads) for n in shown],
        (total - textured) / max(total, 1e-12),
        _untextured_reason(len(T_camera_map), len(filtered.unread), unusable or {}),
    )


def _untextured_reason(usable: int, unread: int, unusable: Mapping[str, int]) -> str:
    if usable > unread:
        return ""
    reasons = dict(unusable) | ({"damaged": unread} if unread else {})
    if not reasons:
        return "there are no images"
    listed = "; ".join(f"{count:,}: {why}" for why, count in reasons.items())
    return f"none of the {sum(reasons.values()):,} images can be used ({listed})"


def _areas(textured: TexturedMesh) -> tuple[float, float]:
    """Textured and total area in m^2."""
    areas = Mesh(textured.vertices, textured.faces).areas()
    return float(areas[textured.page >= 0].sum()), float(areas.sum())


def _choose_views(
    filtered: TexturedMesh, sharpest: TexturedMesh | None, T_camera_map: Float, threads: int
) -> list[Float]:
    """Two camera poses, apart in time, with most pixels that differ between both textures."""
    N = len(T_camera_map)
    candidates = np.unique(np.linspace(0, N - 1, min(N, _MAX_CANDIDATES)).astype(np.intp)).tolist()
    size = (PLACE_SIZE[0] // _REDUCTION, PLACE_SIZE[1] // _REDUCTION)
    K = camera_matrix(size, _WIDE)
    score = dict[int, float]()
    for n in candidates:
        T = T_camera_map[n]
        score[n] = _TEXTURED_WEIGHT * visible_share(
            filtered, T, K, size, textured_only=True, threads=threads
        )
        if sharpest is not None:
            a, b = (render(one, T, K, size, threads=threads) for one in (filtered, sharpest))
            difference = np.abs(a.astype(np.int64) - b).sum(axis=2)
            score[n] += float((difference > _MIN_DIFFERENCE).mean())
    chosen: list[int] = []
    for n in sorted(score, key=lambda n: (-score[n], n)):
        if len(chosen) < 2 and all(abs(n - other) >= _MIN_SEPARATION * N for other in chosen):
            chosen.append(n)
    return [T_camera_map[n] for n in sorted(chosen)]


def render_object(number: int, textured: TexturedMesh, threads: int = 1) -> ObjectPreviews:
    """The up to three sides that show most of an object's front faces.

    Back faces are not drawn; a side that would show mostly back faces is left out.
    """
    used, K = textured.vertices[np.unique(textured.faces)], camera_matrix(OBJECT_SIZE, _NARROW)
    poses, front, eligible = dict[str, Float](), dict[str, float](), list[str]()
    for side, yaw in _SIDES.items():
        direction = np.array([math.cos(yaw), math.sin(yaw), math.tan(_ELEVATION)])
        poses[side] = T = fit_camera(used, direction, K, OBJECT_SIZE)
        front[side], both = (
            visible_share(textured, T, K, OBJECT_SIZE, back_faces=back_faces, threads=threads)
            for back_faces in (False, True)
        )
        if front[side] >= _MIN_FRONT_FACES * both:
            eligible.append(side)
    ranked = sorted(front, key=lambda side: front[side], reverse=True)
    shown = [side for side in ranked if side in eligible][:_MAX_SIDES] or ranked[:1]
    length, width, height = np.ptp(used, axis=0).tolist()
    sides = {
        side: render(textured, poses[side], K, OBJECT_SIZE, back_faces=False, threads=threads)
        for side in _SIDES
        if side in shown
    }
    return ObjectPreviews(number, (length, width, height), sides)


def models_data(previews: ModelPreviews | None) -> dict[str, Any] | None:
    """The previews as rows of figures for the report; None where there are none."""
    if previews is None or not (previews.place or previews.objects):
        return None
    filtered = "Surface" if previews.untextured_reason else "Filtered"
    return {
        "place": [
            [
                _figure(title, one.caption, picture)
                for title, picture in (("Sharpest image", one.sharpest), (filtered, one.filtered))
                if picture is not None
            ]
            for one in previews.place
        ],
        "compared": any(one.sharpest is not None for one in previews.place),
        "untextured": previews.untextured,
        "untextured_reason": previews.untextured_reason,
        "objects": [
            [
                _figure(
                    f"Object {one.number}",
                    " x ".join(f"{v:.2f}" for v in one.size) + f" m, {side}",
                    picture,
                )
                for side, picture in one.sides.items()
            ]
            for one in previews.objects
        ],
        "max_sides": _MAX_SIDES,
    }


def _figure(title: str, caption: str, picture: Picture) -> tuple[str, str, str, tuple[int, ...]]:
    """Title, caption, JPEG as a `data:` URI, width and height."""
    uri = data_uri(Image.fromarray(picture), "jpeg", quality=_JPEG_QUALITY)
    return title, caption, uri, picture.shape[1::-1]
