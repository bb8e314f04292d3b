"""Movers that explain changes: nothing arrives or leaves in plain view by itself."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Float, Int64

_UNSEEN = 2.0  # s between two observations, during which something may move unseen
_REACH = 1.0  # m between a mover and what it moves: half of a car that parks, an arm
_SLACK = 2.0  # s between the mover's end points and the change
_SQUARE = 0.25  # m, see MoverPoints.thin


class MoverPoints(NamedTuple):
    """N end points on movers.

    Attributes:
        xy: (N, 2) metres in the map frame.
        stamp_ns: (N,) stamps of their scans.
    """

    xy: Float
    stamp_ns: Int64

    @classmethod
    def none(cls) -> "MoverPoints":
        """Without a point."""
        return cls(np.zeros((0, 2)), np.zeros(0, np.int64))

    @classmethod
    def concatenate(cls, parts: Sequence["MoverPoints"]) -> "MoverPoints":
        """All points of several sets."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def thin(self) -> "MoverPoints":
        """One point per square of 25 cm and second."""
        squares = np.floor(self.xy / _SQUARE).astype(np.int64)
        cells = np.column_stack([squares, self.stamp_ns // 1_000_000_000])
        some = np.unique(cells, axis=0, return_index=True)[1]
        return MoverPoints(self.xy[some], self.stamp_ns[some])


def is_explained(xy: Float, before_ns: Int64, after_ns: Int64, movers: MoverPoints) -> Bool:
    """(K,) whether a change may be one: it was not in view then, or a mover was there.

    Args:
        xy: (K, 2) metres, places.
        before_ns, after_ns: (K,) the observations before and after the change.
        movers: end points on movers.
    """
    unseen = after_ns - before_ns > _UNSEEN * 1e9
    if unseen.all() or not len(movers.xy):
        return np.asarray(unseen)
    from scipy.spatial import cKDTree  # slow to load

    origin = int(movers.stamp_ns.min())
    seconds = 1e-9 * (movers.stamp_ns - origin)
    scale = 0.5 * _UNSEEN + _SLACK  # from the middle between the observations
    tree = cKDTree(np.column_stack([movers.xy / _REACH, seconds / scale]))
    middle = 1e-9 * (before_ns - origin + (after_ns - before_ns) // 2)
    # all within 1 of each other in place and time
    places = np.column_stack([xy / _REACH, middle / scale])
    distance, _ = tree.query(places, p=np.inf, distance_upper_bound=1.0)
    return np.asarray(unseen | np.isfinite(distance))
