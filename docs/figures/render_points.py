"""Render point clouds with NumPy: discs in a perspective view, shaded by depth differences."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MAX_RADIUS = 6  # pixels, of the disc that shows a point
SHADE = 7.5  # strength of the eye-dome shading
NEIGHBOURS = ((0, 2), (0, -2), (2, 0), (-2, 0), (2, 2), (-2, -2), (2, -2), (-2, 2))  # pixels


class View(NamedTuple):
    """A pinhole camera.

    Attributes:
        eye, target: m, where it is, and a point at the centre of its picture.
        width, height: pixels.
        fov: rad, across.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    width: int
    height: int
    fov: float

    def project(self, points: NDArray) -> NDArray:
        """Columns, rows (pixels) and depths (m) of points (n, 3); depth below 0 is behind."""
        ahead = np.subtract(self.target, self.eye)
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        seen = (points - self.eye) @ np.stack([right, np.cross(ahead, right), ahead]).T
        seen[:, :2] *= (self.focal_length / seen[:, 2])[:, None]
        return seen + np.array([self.width / 2, self.height / 2, 0.0])

    @property
    def focal_length(self) -> float:
        """Pixels."""
        return self.width / 2 / np.tan(self.fov / 2)


def render(points: NDArray, colors: NDArray, view: View, size: float) -> tuple[NDArray, NDArray]:
    """Render discs of `size` metres.

    Returns:
        (height, width, 3) float32 colours, and (height, width) float32 depths; no point: inf.
    """
    column, row, depth = view.project(points).T
    drawn = (depth > 1.0).nonzero()[0]
    drawn = drawn[np.argsort(-depth[drawn], kind="stable")]  # of several, the nearest is last
    column, row, depth, colors = column[drawn], row[drawn], depth[drawn], colors[drawn]
    radius = np.clip(size * view.focal_length / depth, 0.5, MAX_RADIUS)
    image = np.zeros((view.height, view.width, 3), np.float32)
    nearest = np.full((view.height, view.width), np.inf, np.float32)
    span = range(-MAX_RADIUS, MAX_RADIUS + 1)
    for dy, dx in ((dy, dx) for dy in span for dx in span):
        covered = dx * dx + dy * dy <= radius * radius
        x, y = (column[covered] + dx).astype(int), (row[covered] + dy).astype(int)
        inside = (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        layer_depth = np.full_like(nearest, np.inf)
        layer_depth[y[inside], x[inside]] = depth[covered][inside]
        layer = np.zeros_like(image)
        layer[y[inside], x[inside]] = colors[covered][inside]
        closer = layer_depth < nearest
        nearest[closer], image[closer] = layer_depth[closer], layer[closer]
    return image, nearest


def shade(image: NDArray, depth: NDArray, background: NDArray) -> NDArray:
    """Darken pixels behind their neighbours (eye-dome lighting); fill in the background."""
    seen = np.isfinite(depth)
    log_depth = np.log2(np.where(seen, depth, 1e6))
    behind = sum(np.maximum(log_depth - np.roll(log_depth, off, (0, 1)), 0) for off in NEIGHBOURS)
    return np.where(seen[..., None], image * np.exp(-SHADE * behind)[..., None], background)


def halve(image: NDArray) -> NDArray:
    """Mean of every square of 2 x 2 pixels."""
    height, width, channels = image.shape
    return image.reshape(height // 2, 2, width // 2, 2, channels).mean((1, 3))
