"""Changes drawn over a map as SVG: boxes, arrows and labels, in pixels of a view."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.places.timeline import ChangeRecord
from stillmap.results.report.figures import MapView

Float = NDArray[np.float64]
Box = tuple[float, float, float, float]  # left, top, right, bottom

_FONT_SHARE, _PAD_SHARE, _HEAD_SHARE = 1 / 45, 1 / 160, 1 / 60  # of the longer edge of the view
_LETTER_WIDTH = 0.68  # of the size of the font


class Mark(NamedTuple):
    """A change on the map.

    Attributes:
        kind: of the change.
        label: letter and number.
        box: `d` attribute of the box where it is, or was.
        start: of the box where it was before it moved; empty otherwise.
        arrow: of the line from there to here; empty otherwise.
        x, y: left end of the label's base line.
    """

    kind: str
    label: str
    box: str
    start: str
    arrow: str
    x: float
    y: float


class Marks(NamedTuple):
    """Marks of several changes, and the size of the font of their labels in pixels."""

    marks: list[Mark]
    font_size: float


def place_marks(changes: list[ChangeRecord], view: MapView) -> Marks:
    """Marks of changes; labels avoid each other and the boxes where there is space."""
    longest = max(view.size)
    font, pad = longest * _FONT_SHARE, longest * _PAD_SHARE
    boxes = [[_to_box(low, high, view, pad) for low, high in one.boxes] for one in changes]
    taken = [box for of in boxes for box in of]
    out = []
    for change, of in zip(changes, boxes, strict=True):
        width = _LETTER_WIDTH * font * len(change.label)
        label = _find_space(of[0], (width, font), taken, view)
        taken.append(label)
        start = arrow = ""
        if len(of) == 2:
            start, arrow = _box_path(of[1]), _arrow_path(of[1], of[0], longest * _HEAD_SHARE)
        x, y = label[0], label[3] - 0.15 * font
        out.append(Mark(change.kind, change.label, _box_path(of[0]), start, arrow, x, y))
    return Marks(out, font)


def _to_box(low: Float, high: Float, view: MapView, pad: float) -> Box:
    (left, bottom), (right, top) = view.to_pixels(np.stack([low[:2], high[:2]])).tolist()
    return left - pad, top - pad, right + pad, bottom + pad


def _box_path(box: Box) -> str:
    left, top, right, bottom = box
    return f"M{left:.1f} {top:.1f}H{right:.1f}V{bottom:.1f}H{left:.1f}Z"


def _arrow_path(start: Box, end: Box, size: float) -> str:
    """A line from the middle of a box to that of another one, with a head."""
    a, b = (np.array([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]) for box in (start, end))
    length = float(np.linalg.norm(b - a))
    if length < 1e-6:
        return ""
    angle = math.atan2(b[1] - a[1], b[0] - a[0])
    size = min(size, 0.6 * length)
    head = [
        b - size * np.array([math.cos(angle + turn), math.sin(angle + turn)])
        for turn in (0.5, -0.5)
    ]
    points = [f"{x:.1f} {y:.1f}" for x, y in (a, b, *head)]
    return f"M{points[0]}L{points[1]}M{points[2]}L{points[1]}L{points[3]}"


def _find_space(box: Box, size: tuple[float, float], taken: list[Box], view: MapView) -> Box:
    """Find the place beside a box where a label of a width and height covers least."""
    width, height = size
    left, top, right, bottom = box
    gap = 0.2 * height
    corners = [
        (right + gap, top),
        (left - gap - width, top),
        (left, top - gap - height),
        (left, bottom + gap),
        (right + gap, bottom - height),
        (left - gap - width, bottom - height),
    ]

    others = np.array(taken)

    def cost(label: Box) -> float:
        outside = -min(0.0, label[0], label[1], view.size[0] - label[2], view.size[1] - label[3])
        return float(_overlap(np.array(label), others).sum()) + 1e3 * outside

    return min(((x, y, x + width, y + height) for x, y in corners), key=cost)


def _overlap(box: Float, others: Float) -> Float:
    """(n,) areas that a box (4,) shares with others (n, 4)."""
    sides = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    out: Float = np.maximum(sides, 0.0).prod(axis=1)
    return out
