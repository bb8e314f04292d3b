"""Things that move, as upright boxes at any time, and whether they stand in a picture's way."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.tracking.boxes import Box

Float = NDArray[np.float64]

_GROWTHS = (0.0, 1.0, 2.0, 3.0)  # sigmas beyond the margin, up to which an outline may be off
_SURELY = 0.99  # that a thing is where its box is


class TrackedBox(NamedTuple):
    """Something that moves.

    Attributes:
        box: where it is in the plan, at any time.
        foot: (L,) metres in the map frame, how high its lower side is at the times of the box.
        tall: metres.
    """

    box: Box
    bottom: Float
    height: float


class OrientedBox(NamedTuple):
    """An upright box at one time.

    Attributes:
        middle: (3,) metres in the map frame.
        ahead: (2,) of length one.
        half: (3,) metres to the front, to the side, upwards.
    """

    center: Float
    ahead: Float
    half_size: Float

    def local(self, points: Float) -> Float:
        """(n, 3) metres ahead, to the left and above its middle, of points (n, 3)."""
        off = points - self.center
        ahead = off[:, :2] @ self.ahead
        left = off[:, 1] * self.ahead[0] - off[:, 0] * self.ahead[1]
        return np.stack([ahead, left, off[:, 2]], axis=1)


def boxes_at(things: Sequence[TrackedBox], seconds: float) -> list[OrientedBox]:
    """The things that are there at a time, in seconds as their boxes have them."""
    out = []
    for box, foot, tall in things:
        early = min(seconds - box.seconds[0], 0.0)
        late = max(seconds - box.seconds[-1], 0.0)
        if max(-early, late) > box.hold:
            continue
        xy = box.center_at(np.array([seconds]))[0]
        at = max(int(np.searchsorted(box.seconds, seconds, side="right")) - 1, 0)
        low = float(np.interp(seconds, box.seconds, foot))
        middle = np.array([xy[0], xy[1], low + 0.5 * tall])
        out.append(OrientedBox(middle, box.heading[at], np.array([*box.half_size, 0.5 * tall])))
    return out


def occlusion_probability(
    cuboids: Sequence[OrientedBox], place: Float, points: Float, margin: float, sigma: float
) -> Float:
    """(n,) how probably some thing stands between a camera and points.

    Within `margin` of a box it is almost sure; the outline may be off by a normal distribution of
    `sigma` beyond.

    Args:
        cuboids: the things, when the picture was taken.
        place: (3,) metres, where the camera was.
        points: (n, 3) metres.
        margin, sigma: metres.
    """
    free = np.ones(len(points))
    along = np.ascontiguousarray((points - place).T)
    square = np.maximum(along[0] ** 2 + along[1] ** 2 + along[2] ** 2, 1e-12)
    for one in cuboids:
        reach = float(np.linalg.norm(one.half_size)) + 2.0 * (margin + _GROWTHS[-1] * sigma)
        near = np.flatnonzero(
            squared_segment_distances(one.center - place, along, square) <= reach**2
        )
        if not len(near):
            continue
        start, ends = one.local(place[None])[0], one.local(points[near])
        shown = np.zeros(len(near))
        for growth in reversed(_GROWTHS):
            p = _SURELY * np.exp(-0.5 * growth**2)
            meets = intersects_box(start, ends, one.half_size + margin + growth * sigma)
            shown[meets] = p
        free[near] *= 1.0 - shown
    return 1.0 - free


def is_in_or_behind_box(
    cuboids: Sequence[OrientedBox], place: Float, points: Float
) -> NDArray[np.bool_]:
    """(n,) whether the line of sight from a camera to points meets the box of some thing.

    Args:
        cuboids: the things, when the picture was taken.
        place: (3,) metres, where the camera was.
        points: (n, 3) metres.
    """
    out = np.zeros(len(points), np.bool_)
    along = np.ascontiguousarray((points - place).T)
    square = np.maximum(along[0] ** 2 + along[1] ** 2 + along[2] ** 2, 1e-12)
    for one in cuboids:
        reach = float(one.half_size @ one.half_size)
        near = np.flatnonzero(squared_segment_distances(one.center - place, along, square) <= reach)
        if len(near):
            start, ends = one.local(place[None])[0], one.local(points[near])
            out[near] |= intersects_box(start, ends, one.half_size)
    return out


def squared_segment_distances(middle: Float, along: Float, square: Float) -> Float:
    """(n,) squared metres from a point (3,) to segments from the origin to `along` (3, n).

    `square` (n,) are their squared lengths.
    """
    dot = middle[0] * along[0] + middle[1] * along[1] + middle[2] * along[2]
    share = np.clip(dot / square, 0.0, 1.0)
    return np.asarray(middle @ middle + share * (share * square - 2.0 * dot))


def intersects_box(start: Float, ends: Float, half: Float) -> NDArray[np.bool_]:
    """(n,) whether segments from a point (3,) to others (n, 3) meet a box around the origin.

    By slabs: a segment is within each pair of faces for an interval of its length.
    """
    enters, leaves = np.full(len(ends), -np.inf), np.full(len(ends), np.inf)
    for axis in range(3):
        along = ends[:, axis] - start[axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (-half[axis] - start[axis]) / along, (half[axis] - start[axis]) / along
        first, last = np.minimum(one, other), np.maximum(one, other)
        # parallel to a pair of faces: all of it between them, or nothing
        beside = np.inf if abs(start[axis]) > half[axis] else -np.inf
        first[along == 0.0], last[along == 0.0] = beside, -beside
        enters, leaves = np.maximum(enters, first), np.minimum(leaves, last)
    return np.asarray((enters <= leaves) & (leaves >= 0.0) & (enters <= 1.0))
