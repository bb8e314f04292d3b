"""Door leaves among changes: straight, hinged, beside a gap in a wall that they could shut."""

from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Float

# m: length of what is seen of a leaf, half its thickness with noise
_LENGTH, _THICKNESS = (0.3, 1.6), 0.12
# m: between what is seen of a leaf and its hinge or the latch, as cells beside walls are missing
_END_GAP = 0.35
_WIDTH = (0.6, 1.4)  # m, of the gap in the wall
_POST = 0.2  # m of wall on either side of the gap, within _THICKNESS of its line
_DIRECTIONS = 72  # of the line of a gap that are tried
_STEP = 0.05  # m along a line
_MAX_TURN_GAP = 0.45  # m between the ends at the hinge of two positions of a leaf
_MAX_RATIO = 1.6  # of the lengths that are seen of two positions
_MIN_TURN = 0.15  # rad between two positions


class Leaf(NamedTuple):
    """Ends (2, 2) and length of a leaf as it was observed, metres."""

    ends: Float
    length: float


def fit_leaf(points: Float) -> Leaf | None:
    """The straight leaf through points (n, 2) in metres; None: they are none."""
    offset = points - points.mean(axis=0)
    axis = np.linalg.eigh(offset.T @ offset)[1][:, 1]
    along, across = offset @ axis, offset @ [-axis[1], axis[0]]
    length = float(np.ptp(along))
    if not _LENGTH[0] <= length <= _LENGTH[1] or float(np.abs(across).max()) > _THICKNESS:
        return None
    ends: Float = points.mean(axis=0) + np.outer([along.min(), along.max()], axis)
    return Leaf(ends, length)


def turn_about_hinge(first: Leaf, second: Leaf) -> bool:
    """True if two leaves are one in two positions: as long as each other, with a common end."""
    apart = np.linalg.norm(first.ends[:, None] - second.ends[None], axis=2)
    i, j = np.unravel_index(int(apart.argmin()), (2, 2))
    u, v = first.ends[1 - i] - first.ends[i], second.ends[1 - j] - second.ends[j]
    cosine = float(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)))
    turned = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    lengths = sorted((first.length, second.length))
    alike = lengths[1] <= _MAX_RATIO * lengths[0] + _MAX_TURN_GAP
    return bool(apart[i, j] <= _MAX_TURN_GAP and alike and turned >= _MIN_TURN)


def is_hinged(leaf: Leaf, wall: Float) -> bool:
    """True if a leaf ends where a wall does, beside a gap that it could shut.

    Args:
        leaf: what is seen of it.
        wall: (n, 2) points of static surface around it, metres, without the leaf's own.
    """
    if leaf.length > _WIDTH[1] or not len(wall):
        return False
    angles = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    for end, far_end in (leaf.ends, leaf.ends[::-1]):
        own = float(np.arctan2(*(far_end - end)[::-1]))
        reach = np.linalg.norm(wall - end, axis=1)
        if reach.min() > _END_GAP:
            continue
        near = wall[reach <= _WIDTH[1] + 2.0 * _END_GAP]
        if any(_is_gap(end, angle, leaf.length, near) for angle in (own, *angles.tolist())):
            return True
    return False


def _is_gap(end: Float, angle: float, length: float, wall: Float) -> bool:
    """True if a wall ends near a point and goes on in a direction, a leaf's width away."""
    u = np.array([np.cos(angle), np.sin(angle)])
    offset = wall - end
    along, across = offset @ u, offset @ [-u[1], u[0]]
    along = along[np.abs(across) <= _THICKNESS]
    behind, ahead = along[along < length / 2.0], along[along >= length / 2.0]
    if not len(behind) or not len(ahead):
        return False
    first, last = float(behind.max()), float(ahead.min())
    width = last - first
    if not (_WIDTH[0] <= width <= _WIDTH[1] and abs(first) <= _END_GAP and width >= length - 0.1):
        return False
    posts = (first - along[along <= first]), (along[along >= last] - last)
    return all(_covers(post) for post in posts) and width <= length + 2.0 * _END_GAP


def _covers(depth: Float) -> bool:
    """True if points at depths (n,) in a wall, metres, fill its first part."""
    filled = np.unique(np.floor(depth[depth < _POST] / _STEP))
    return len(filled) >= 0.75 * _POST / _STEP
