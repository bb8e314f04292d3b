"""The report's part on models: stills of the place as it was, and without its people (Fig. 11), and
of what moved (Fig. 13)."""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from PIL import Image

from stillmap.output.report_tables import share_text
from stillmap.output.stills import Float, Picture, holding, painted_share, pinhole, still
from stillmap.surface.mesh import Mesh
from stillmap.texture.textured import Textured

PLACE_SIZE, OBJECT_SIZE = (640, 400), (300, 225)  # pixels
MOST_OBJECTS = 8
_TRIED = 24  # places along the way from which a still may be taken
_SMALL = 8  # pixels along an edge for one that is tried
_DIFFERS = 60  # of 3 x 255: somebody stood there
_LITTLE = 0.1  # a pixel that is painted counts as this many in which somebody stood
_APART = 0.2  # of the way between two stills along it
_WIDE, _NARROW = math.radians(80.0), math.radians(45.0)  # of a still along the way, of the others
_ABOVE = np.array([-0.5, -0.75, 0.7])  # from where the whole is seen
_MOST = (0.03, 0.97)  # quantiles of the vertices that are in the picture then
# turned left from ahead
_SIDES = {
    "from ahead": math.radians(-35.0),
    "from its left": math.radians(85.0),
    "from behind": math.radians(205.0),
}
_RAISED = math.radians(20.0)
_QUALITY = 85  # of JPEG: photographs, which as PNG would be several megabytes


@dataclass(frozen=True, eq=False)
class PlaceStill:
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
class Stills:
    """What the report shows of models.

    Attributes:
        place: of the place.
        objects: of what moved: number, and pictures (h, w, 3) uint8 from three sides.
        unpainted: share of the surface that no picture shows without somebody before it.
    """

    place: list[PlaceStill]
    objects: list[tuple[int, list[Picture]]]
    unpainted: float


def stills_of(
    filtered: Textured,
    sharpest: Textured | None,
    T_camera_map: Float,
    objects: Mapping[int, Textured],
    threads: int = 1,
) -> Stills:
    """Two stills along the way, one from above, and three of each of the objects of which most is
    painted.

    Args:
        filtered: the place, painted without its people.
        sharpest: the same, each face by its sharpest picture.
        T_camera_map: (N, 4, 4) of pictures that were taken on the way, in order.
        objects: what moved, by number, x ahead and z up in its own frame.
        threads: the result does not depend on them.
    """
    areas, place = Mesh(filtered.vertices, filtered.faces).areas(), list[PlaceStill]()

    def taken(caption: str, T: Float, angle: float, from_behind: bool) -> PlaceStill:
        K = pinhole(PLACE_SIZE, angle)
        pictures = [
            still(one, T, K, PLACE_SIZE, from_behind=from_behind, threads=threads)
            for one in (filtered, sharpest)
            if one is not None
        ]
        return PlaceStill(caption, pictures[0], pictures[1] if sharpest is not None else None)

    if len(filtered):
        along = _along(filtered, sharpest, T_camera_map, threads)
        place += [taken("where the robot looked", T, _WIDE, True) for T in along]
        place.append(taken("from above", _from_above(filtered), _NARROW, False))
    worth = {n: _extent(one) for n, one in objects.items() if len(one)}
    shown = sorted(worth, key=lambda n: worth[n], reverse=True)[:MOST_OBJECTS]
    return Stills(
        place,
        [(n, object_stills(objects[n], threads)) for n in shown],
        float(areas[filtered.page < 0].sum() / max(float(areas.sum()), 1e-12)),
    )


def _extent(textured: Textured) -> tuple[float, float]:
    """Square metres of a model that are painted, and all of them."""
    areas = Mesh(textured.vertices, textured.faces).areas()
    return float(areas[textured.page >= 0].sum()), float(areas.sum())


def object_stills(textured: Textured, threads: int = 1) -> list[Picture]:
    """Three sides of an object, (h, w, 3) uint8 each; x ahead and z up in its frame."""
    used = textured.vertices[np.unique(textured.faces)]
    corners, K = _box(used.min(axis=0), used.max(axis=0)), pinhole(OBJECT_SIZE, _NARROW)
    pictures = []
    for angle in _SIDES.values():
        towards = np.array([math.cos(angle), math.sin(angle), math.tan(_RAISED)])
        T = holding(corners, towards, K, OBJECT_SIZE)
        pictures.append(still(textured, T, K, OBJECT_SIZE, threads=threads))
    return pictures


def model_section(stills: Stills | None) -> str:
    """Everything about models; empty where there are none."""
    if stills is None or not (stills.place or stills.objects):
        return ""
    text = "<section><h2>What it looks like</h2>"
    if stills.place:
        text += f"<p>{escape(_sentence(stills))}</p>"
        text += "".join(_pair(one) for one in stills.place)
    if stills.objects:
        text += "<p>What moved, each from three sides; all are in <code>objects/</code>.</p>"
        text += "".join(_sides(number, pictures) for number, pictures in stills.objects)
    return text + "</section>"


def jpeg_uri(picture: Picture) -> str:
    """The picture as a `data:` address."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _sentence(stills: Stills) -> str:
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


def _pair(one: PlaceStill) -> str:
    shown = [("Sharpest", one.sharpest), ("Filtered", one.filtered)]
    figures = "".join(
        _figure(title, one.caption, picture) for title, picture in shown if picture is not None
    )
    return f'<div class="pair">{figures}</div>'


def _sides(number: int, pictures: Sequence[Picture]) -> str:
    figures = "".join(
        _figure(f"Object {number}", side, picture)
        for side, picture in zip(_SIDES, pictures, strict=True)
    )
    return f'<div class="row">{figures}</div>'


def _figure(title: str, caption: str, picture: Picture) -> str:
    height, width = picture.shape[:2]
    return (
        f"<figure><figcaption><b>{escape(title)}</b>: {escape(caption)}</figcaption>"
        f'<img class="still" src="{jpeg_uri(picture)}" alt="{escape(f"{title}: {caption}")}" '
        f'width="{width}" height="{height}"></figure>'
    )


def _along(
    filtered: Textured, sharpest: Textured | None, T_camera_map: Float, threads: int
) -> list[Float]:
    """Two of the places, apart, from which most of the picture is painted, and most of all where
    somebody was taken out."""
    N = len(T_camera_map)
    tried = np.unique(np.linspace(0, N - 1, min(N, _TRIED)).astype(np.intp)).tolist()
    size = (PLACE_SIZE[0] // _SMALL, PLACE_SIZE[1] // _SMALL)
    K = pinhole(size, _WIDE)
    worth = dict[int, float]()
    for n in tried:
        T = T_camera_map[n]
        worth[n] = _LITTLE * painted_share(filtered, T, K, size, threads)
        if sharpest is not None:
            a, b = (still(one, T, K, size, threads=threads) for one in (filtered, sharpest))
            apart = np.abs(a.astype(np.int64) - b).sum(axis=2)
            worth[n] += float((apart > _DIFFERS).mean())
    chosen: list[int] = []
    for n in sorted(worth, key=lambda n: (-worth[n], n)):
        if len(chosen) < 2 and all(abs(n - other) >= _APART * N for other in chosen):
            chosen.append(n)
    return [T_camera_map[n] for n in sorted(chosen)]


def _from_above(textured: Textured) -> Float:
    low, high = np.quantile(textured.vertices, _MOST, axis=0)
    return holding(_box(low, high), _ABOVE, pinhole(PLACE_SIZE, _NARROW), PLACE_SIZE)


def _box(low: Float, high: Float) -> Float:
    """(8, 3) corners."""
    sides = ((np.arange(8)[:, None] >> np.arange(3)) & 1).astype(bool)
    return np.where(sides, high, low)
