"""From where one looks first."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.viewer.scene import Scene

FIELD_OF_VIEW = math.radians(60.0)  # from top to bottom

_WIDE = 1.1  # width of a window for its height, at least, beside what is clicked
_MARGIN = 1.1
_REACH = (0.03, 0.97)  # quantiles of points that are to be seen: few lie far away
_SLANT = np.array([-0.45, -0.7, 0.62])  # from behind, from the right, from above
_NEARER = 0.95  # in space: what lies behind the middle looks smaller
_LEAST = 5.0  # m


class Framing(NamedTuple):
    """Where the eye is.

    Attributes:
        position, look_at: (3,) metres around the scene's origin.
        across: metres from the lower to the upper edge of the window, where it looks.
        far: metres to the last that is to be seen.
    """

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]
    across: float
    far: float


def framing(scene: Scene) -> Framing:
    """In the plane from above, north up; in space at a slant."""
    low, high = _box(scene)
    middle, (width, height) = 0.5 * (low + high), np.maximum(high - low, _LEAST)[:2]
    across = _MARGIN * max(height, width / _WIDE) * (1.0 if scene.is_flat else _NEARER)
    away = 0.5 * across / math.tan(0.5 * FIELD_OF_VIEW)
    if scene.is_flat:
        # not quite from above: then nothing would say where north is
        offset = np.array([0.0, -0.01, 1.0]) * away
    else:
        offset = _SLANT / np.linalg.norm(_SLANT) * away
    return Framing(middle + offset, middle, across, 20.0 * away)


def _box(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3,) and (3,) metres around the scene's origin: corners of what is to be seen."""
    static = scene.clouds.get("static")
    if static is not None and len(static.points):
        low, high = np.quantile(static.points.astype(np.float64), _REACH, axis=0)
        return low, high
    way = scene.poses[:, :3, 3] - scene.origin
    if scene.plan is None:
        return np.asarray(way.min(axis=0)), np.asarray(way.max(axis=0))
    x0, y0, x1, y1 = scene.plan.window
    return np.array([x0, y0, 0.0]) - scene.origin, np.array([x1, y1, 0.0]) - scene.origin
