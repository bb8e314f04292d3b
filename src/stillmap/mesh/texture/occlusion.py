"""Occlusion of images by movers: lidar returns near an image's timestamp as an occlusion mask."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from stillmap.core.camera import project
from stillmap.mesh.texture.views import View
from stillmap.mesh.tracked_boxes import OUTLINE_MARGIN
from stillmap.mesh.types import Float, Float32, Index

_COLUMNS = 80  # cells over the width of an image
_BEAM_DIVERGENCE = 0.01  # m per metre by which the footprint of a return grows
_SUPPORT_SIGMA = 1.5  # cells over which a static return supports its neighbors
_MIN_DEPTH = 0.05  # m from the camera: nearer returns are the camera itself
_MAX_RADIUS = 12  # cells by which a return is dilated


class OcclusionMask(NamedTuple):
    """Depth map of movers in an image, on a grid of h by w cells.

    Attributes:
        cell: pixels, edge of a cell.
        depth: (h, w) metres ahead of the camera, nearest dynamic return; inf: none.
        dynamic: (h, w) its P(dynamic).
        support: (h, w) approximate number of static returns.
    """

    cell: float
    depth: Float
    dynamic: Float
    support: Float

    def p_unoccluded(self, uv: Float, depth: Float, prior: Float) -> Float:
        """(n,) probability that the image shows static surface at each point.

        Static returns raise the prior: each shows that no mover is in front. A dynamic return in
        front limits it to 1 - P(dynamic).

        Args:
            uv: (n, 2) pixels within the image.
            depth: (n,) metres ahead of the camera.
            prior: (n,) probability where no return tells.
        """
        h, w = self.depth.shape
        column = np.clip((uv[:, 0] / self.cell).astype(np.intp), 0, w - 1)
        row = np.clip((uv[:, 1] / self.cell).astype(np.intp), 0, h - 1)
        static = 1.0 - (1.0 - prior) * np.exp(-self.support[row, column])
        hidden = self.depth[row, column] < depth + OUTLINE_MARGIN
        return np.where(hidden, np.minimum(static, 1.0 - self.dynamic[row, column]), static)


def build_occlusion_mask(view: View, points: Float, p_static: Float32) -> OcclusionMask:
    """The occlusion mask of an image from the returns near its timestamp.

    Args:
        view: the image.
        points: (n, 3) metres in the map frame, motion-compensated returns.
        p_static: (n,) their P(c = 1); those below one half occlude.
    """
    camera = view.camera
    assert camera.K is not None
    cell = camera.width / _COLUMNS
    shape = max(round(camera.height / cell), 1), _COLUMNS
    local = view.to_camera(points)
    uv, ok = project(camera, local)
    ok &= local[:, 2] > _MIN_DEPTH
    is_dynamic = p_static < 0.5
    support = _count_support(uv[ok & ~is_dynamic], cell, shape)
    depth, dynamic = np.full(shape, np.inf), np.zeros(shape)
    seen = np.flatnonzero(ok & is_dynamic)
    seen = seen[_nearest_per_cell(uv[seen] / cell, local[seen, 2])]
    away = local[seen, 2]
    radius = (OUTLINE_MARGIN / away + _BEAM_DIVERGENCE) * (float(camera.K[0, 0]) / cell)
    _draw_discs(depth, dynamic, uv[seen] / cell, away, 1.0 - p_static[seen], radius)
    return OcclusionMask(cell, depth, dynamic, support)


def _count_support(uv: Float, cell: float, shape: tuple[int, int]) -> Float:
    """(h, w) static returns per cell, smoothed; a lone return counts 1 in its own cell."""
    column, row = np.floor(uv / cell).astype(np.intp).T
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    at = row[inside] * shape[1] + column[inside]
    count = np.bincount(at, minlength=shape[0] * shape[1]).reshape(shape)
    near = ndimage.gaussian_filter(count.astype(np.float64), _SUPPORT_SIGMA, mode="constant")
    return np.asarray(near * (2.0 * np.pi * _SUPPORT_SIGMA**2))


def _nearest_per_cell(at: Float, away: Float) -> Index:
    """Numbers of the nearest points (n, 2) of each cell."""
    cells = np.floor(at).astype(np.int64)
    order = np.lexsort((away, cells[:, 0], cells[:, 1]))
    new = np.any(np.diff(cells[order], axis=0, prepend=cells[order[:1]] - 1) != 0, axis=1)
    return order[new]


def _draw_discs(
    depth: Float, dynamic: Float, at: Float, away: Float, p_dynamic: Float32, radius: Float
) -> None:
    """Draws discs around dynamic returns; the nearest one wins in each cell.

    Args:
        depth, dynamic: (h, w), changed.
        at: (n, 2) in cells.
        away: (n,) metres ahead of the camera.
        p_dynamic: (n,).
        radius: (n,) in cells, at most `_MAX_RADIUS` counts.
    """
    h, w = depth.shape
    radius = np.minimum(radius, _MAX_RADIUS)
    parts = []
    for whole in range(_MAX_RADIUS + 1):
        of = np.flatnonzero(np.ceil(radius - 0.5).astype(np.intp) == whole)
        dy, dx = np.mgrid[-whole : whole + 1, -whole : whole + 1]
        disc = dx**2 + dy**2 <= (whole + 0.5) ** 2
        column = np.floor(at[of, 0]).astype(np.intp)[:, None] + dx[disc]
        row = np.floor(at[of, 1]).astype(np.intp)[:, None] + dy[disc]
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        point = np.repeat(of, inside.sum(axis=1))
        parts.append(np.stack([(row * w + column)[inside], point], axis=1))
    cell, point = np.concatenate(parts).T
    order = np.lexsort((point, -away[point]))  # the nearest is written last
    depth.flat[cell[order]] = away[point[order]]
    dynamic.flat[cell[order]] = p_dynamic[point[order]]
