"""Two things that were taken for one: seen apart at last, they are told apart back in time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.objects import kalman
from stillmap.objects.moving import MovingPoints
from stillmap.objects.options import ObjectOptions

Float = NDArray[np.float64]
Index = NDArray[np.intp]

BACK = 6.0  # s that it is gone back in time
_MISSED = 1.0  # s without any point after which one of them was not there yet
_HORIZON = 1.0  # s of points that tell a velocity
_STANDING = 0.3  # s by which few points are taken to stand still
_REACH = 0.45  # m from the middle of a thing to its points


@dataclass(frozen=True, eq=False)
class Torn:
    """Points of who was there first, and of the other; in the scan, and before."""

    older_now: Index
    older_before: Index
    newer_now: Index
    newer_before: Index


def torn(
    points: MovingPoints, owned: Index, one: Index, other: Index, options: ObjectOptions
) -> Torn:
    """Whose the points of a thing were before it was seen to be two.

    Args:
        points: what moves.
        owned: points of the thing in earlier scans, rising.
        one, other: points of either in the scan where they are seen apart.
        options: see ObjectOptions.
    """
    xy, seconds = points.xy, points.seconds[points.scan]
    at = float(seconds[one[0]])
    middles = np.array([xy[one].mean(axis=0), xy[other].mean(axis=0)])
    motion = kalman.still(middles, options.sigma, options.sigma_speed)
    seen = np.array([at, at])
    shares: tuple[list[Index], list[Index]] = ([owned[:0]], [owned[:0]])
    owned = owned[seconds[owned] > at - BACK]
    for here in np.split(owned, np.flatnonzero(np.diff(points.scan[owned])) + 1)[::-1]:
        if len(here) == 0 or (seen - seconds[here[0]] > _MISSED).any():
            break
        motion = kalman.predicted(motion, seconds[here[0]] - at, options.acceleration)
        at = float(seconds[here[0]])
        share = _shared(xy[here], motion)
        count = np.bincount(share, minlength=2)
        sums = np.array([xy[here[share == i]].sum(axis=0) for i in (0, 1)])
        means = sums / np.maximum(count, 1)[:, None]
        motion = kalman.updated(motion, count > 0, means, options.sigma)
        seen[count > 0] = at
        for i in (0, 1):
            shares[i].append(here[share == i])
    before = [np.concatenate(share) for share in shares]
    if seen[1] < seen[0]:
        return Torn(other, before[1], one, before[0])
    return Torn(one, before[0], other, before[1])


def _shared(xy: Float, motion: kalman.Motion) -> Index:
    """(n,) to which of two each point is nearer; neither gets any where none is near to it."""
    distance = np.linalg.norm(xy[:, None] - motion.x, axis=-1)
    share: Index = distance.argmin(axis=1)
    for i in (0, 1):
        mine = share == i
        if mine.any() and distance[mine, i].min() > _REACH + 2.0 * motion.sigma[i]:
            share[mine] = 1 - i
    return share


def velocity(points: MovingPoints, before: Index, now: float) -> Float:
    """(2,) m/s of the points of a thing in the last second; 0 where there are too few."""
    seconds = points.seconds[points.scan[before]]
    before, seconds = before[seconds > now - _HORIZON], seconds[seconds > now - _HORIZON]
    if len(before) < 2:
        return np.zeros(2)
    off = seconds - seconds.mean()
    xy = points.xy[before] - points.xy[before].mean(axis=0)
    return np.asarray((off[:, None] * xy).sum(axis=0) / ((off**2).sum() + _STANDING**2))
