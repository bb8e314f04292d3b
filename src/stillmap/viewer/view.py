"""The default view of a scene."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.viewer.scene import Scene

FIELD_OF_VIEW = math.radians(60.0)  # vertical
MIN_ASPECT = 1.1  # width / height of the page beside the controls
_MARGIN = 1.1
_EXTENT_QUANTILES = (0.03, 0.97)  # of the points, without far outliers
_DIRECTION_3D = np.array([-0.45, -0.7, 0.62])  # from the scene to the camera
_SCALE_3D = 0.95  # of the height: what lies behind the center appears smaller
_MIN_EXTENT = 5.0  # m


class DefaultView(NamedTuple):
    """The initial camera.

    Attributes:
        position, look_at: (3,) m relative to the scene's origin.
        height: height of the view in m at `look_at`.
        near, far: distances of the clipping planes in m.
    """

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]
    height: float
    near: float
    far: float

    def position_for(self, aspect: float) -> NDArray[np.float64]:
        """Position (3,) from which a page of this width / height shows as much."""
        further = max(1.0, MIN_ASPECT / aspect)
        return np.asarray(self.look_at + further * (self.position - self.look_at))


def default_view(scene: Scene) -> DefaultView:
    """The camera that shows the whole scene: 2D from above, north up; 3D at a slant."""
    low, high = _bounds(scene)
    center, (width, height) = 0.5 * (low + high), np.maximum(high - low, _MIN_EXTENT)[:2]
    shown = _MARGIN * max(height, width / MIN_ASPECT) * (1.0 if scene.is_2d else _SCALE_3D)
    distance = 0.5 * shown / math.tan(0.5 * FIELD_OF_VIEW)
    if scene.is_2d:
        # not exactly vertical, which would leave the direction of north undefined
        offset = np.array([0.0, -0.01, 1.0]) * distance
    else:
        offset = _DIRECTION_3D / np.linalg.norm(_DIRECTION_3D) * distance
    return DefaultView(center + offset, center, shown, 2e-3 * distance, 20.0 * distance)


def _bounds(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner (3,) of the visible content in m, relative to the scene's origin."""
    static = scene.clouds.get("static")
    if static is not None and len(static.points):
        low, high = np.quantile(static.points.astype(np.float64), _EXTENT_QUANTILES, axis=0)
        return low, high
    positions = scene.poses[:, :3, 3] - scene.origin
    if scene.map_image is None:
        return np.asarray(positions.min(axis=0)), np.asarray(positions.max(axis=0))
    x0, y0, x1, y1 = scene.map_image.window
    return np.array([x0, y0, 0.0]) - scene.origin, np.array([x1, y1, 0.0]) - scene.origin
