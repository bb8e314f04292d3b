"""The ground: a paraboloid with pavements above it, and the ceiling, which follows it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.simulation.lidar_options import GroundOptions

Float = NDArray[np.float64]


class Ground(NamedTuple):
    """z = slope . (x, y) + bend . (x^2, y^2) / 2, and `kerb` more on the pavements.

    Attributes:
        slope: (2,) metres per metre.
        bend: (2,) per metre.
        pavements: (R, 4) rectangles, their least and their greatest x and y: x0, y0, x1, y1.
        kerb: metres.
    """

    slope: Float
    bend: Float
    pavements: Float
    kerb: float

    @classmethod
    def of(cls, options: GroundOptions, pavements: Float) -> "Ground":
        """The ground that the options describe."""
        slope, bend = (options.slope_x, options.slope_y), (options.bend_x, options.bend_y)
        return cls(np.array(slope), np.array(bend), pavements, options.kerb)

    def level(self, x: Float, y: Float) -> Float:
        """(...) metres, how high the street is at points (...), or would be under pavements."""
        (sx, sy), (bx, by) = self.slope, self.bend
        return np.asarray(x * (sx + bx / 2 * x) + y * (sy + by / 2 * y))

    def height(self, x: Float, y: Float) -> Float:
        """(...) metres, what one stands on at points (...)."""
        return np.asarray(self.level(x, y) + self.kerb * self.is_paved(x, y))

    def is_paved(self, x: Float, y: Float) -> NDArray[np.bool_]:
        """(...) whether points (...) lie on a pavement."""
        inside = np.zeros(np.shape(x), bool)
        for x0, y0, x1, y1 in self.pavements:
            inside |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
        return inside

    def gradient(self, x: Float, y: Float) -> tuple[Float, Float]:
        """How steeply it rises to the east and to the north at points (...), metres per metre."""
        (sx, sy), (bx, by) = self.slope, self.bend
        return np.asarray(sx + bx * x), np.asarray(sy + by * y)

    def distance(self, origin: Float, direction: Float, above: float = 0.0) -> Float:
        """(...) metres along rays to the level that lies `above` that of the street; inf: never.

        Args:
            origin: (3, ...) metres.
            direction: (3, ...) of length one.
            above: metres; the level is met from above and from below alike.
        """
        (x, y, z), (dx, dy, dz) = origin, direction
        gx, gy = self.gradient(x, y)
        a = -(self.bend[0] * dx * dx + self.bend[1] * dy * dy) / 2
        b = dz - gx * dx - gy * dy
        c = z - self.level(x, y) - above
        # a t^2 + b t + c = 0 for the height over the level; its sign is made positive at t = 0
        sign = np.where(c >= 0, 1.0, -1.0)
        root = b * b - 4 * a * c
        with np.errstate(divide="ignore", invalid="ignore"):
            t = 2 * c * sign / (np.sqrt(root) - sign * b)
        return np.asarray(np.where((root >= 0) & (t > 0), t, np.inf))
