"""The static background as views show it: its depth, and its colors in other views."""

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import is_in_image, project, unproject
from stillmap.mesh.place import ViewAssignment
from stillmap.mesh.texture.sampling import sample_bilinear
from stillmap.mesh.texture.views import View
from stillmap.mesh.texture.visibility import (
    DEPTH_SCALE,
    NEAR,
    DepthBuffer,
    project_pinhole,
    render_depth,
)
from stillmap.mesh.types import Bool, Float, Float32, Image

_TOLERANCE = 0.1  # m by which the background may lie in front of a point
_BUFFER_WIDTH = 320.0  # pixels of the z-buffers
_BORDER_RAYS = 16  # along an edge of an image, for its field of view
_CACHED_IMAGES, _CACHED_BUFFERS = 8, 256
_SHIFTS = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]  # pixels of pose error


class Background:
    """The static surface in all views.

    Args:
        place: the surface, and which of `views` textures each face.
        views: images and their poses.
        read: (h, w, 3) the image of a view; None: it is damaged.
    """

    def __init__(
        self, place: ViewAssignment, views: Sequence[View], read: Callable[[View], Image | None]
    ) -> None:
        self._place, self.views = place, views
        self._buffer = lru_cache(_CACHED_BUFFERS)(self._render)
        self._read = lru_cache(_CACHED_IMAGES)(lambda number: read(views[number]))

    def image(self, number: int) -> Image | None:
        """(h, w, 3) of a view; None: it is damaged."""
        return self._read(number)

    def is_unoccluded(self, number: int, points: Float) -> Bool:
        """(n,) whether no background lies in front of map points (n, 3) in a view."""
        at = self.views[number].to_camera(points)
        free = at[:, 2] > NEAR
        if not free.any() or not len(self._place.mesh):
            return free
        buffer = self._buffer(number)
        free[free] = sample_buffer(buffer.depth, buffer, at[free]) > at[free, 2] - _TOLERANCE
        return free

    def color_difference(self, number: int, points: Float) -> Float32:
        """(n,) distance of a view's colors at map points (n, 3) from those of the background.

        In RGB, 0 to 442; background colors come from the views that texture it. NaN where no other
        view textures the background.
        """
        view, out = self.views[number], np.full(len(points), np.nan, np.float32)
        at = view.to_camera(points)
        mine = self.image(number)
        if mine is None or not len(points) or not len(self._place.mesh):
            return out
        buffer = self._buffer(number)
        face = sample_buffer(buffer.face, buffer, at).astype(np.intp)
        source = np.where(face >= 0, self._place.view[face], -1)
        here, ok = project(view.camera, at)
        source[~ok | (source == number)] = -1
        for other in np.unique(source[source >= 0]).tolist():
            image, some = self.image(other), np.flatnonzero(source == other)
            if image is None:
                continue
            z = sample_buffer(buffer.depth, buffer, at[some])
            behind = _to_map(view, at[some] * (z / at[some, 2])[:, None])
            there, ok = project(self.views[other].camera, self.views[other].to_camera(behind))
            ok &= is_in_image(self.views[other].camera, there)
            some, there = some[ok], there[ok]
            shown = sample_bilinear(mine, here[some])
            off = [
                np.linalg.norm(shown - sample_bilinear(image, there + d), axis=1) for d in _SHIFTS
            ]
            out[some] = np.min(off, axis=0)
        return out

    def _render(self, number: int) -> DepthBuffer:
        """A small z-buffer of all that a view shows."""
        view = self.views[number]
        across, down = np.meshgrid(
            np.linspace(0, view.camera.width - 1, _BORDER_RAYS),
            np.linspace(0, view.camera.height - 1, _BORDER_RAYS),
        )
        shown = unproject(view.camera, np.column_stack([across.ravel(), down.ravel()]))
        shown = shown[np.isfinite(shown).all(axis=1)]
        scale = min(_BUFFER_WIDTH / view.camera.width, DEPTH_SCALE)
        return render_depth(self._place.mesh, view, shown, scale)


def sample_buffer(values: NDArray[np.generic], buffer: DepthBuffer, at: Float) -> Float:
    """(...,) values of an image (h, w) of a z-buffer at points (..., 3) in the camera's frame."""
    h, w = values.shape
    column, row = (
        np.rint(a).astype(np.intp) for a in project_pinhole(buffer.K, at.reshape(-1, 3).T)
    )
    found = values[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
    return np.asarray(found.reshape(at.shape[:-1]), np.float64)


def _to_map(view: View, points: Float) -> Float:
    """(n, 3) metres in the map frame, of points (n, 3) in the camera's."""
    return np.asarray((points - view.T_camera_map[:3, 3]) @ view.T_camera_map[:3, :3])
