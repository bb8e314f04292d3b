"""What pictures show of a place where nothing that moves is in their way."""

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import is_in_image, project, unproject
from stillmap.mesh.options import VisibleOptions
from stillmap.mesh.place import ViewAssignment
from stillmap.mesh.texture.baking import sample_bilinear
from stillmap.mesh.texture.views import View
from stillmap.mesh.texture.visibility import DepthBuffer, project_pinhole, render_depth

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Picture = NDArray[np.uint8]

_BEHIND = 0.1  # m by which a surface may lie before a thing and be taken for its own
_SMALL = 320.0  # pixels across in which it is seen what of the place hides a thing
_EDGE = 16  # rays along an edge of a picture that tell what it holds
_KEPT, _MOST = 8, 256  # pictures in memory, and small z-buffers
_AROUND = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]  # poses are off by a pixel


class Background:
    """What stands still, as views show it: how far away, and in which colours.

    Args:
        place: the surface, and which of `views` paints each face.
        views: pictures and where they were taken.
        limits: see VisibleOptions.
        colours: (h, w, 3) the picture of a view; None: it is damaged.
    """

    def __init__(
        self,
        place: ViewAssignment,
        views: Sequence[View],
        limits: VisibleOptions,
        colours: Callable[[View], Picture | None],
    ) -> None:
        self._place, self.views, self._limits = place, views, limits
        self._depths = lru_cache(_MOST)(self._depths_of)
        self._read = lru_cache(_KEPT)(lambda number: colours(views[number]))

    def image(self, number: int) -> Picture | None:
        """(h, w, 3) of a view; None: it is damaged."""
        return self._read(number)

    def is_unoccluded(self, number: int, points: Float) -> NDArray[np.bool_]:
        """(n,) whether nothing of it lies before points (n, 3) in the map frame, in a view."""
        view = self.views[number]
        at = view.to_camera(points)
        free = at[:, 2] > self._limits.near
        if not free.any() or not len(self._place.mesh):
            return free
        depths = self._depths(number)
        free[free] = sample_buffer(depths.depth, depths, at[free]) > at[free, 2] - _BEHIND
        return free

    def color_difference(self, number: int, points: Float) -> Float32:
        """(n,) by how much a view's colours at points (n, 3) in the map frame differ from those of
        the place behind, as other pictures show it: 0 to 442, the length of (r, g, b).

        NaN where no other picture shows what is behind without something that moves.
        """
        view, out = self.views[number], np.full(len(points), np.nan, np.float32)
        at = view.to_camera(points)
        mine = self.image(number)
        if mine is None or not len(points) or not len(self._place.mesh):
            return out
        depths = self._depths(number)
        face = sample_buffer(depths.face, depths, at).astype(np.intp)
        painter = np.where(face >= 0, self._place.view[face], -1)
        here, ok = project(view.camera, at)
        painter[~ok | (painter == number)] = -1
        for other in np.unique(painter[painter >= 0]).tolist():
            picture, some = self.image(other), np.flatnonzero(painter == other)
            if picture is None:
                continue
            z = sample_buffer(depths.depth, depths, at[some])
            behind = _in_map(view, at[some] * (z / at[some, 2])[:, None])
            there, ok = project(self.views[other].camera, self.views[other].in_camera(behind))
            ok &= is_in_image(self.views[other].camera, there)
            some, there = some[ok], there[ok]
            shown = sample_bilinear(mine, here[some])
            off = [
                np.linalg.norm(shown - sample_bilinear(picture, there + d), axis=1) for d in _AROUND
            ]
            out[some] = np.min(off, axis=0)
        return out

    def _depths_of(self, number: int) -> DepthBuffer:
        """A small z-buffer of all that a view shows."""
        view = self.views[number]
        across, down = np.meshgrid(
            np.linspace(0, view.camera.width - 1, _EDGE),
            np.linspace(0, view.camera.height - 1, _EDGE),
        )
        shown = unproject(view.camera, np.column_stack([across.ravel(), down.ravel()]))
        shown = shown[np.isfinite(shown).all(axis=1)]
        scale = min(_SMALL / view.camera.width, self._limits.scale)
        return render_depth(self._place.mesh, view, shown, scale, self._limits.near)


def sample_buffer(values: NDArray[np.generic], depths: DepthBuffer, at: Float) -> Float:
    """(...,) what an image (h, w) has where points (..., 3) of the camera's frame are seen."""
    h, w = values.shape
    column, row = (
        np.rint(a).astype(np.intp) for a in project_pinhole(depths.K, at.reshape(-1, 3).T)
    )
    found = values[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
    return np.asarray(found.reshape(at.shape[:-1]), np.float64)


def _in_map(view: View, points: Float) -> Float:
    """(n, 3) metres in the map frame, of points (n, 3) in the camera's."""
    return np.asarray((points - view.T_camera_map[:3, 3]) @ view.T_camera_map[:3, :3])
