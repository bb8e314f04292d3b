"""The report's part on models: stills of the place as it was, and without its people (Fig. 11), and
of what moved (Fig. 13)."""

import base64
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np
from PIL import Image

from stillmap.mesh.texture.atlas import TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.results.report.renderer import (
    Float,
    Picture,
    camera_matrix,
    covered_share,
    fit_camera,
    main_corners,
    render,
    textured_share,
)
from stillmap.results.report.tables import share_text

PLACE_SIZE, OBJECT_SIZE = (640, 400), (300, 225)  # pixels
MOST_OBJECTS = 8
_TRIED = 24  # places along the way from which a still may be taken
_SMALL = 8  # pixels along an edge for one that is tried
_DIFFERS = 60  # of 3 x 255: somebody stood there
_LITTLE = 0.1  # a pixel that is painted counts as this many in which somebody stood
_APART = 0.2  # of the way between two stills along it
_WIDE, _NARROW = math.radians(80.0), math.radians(45.0)  # of a still along the way, of the others
_ABOVE = np.array([-0.5, -0.75, 0.7])  # from where the whole is seen
_OUTER = 0.02  # of the area of what is seen then that may lie beyond each edge
# of things, turned left from ahead
_SIDES = {
    "from ahead": math.radians(-35.0),
    "from its left": math.radians(85.0),
    "from behind": math.radians(205.0),
    "from its right": math.radians(-95.0),
}
_MOST_SIDES = 3
_FRONTS = 0.5  # of what there is to be seen from a side, where the rest are backs
_RAISED = math.radians(20.0)
_QUALITY = 85  # of JPEG: photographs, which as PNG would be several megabytes


@dataclass(frozen=True, eq=False)
class PlacePreview:
    """The place from one point.

    Attributes:
        caption: from where.
        filtered: (h, w, 3) uint8.
        sharpest: the same with every face painted by its sharpest picture, whoever stood there;
            None where nobody asked for it.
    """

    caption: str
    filtered: Picture
    sharpest: Picture | None


@dataclass(frozen=True, eq=False)
class ObjectPreviews:
    """What moved.

    Attributes:
        number: of the object.
        size: metres, length, width and height of its model.
        sides: by side, (h, w, 3) uint8.
    """

    number: int
    size: tuple[float, float, float]
    sides: dict[str, Picture]


@dataclass(frozen=True, eq=False)
class ModelPreviews:
    """What the report shows of models.

    Attributes:
        place: of the place.
        objects: of what moved.
        unpainted: share of the surface that no picture shows without somebody before it.
        why_bare: why no picture paints anything, where none can; else empty.
    """

    place: list[PlacePreview]
    objects: list[ObjectPreviews]
    unpainted: float
    why_bare: str = ""


def render_previews(
    filtered: TexturedMesh,
    sharpest: TexturedMesh | None,
    T_camera_map: Float,
    objects: Mapping[int, TexturedMesh],
    threads: int = 1,
    left_out: Mapping[str, int] | None = None,
) -> ModelPreviews:
    """Two stills along the way, one from above, and up to three of each of the objects of which
    most is painted.

    Args:
        filtered: the place, painted without its people.
        sharpest: the same, each face by its sharpest picture.
        T_camera_map: (N, 4, 4) of pictures that were taken on the way, in order.
        objects: what moved, by number, x ahead and z up in its own frame.
        threads: the result does not depend on them.
        left_out: how many other pictures there are, by why they cannot be used.
    """
    areas, place = Mesh(filtered.vertices, filtered.faces).areas(), list[PlacePreview]()

    def taken(caption: str, T: Float, angle: float, from_behind: bool) -> PlacePreview:
        K = camera_matrix(PLACE_SIZE, angle)
        pictures = [
            render(one, T, K, PLACE_SIZE, from_behind=from_behind, threads=threads)
            for one in (filtered, sharpest)
            if one is not None
        ]
        return PlacePreview(caption, pictures[0], pictures[1] if sharpest is not None else None)

    if len(filtered):
        along = _along(filtered, sharpest, T_camera_map, threads)
        place += [taken("where the robot looked", T, _WIDE, True) for T in along]
        place.append(taken("from above", _from_above(filtered), _NARROW, False))
    worth = {n: _extent(one) for n, one in objects.items() if len(one)}
    shown = sorted(worth, key=lambda n: worth[n], reverse=True)[:MOST_OBJECTS]
    return ModelPreviews(
        place,
        [render_object(n, objects[n], threads) for n in shown],
        float(areas[filtered.page < 0].sum() / max(float(areas.sum()), 1e-12)),
        _why_bare(len(T_camera_map), len(filtered.unread), left_out or {}),
    )


def _why_bare(usable: int, unread: int, left_out: Mapping[str, int]) -> str:
    """Why there is no picture that could paint anything; empty where there is one."""
    if usable > unread:
        return ""
    reasons = dict(left_out) | ({"damaged": unread} if unread else {})
    if not reasons:
        return "there are no pictures"
    listed = "; ".join(f"{count:,}: {why}" for why, count in reasons.items())
    return f"none of the {sum(reasons.values()):,} pictures can be used ({listed})"


def _extent(textured: TexturedMesh) -> tuple[float, float]:
    """Square metres of a model that are painted, and all of them."""
    areas = Mesh(textured.vertices, textured.faces).areas()
    return float(areas[textured.page >= 0].sum()), float(areas.sum())


def render_object(number: int, textured: TexturedMesh, threads: int = 1) -> ObjectPreviews:
    """An object from up to three sides, x ahead and z up in its frame: those from which most of it
    is seen, and more of its fronts than of its backs, as only fronts are drawn."""
    used, K = textured.vertices[np.unique(textured.faces)], camera_matrix(OBJECT_SIZE, _NARROW)
    places, fronts, mostly_front = dict[str, Float](), dict[str, float](), list[str]()
    for side, angle in _SIDES.items():
        towards = np.array([math.cos(angle), math.sin(angle), math.tan(_RAISED)])
        places[side] = T = fit_camera(used, towards, K, OBJECT_SIZE)
        fronts[side], whole = (
            covered_share(textured, T, K, OBJECT_SIZE, from_behind=backs, threads=threads)
            for backs in (False, True)
        )
        if fronts[side] >= _FRONTS * whole:
            mostly_front.append(side)
    best = sorted(fronts, key=lambda side: fronts[side], reverse=True)
    shown = [side for side in best if side in mostly_front][:_MOST_SIDES] or best[:1]
    length, width, height = np.ptp(used, axis=0).tolist()
    sides = {
        side: render(textured, places[side], K, OBJECT_SIZE, from_behind=False, threads=threads)
        for side in _SIDES
        if side in shown
    }
    return ObjectPreviews(number, (length, width, height), sides)


def model_section(stills: ModelPreviews | None) -> str:
    """Everything about models; empty where there are none."""
    if stills is None or not (stills.place or stills.objects):
        return ""
    text = "<section><h2>What it looks like</h2>"
    if stills.place:
        text += f"<p>{escape(_sentence(stills))}</p>"
        title = "Surface" if stills.why_bare else "Filtered"
        text += "".join(_pair(one, title) for one in stills.place)
    if stills.objects:
        text += (
            f"<p>What moved, each from up to {_MOST_SIDES} sides, with length, width and height of "
            "its model; all are in <code>objects/</code>. Surfaces have one side, that which was "
            "seen: where more backs than fronts would be in the picture, it is left out.</p>"
        )
        text += "".join(_sides(one) for one in stills.objects)
    return text + "</section>"


def jpeg_uri(picture: Picture) -> str:
    """The picture as a `data:` address."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _sentence(stills: ModelPreviews) -> str:
    if stills.why_bare:
        return f"The surface that stands still. It is grey: {stills.why_bare}."
    grey = (
        f"Grey is what no picture shows with nobody before it, {share_text(stills.unpainted)} of "
        "the surface."
    )
    if any(one.sharpest is not None for one in stills.place):
        return (
            "The surface that stands still: left as the sharpest pictures would paint it, right by "
            f"those in which nothing that moves is before it. {grey}"
        )
    return f"The surface that stands still, painted by pictures without what moves. {grey}"


def _pair(one: PlacePreview, title: str) -> str:
    shown = [("Sharpest", one.sharpest), (title, one.filtered)]
    figures = "".join(
        _figure(title, one.caption, picture) for title, picture in shown if picture is not None
    )
    return f'<div class="pair">{figures}</div>'


def _sides(one: ObjectPreviews) -> str:
    size = " x ".join(f"{metres:.2f}" for metres in one.size) + " m"
    figures = "".join(
        _figure(f"Object {one.number}", f"{size}, {side}", picture)
        for side, picture in one.sides.items()
    )
    return f'<div class="row sides">{figures}</div>'


def _figure(title: str, caption: str, picture: Picture) -> str:
    height, width = picture.shape[:2]
    return (
        f"<figure><figcaption><b>{escape(title)}</b>: {escape(caption)}</figcaption>"
        f'<img class="still" src="{jpeg_uri(picture)}" alt="{escape(f"{title}: {caption}")}" '
        f'width="{width}" height="{height}"></figure>'
    )


def _along(
    filtered: TexturedMesh, sharpest: TexturedMesh | None, T_camera_map: Float, threads: int
) -> list[Float]:
    """Two of the places, apart, from which most of the picture is painted, and most of all where
    somebody was taken out."""
    N = len(T_camera_map)
    tried = np.unique(np.linspace(0, N - 1, min(N, _TRIED)).astype(np.intp)).tolist()
    size = (PLACE_SIZE[0] // _SMALL, PLACE_SIZE[1] // _SMALL)
    K = camera_matrix(size, _WIDE)
    worth = dict[int, float]()
    for n in tried:
        T = T_camera_map[n]
        worth[n] = _LITTLE * textured_share(filtered, T, K, size, threads)
        if sharpest is not None:
            a, b = (render(one, T, K, size, threads=threads) for one in (filtered, sharpest))
            apart = np.abs(a.astype(np.int64) - b).sum(axis=2)
            worth[n] += float((apart > _DIFFERS).mean())
    chosen: list[int] = []
    for n in sorted(worth, key=lambda n: (-worth[n], n)):
        if len(chosen) < 2 and all(abs(n - other) >= _APART * N for other in chosen):
            chosen.append(n)
    return [T_camera_map[n] for n in sorted(chosen)]


def _from_above(textured: TexturedMesh) -> Float:
    points = main_corners(textured, _ABOVE, _OUTER)
    return fit_camera(points, _ABOVE, camera_matrix(PLACE_SIZE, _NARROW), PLACE_SIZE)
