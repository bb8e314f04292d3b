"""The point of the scene that a click means."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


class Ray(NamedTuple):
    """A ray of sight through a pixel.

    Attributes:
        origin: (3,) m, position of the camera.
        direction: (3,) unit vector.
    """

    origin: Float
    direction: Float


def pick_point(ray: Ray, clouds: Iterable[NDArray[np.floating]], tangent: float) -> Float | None:
    """The point (3,) of the clouds that a ray meets first; None where it meets none.

    Of the points within the cone around the ray, those about as far away as the nearest one belong
    to the same surface; of these it is the one closest to the ray.

    Args:
        ray: of the click.
        clouds: each (n, 3) m.
        tangent: of the angle between axis and side of the cone.
    """
    found = [_within_cone(ray, points, tangent) for points in clouds]
    near = np.concatenate([np.zeros((0, 3)), *found])
    if not len(near):
        return None
    depth = (near - ray.origin) @ ray.direction
    near = near[depth <= depth.min() * (1.0 + 2.0 * tangent)]
    return np.asarray(near[np.argmin(_offsets(ray, near))])


def pick_plane(ray: Ray, z: float) -> Float | None:
    """The point (3,) where a ray meets the horizontal plane at height z; None where it does not."""
    rise = float(ray.direction[2])
    if abs(rise) < 1e-9:
        return None
    depth = (z - float(ray.origin[2])) / rise
    return None if depth <= 0.0 else np.asarray(ray.origin + depth * ray.direction)


def _within_cone(ray: Ray, points: NDArray[np.floating], tangent: float) -> Float:
    offset = points.astype(np.float64) - ray.origin
    depth = offset @ ray.direction
    squared = np.einsum("ij,ij->i", offset, offset)
    within = (depth > 0.0) & (squared <= depth**2 * (1.0 + tangent**2))
    return np.asarray(points[within], np.float64)


def _offsets(ray: Ray, points: Float) -> Float:
    """Tangents (n,) of the angles between the ray and the lines of sight to points (n, 3)."""
    offset = points - ray.origin
    depth = offset @ ray.direction
    across = offset - depth[:, None] * ray.direction
    return np.asarray(np.linalg.norm(across, axis=1) / depth)
