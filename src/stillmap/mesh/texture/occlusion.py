"""Occlusion of images by movers: lidar returns near an image's timestamp as an occlusion mask."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from stillmap.core.camera import Camera, project
from stillmap.core.recording import Recording
from stillmap.core.timestamps import beam_stamps_ns, max_scan_duration_ns
from stillmap.mesh.texture.occluders import OUTLINE_MARGIN
from stillmap.mesh.texture.views import View
from stillmap.mesh.types import Bool, Float, Float32, Index, Int64
from stillmap.tracking.boxes import Box

_WINDOW = 0.06  # s around an image: longer, and untracked movers smear
_WINDOW_TILTING = 0.15  # s, for planar scans: each row is only a line across the image
_WINDOW_TRACKED = 0.5  # s, for planar scans of tracked objects, motion-compensated
_COLUMNS = 80  # cells over the width of an image
_BEAM_DIVERGENCE = 0.01  # m per metre by which the footprint of a return grows
_SUPPORT_SIGMA = 1.5  # cells over which a static return supports its neighbors
_MIN_DEPTH = 0.05  # m from the camera: nearer returns are the camera itself
_MAX_RADIUS = 12  # cells by which a return is dilated
_NEVER = np.iinfo(np.int64).max


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

    def p_unoccluded(self, uv: Float, depth: Float, margin: float, prior: Float) -> Float:
        """(n,) probability that the image shows static surface at each point.

        Static returns raise the prior: each shows that no mover is in front. A dynamic return in
        front limits it to 1 - P(dynamic).

        Args:
            uv: (n, 2) pixels within the image.
            depth: (n,) metres ahead of the camera.
            margin: metres in front of a dynamic return from which on it occludes.
            prior: (n,) probability where no return tells.
        """
        h, w = self.depth.shape
        column = np.clip((uv[:, 0] / self.cell).astype(np.intp), 0, w - 1)
        row = np.clip((uv[:, 1] / self.cell).astype(np.intp), 0, h - 1)
        static = 1.0 - (1.0 - prior) * np.exp(-self.support[row, column])
        hidden = self.depth[row, column] < depth + margin
        return np.where(hidden, np.minimum(static, 1.0 - self.dynamic[row, column]), static)


def build_occlusion_mask(
    view: View, points: Float, p_static: Float32, margin: float = OUTLINE_MARGIN
) -> OcclusionMask:
    """The occlusion mask of an image from the returns near its timestamp.

    Args:
        view: the image.
        points: (n, 3) metres in the map frame, motion-compensated returns.
        p_static: (n,) their P(c = 1); those below one half occlude.
        margin: metres by which each dynamic return is dilated.
    """
    camera = view.camera
    cell = camera.width / _COLUMNS
    shape = max(round(camera.height / cell), 1), _COLUMNS
    local = view.to_camera(points)
    uv, ok = project(camera, local)
    ok &= local[:, 2] > _MIN_DEPTH
    is_dynamic = p_static < 0.5
    support = _count_support(uv[ok & ~is_dynamic], cell, shape)
    depth, dynamic = np.full(shape, np.inf), np.zeros(shape)
    seen = ok & is_dynamic
    if seen.any():
        at, away, p = uv[seen] / cell, local[seen, 2], 1.0 - p_static[seen]
        first = _nearest_per_cell(at, away)
        focal = _focal_length(camera) / cell
        _draw_discs(depth, dynamic, at[first], away[first], p[first], focal, margin)
    return OcclusionMask(cell, depth, dynamic, support)


def _focal_length(camera: Camera) -> float:
    if camera.K is None:
        raise ValueError("camera: its calibration is unknown")
    return float(camera.K[0, 0])


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
    depth: Float,
    dynamic: Float,
    at: Float,
    away: Float,
    p_dynamic: Float32,
    focal: float,
    margin: float,
) -> None:
    """Draws discs around dynamic returns; the nearest one wins in each cell.

    Args:
        depth, dynamic: (h, w), changed.
        at: (n, 2) in cells.
        away: (n,) metres ahead of the camera.
        p_dynamic: (n,).
        focal: focal length in cells.
        margin: metres.
    """
    h, w = depth.shape
    radius = np.minimum((margin / away + _BEAM_DIVERGENCE) * focal, _MAX_RADIUS)
    parts = []
    for whole in range(_MAX_RADIUS + 1):
        of = np.flatnonzero(np.ceil(radius - 0.5).astype(np.intp) == whole)
        if not len(of):
            continue
        dy, dx = np.mgrid[-whole : whole + 1, -whole : whole + 1]
        disc = dx**2 + dy**2 <= (whole + 0.5) ** 2
        column = np.floor(at[of, 0]).astype(np.intp)[:, None] + dx[disc]
        row = np.floor(at[of, 1]).astype(np.intp)[:, None] + dy[disc]
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        point = np.repeat(of, inside.sum(axis=1))
        parts.append(np.stack([(row * w + column)[inside], point], axis=1))
    if not parts:
        return
    cell, point = np.concatenate(parts).T
    order = np.lexsort((point, -away[point]))  # the nearest is written last
    depth.flat[cell[order]] = away[point[order]]
    dynamic.flat[cell[order]] = p_dynamic[point[order]]


@dataclass(frozen=True, eq=False)
class LidarReturns:
    """Returns of a 3D recording of T scans and M beams, looked up by time.

    Attributes:
        recording: as it was read, with its times.
        deskewed: the same, deskewed, with its points.
        T_map_sensor: (T, 4, 4).
        p_static: (M,) P(c = 1).
        boxes: of tracked objects, in seconds after `start_ns`.
        owned: (n,) beams that ended on each of these objects, rising.
        start_ns: stamp at which the seconds of the boxes begin.
        is_planar: whether each scan is a single row, as of a tilting laser.
    """

    recording: Recording
    deskewed: Recording
    T_map_sensor: Float
    p_static: Float32
    boxes: Sequence[Box]
    owned: Sequence[Index]
    start_ns: int
    is_planar: bool = False

    def near_time(self, stamp_ns: int) -> tuple[Float, Float32]:
        """Returns near a time; those on tracked objects moved along their track to that time.

        Returns:
            (n, 3) metres in the map frame, and P(static) (n,).
        """
        window = _WINDOW_TILTING if self.is_planar else _WINDOW
        tracked = max(_WINDOW_TRACKED, window) if self.is_planar else window
        scans = self._scans_near(stamp_ns, tracked)
        if scans.stop <= scans.start:
            return np.zeros((0, 3)), np.zeros(0, np.float32)
        first, last = self.deskewed.offset[[scans.start, scans.stop]]
        at_ns = beam_stamps_ns(self.recording, scans)
        apart = np.abs(at_ns - stamp_ns)
        # at least the nearest, as scans without per-beam times share one stamp
        near = apart <= max(int(1e9 * window), int(apart.min(initial=_NEVER)))
        if tracked > window:
            near |= (apart <= int(1e9 * tracked)) & self._on_dynamic_object[first:last]
        kept = np.flatnonzero(self.deskewed.hit[first:last] & near)
        beams = int(first) + kept
        ends = np.empty((len(beams), 3))
        bounds = np.searchsorted(beams, self.deskewed.offset[scans.start : scans.stop + 1])
        for scan, (low, high) in zip(range(scans.start, scans.stop), pairwise(bounds), strict=True):
            T = self.T_map_sensor[scan]
            ends[low:high] = self.deskewed.points[beams[low:high]] @ T[:3, :3].T + T[:3, 3]
        self._compensate_motion(ends, beams, at_ns[kept], stamp_ns)
        return ends, self.p_static[beams]

    @cached_property
    def _on_dynamic_object(self) -> Bool:
        """(M,) whether a beam ended on an object and is rather dynamic."""
        out = np.zeros(len(self.p_static), np.bool_)
        for owned in self.owned:
            out[owned] = self.p_static[owned] < 0.5
        return out

    @cached_property
    def _max_scan_ns(self) -> int:
        return max_scan_duration_ns(self.recording)

    def _scans_near(self, stamp_ns: int, window: float) -> slice:
        """Scans with a beam that may lie within `window` seconds of a time."""
        stamps = self.recording.stamp_ns
        reach = 1e9 * window + self._max_scan_ns
        first = int(np.searchsorted(stamps, stamp_ns - reach))
        last = int(np.searchsorted(stamps, stamp_ns + reach, side="right"))
        return slice(first, last)

    def _compensate_motion(self, ends: Float, beams: Index, at_ns: Int64, stamp_ns: int) -> None:
        """Moves end points (n, 3) on tracked objects along the tracks to a time; in place."""
        for box, owned in zip(self.boxes, self.owned, strict=True):
            if not len(owned) or not len(beams) or owned[-1] < beams[0] or owned[0] > beams[-1]:
                continue
            place = np.searchsorted(owned, beams)
            mine = np.flatnonzero(owned[np.minimum(place, len(owned) - 1)] == beams)
            if not len(mine):
                continue
            then = box.center_at(np.asarray(1e-9 * (at_ns[mine] - self.start_ns), np.float64))
            now = box.center_at(np.array([1e-9 * (stamp_ns - self.start_ns)]))
            ends[mine, :2] += now - then
