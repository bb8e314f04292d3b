"""The path of a mover: a box at any time; of a vehicle, fitted to looks at front and rear."""

from dataclasses import dataclass

import numpy as np

from stillmap.core.array_types import Bool, Float, Index
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.vehicle_filter import EdgeLooks, smooth_track

_EDGE_STD, _ACCELERATION = 0.15, 2.0  # m, m2/s3: of the smoothed path
_MIN_LENGTH, _MIN_WIDTH = 1.0, 0.8  # m, of what is seen as one beam
_REACH = 0.5  # s before the first look and after the last


@dataclass(frozen=True, eq=False)
class MoverPath:
    """A box that moves.

    Attributes:
        seconds: (L,) times of the looks, rising.
        xy: (L, 2) metres, its center in the map frame.
        velocity: (L, 2) metres per second.
        length, width: metres, of the box.
        is_round: of a walker; the width is the diameter of a circle.
    """

    seconds: Float
    xy: Float
    velocity: Float
    length: float
    width: float
    is_round: bool = False

    @property
    def travel(self) -> float:
        """Metres from the first look to the last."""
        return float(np.linalg.norm(self.xy[-1] - self.xy[0]))

    def state_at(self, seconds: Float) -> tuple[Float, Float]:
        """(n, 2) center and velocity at times (n,); constant velocity beyond the looks."""
        inside = np.clip(seconds, self.seconds[0], self.seconds[-1])
        x, v = (
            np.stack([np.interp(inside, self.seconds, c) for c in column.T], axis=-1)
            for column in (self.xy, self.velocity)
        )
        return x + (seconds - inside)[:, None] * v, v

    def contains(self, seconds: Float, xy: Float, margin: float) -> Bool:
        """(n,) whether points (n, 2) at times (n,) lie within the box and `margin` metres."""
        x, v = self.state_at(seconds)
        u = v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
        off = xy - x
        along, across = (off * u).sum(axis=1), off[:, 1] * u[:, 0] - off[:, 0] * u[:, 1]
        near = (seconds >= self.seconds[0] - _REACH) & (seconds <= self.seconds[-1] + _REACH)
        near &= np.abs(along) <= 0.5 * self.length + margin
        return np.asarray(near & (np.abs(across) <= 0.5 * self.width + margin))

    def scans(self, seconds: Float) -> tuple[int, int]:
        """First scan in which it may be seen, and the one after the last, of all times (T,)."""
        first, last = self.seconds[0] - _REACH, self.seconds[-1] + _REACH
        end = np.searchsorted(seconds, last, side="right")
        return int(np.searchsorted(seconds, first)), int(end)

    def find_points(self, points: DynamicPoints, margin: float) -> Index:
        """Points within the box, rising."""
        first, last = self.scans(points.seconds)
        low, high = points.first[first], points.first[last]
        t = points.seconds[points.scan[low:high]]
        return np.asarray(low + np.flatnonzero(self.contains(t, points.xy[low:high], margin)))


def fit_path(looks: EdgeLooks, seconds: Float) -> MoverPath:
    """The path of the center.

    Args:
        looks: at one or the other end of it.
        seconds: (T,) times of the scans.
    """
    length, width = max(looks.length, _MIN_LENGTH), max(looks.width, _MIN_WIDTH)
    back = np.where(looks.leads, -0.5, 0.5)[:, None] * length
    t = seconds[looks.scan]
    xy, velocity = smooth_track(t, looks.xy + back * looks.heading, _EDGE_STD, _ACCELERATION)
    return MoverPath(t, xy, velocity, length, width)
