"""Oriented boxes of moving objects, and the probability that they block a line of sight."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stillmap.mesh.types import Bool, Float
from stillmap.tracking.boxes import Box

OUTLINE_MARGIN = 0.05  # m around the observed extent of an object
OUTLINE_SIGMA = 0.05  # m, standard deviation of its outline beyond that margin
_GROWTHS = (0.0, 1.0, 2.0, 3.0)  # sigmas beyond the margin at which occlusion is evaluated
_P_IN_BOX = 0.99  # probability that an object is where its box is


class TrackedBox(NamedTuple):
    """An upright box that moves along the track of an object.

    Attributes:
        box: its footprint over time.
        bottom: (L,) metres, height of its lower side in the map frame at the times of `box`.
        height: metres.
    """

    box: Box
    bottom: Float
    height: float


class OrientedBox(NamedTuple):
    """An upright box at one time.

    Attributes:
        center: (3,) metres in the map frame.
        heading: (2,) unit vector to the front.
        half_size: (3,) metres to the front, to the side, upwards.
    """

    center: Float
    heading: Float
    half_size: Float

    def local(self, points: Float) -> Float:
        """(n, 3) metres ahead, to the left and above the center, of map points (n, 3)."""
        off = points - self.center
        ahead = off[:, :2] @ self.heading
        left = off[:, 1] * self.heading[0] - off[:, 0] * self.heading[1]
        return np.stack([ahead, left, off[:, 2]], axis=1)


def boxes_at(boxes: Sequence[TrackedBox], seconds: float) -> list[OrientedBox]:
    """The boxes that exist at a time, in seconds of their tracks."""
    out = []
    for box, bottom, height in boxes:
        early = min(seconds - box.seconds[0], 0.0)
        late = max(seconds - box.seconds[-1], 0.0)
        if max(-early, late) > box.hold:
            continue
        xy = box.center_at(np.array([seconds]))[0]
        at = max(int(np.searchsorted(box.seconds, seconds, side="right")) - 1, 0)
        low = float(np.interp(seconds, box.seconds, bottom))
        center = np.array([xy[0], xy[1], low + 0.5 * height])
        out.append(OrientedBox(center, box.heading[at], np.array([*box.half_size, 0.5 * height])))
    return out


def occlusion_probability(
    boxes: Sequence[OrientedBox],
    position: Float,
    points: Float,
    margin: float = OUTLINE_MARGIN,
    sigma: float = OUTLINE_SIGMA,
) -> Float:
    """(n,) probability that a box blocks the line of sight from a camera to each point.

    Within `margin` of a box it is nearly 1; farther out it falls like a normal distribution.

    Args:
        boxes: at the time of the image.
        position: (3,) metres, camera center.
        points: (n, 3) metres.
        margin: metres around each box.
        sigma: metres, standard deviation of the outline beyond the margin.
    """
    free = np.ones(len(points))
    along, square = _sights(position, points)
    for one in boxes:
        radius = float(np.linalg.norm(one.half_size)) + 2.0 * (margin + _GROWTHS[-1] * sigma)
        distance = squared_segment_distances(one.center - position, along, square)
        near = np.flatnonzero(distance <= radius**2)
        if not len(near):
            continue
        start, ends = one.local(position[None])[0], one.local(points[near])
        shown = np.zeros(len(near))
        for growth in reversed(_GROWTHS):
            meets = intersects_box(start, ends, one.half_size + margin + growth * sigma)
            shown[meets] = _P_IN_BOX * np.exp(-0.5 * growth**2)
        free[near] *= 1.0 - shown
    return 1.0 - free


def is_in_or_behind_box(boxes: Sequence[OrientedBox], position: Float, points: Float) -> Bool:
    """(n,) whether the line of sight from a camera (3,) to points (n, 3) meets a box."""
    out = np.zeros(len(points), np.bool_)
    along, square = _sights(position, points)
    for one in boxes:
        distance = squared_segment_distances(one.center - position, along, square)
        near = np.flatnonzero(distance <= float(one.half_size @ one.half_size))
        if len(near):
            start, ends = one.local(position[None])[0], one.local(points[near])
            out[near] |= intersects_box(start, ends, one.half_size)
    return out


def _sights(position: Float, points: Float) -> tuple[Float, Float]:
    """Lines of sight from a camera to points: vectors (3, n) and their squared lengths (n,)."""
    along = np.ascontiguousarray((points - position).T)
    return along, np.maximum(along[0] ** 2 + along[1] ** 2 + along[2] ** 2, 1e-12)


def squared_segment_distances(center: Float, along: Float, square: Float) -> Float:
    """(n,) squared distances from a point (3,) to segments from the origin to `along` (3, n).

    `square` (n,) are their squared lengths.
    """
    dot = center[0] * along[0] + center[1] * along[1] + center[2] * along[2]
    share = np.clip(dot / square, 0.0, 1.0)
    return np.asarray(center @ center + share * (share * square - 2.0 * dot))


def intersects_box(start: Float, ends: Float, half_size: Float) -> Bool:
    """(n,) whether segments from `start` (3,) to `ends` (n, 3) meet a box around the origin.

    Slab test: a segment lies between each pair of faces over an interval of its length.
    """
    enters, leaves = np.full(len(ends), -np.inf), np.full(len(ends), np.inf)
    for axis in range(3):
        along = ends[:, axis] - start[axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            one = (-half_size[axis] - start[axis]) / along
            other = (half_size[axis] - start[axis]) / along
        first, last = np.minimum(one, other), np.maximum(one, other)
        # parallel to the faces: all of the segment lies between them, or nothing
        beside = np.inf if abs(start[axis]) > half_size[axis] else -np.inf
        first[along == 0.0], last[along == 0.0] = beside, -beside
        enters, leaves = np.maximum(enters, first), np.minimum(leaves, last)
    return np.asarray((enters <= leaves) & (leaves >= 0.0) & (enters <= 1.0))
