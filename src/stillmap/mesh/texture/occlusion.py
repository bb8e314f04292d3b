"""What beams say of a picture that was taken about when they were.

The beams that were taken about when a picture was, and where they would have ended then.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from stillmap.core.camera import Camera, project
from stillmap.core.recording import Recording
from stillmap.core.timestamps import beam_stamps_ns, max_scan_duration_ns
from stillmap.mesh.options import ChoiceOptions
from stillmap.mesh.texture.views import View
from stillmap.tracking.boxes import Box

Float = NDArray[np.float64]

Index = NDArray[np.intp]

_CELLS = 80  # over the width of a picture

_SLOPE = 0.01  # m by which what a beam shows is larger, for each metre: beams diverge

_WIDE = 1.5  # cells, within which a beam tells of what is beside

_NEAREST = 0.05  # m from the camera: what is nearer is the camera's own

_RADII = 12  # cells at most, by which an end point is grown


class OcclusionMask(NamedTuple):
    """What beams say, on a grid of h by w cells over a picture.

    Attributes:
        cell: pixels, the edge of a cell.
        depth: (h, w) metres ahead of the camera, of the nearest thing that moves; inf: none.
        dynamic: (h, w) how probably it moves.
        support: (h, w) how many beams ended there on what stands still, about.
    """

    cell: float
    depth: Float
    dynamic: Float
    support: Float

    def p_unoccluded(self, uv: Float, depth: Float, margin: float, unseen: Float) -> Float:
        """(n,) how probably the picture shows what stands still.

        What is known otherwise, as that somebody is about there, counts where no beam tells: each
        that ended on what stands still says that nobody is before it.

        Args:
            uv: (n, 2) pixels, within the picture.
            depth: (n,) metres ahead of the camera.
            margin: metres before a thing that moves, from where on it is in the way.
            unseen: (n,) the probability where no beam tells of it.
        """
        h, w = self.depth.shape
        column = np.clip((uv[:, 0] / self.cell).astype(np.intp), 0, w - 1)
        row = np.clip((uv[:, 1] / self.cell).astype(np.intp), 0, h - 1)
        still = 1.0 - (1.0 - unseen) * np.exp(-self.support[row, column])
        hidden = self.depth[row, column] < depth + margin
        return np.where(hidden, np.minimum(still, 1.0 - self.dynamic[row, column]), still)


def build_occlusion_mask(
    view: View, points: Float, p_static: NDArray[np.float32], margin: float
) -> OcclusionMask:
    """What beams say of a picture.

    Args:
        view: the picture.
        points: (n, 3) metres in the map frame, where beams ended about when it was taken.
        p_static: (n,) P(c = 1) of these; below one half something that moves was there, and is
            `margin` metres larger, to all sides.
    """
    camera = view.camera
    cell = camera.width / _CELLS
    shape = max(round(camera.height / cell), 1), _CELLS
    local = view.to_camera(points)
    uv, ok = project(camera, local)
    ok &= local[:, 2] > _NEAREST
    moves = p_static < 0.5
    support = _support(uv[ok & ~moves], cell, shape)
    depth, dynamic = np.full(shape, np.inf), np.zeros(shape)
    seen = ok & moves
    if seen.any():
        at, away, p = uv[seen] / cell, local[seen, 2], 1.0 - p_static[seen]
        first = _nearest_of_each(at, away)  # what lies behind in the same cell hides nothing more
        focal = _focal(camera) / cell
        _grow(depth, dynamic, at[first], away[first], p[first], focal, margin)
    return OcclusionMask(cell, depth, dynamic, support)


def _focal(camera: Camera) -> float:
    if camera.K is None:
        raise ValueError("camera: its lens is not known")
    return float(camera.K[0, 0])


def _support(uv: Float, cell: float, shape: tuple[int, int]) -> Float:
    column, row = np.floor(uv / cell).astype(np.intp).T
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    at = row[inside] * shape[1] + column[inside]
    count = np.bincount(at, minlength=shape[0] * shape[1]).reshape(shape)
    # as much as one beam right here
    near = ndimage.gaussian_filter(count.astype(np.float64), _WIDE, mode="constant")
    return np.asarray(near * (2.0 * np.pi * _WIDE**2))


def _nearest_of_each(at: Float, away: Float) -> NDArray[np.intp]:
    """Of the points (n, 2) in each cell the nearest."""
    cells = np.floor(at).astype(np.int64)
    order = np.lexsort((away, cells[:, 0], cells[:, 1]))
    new = np.any(np.diff(cells[order], axis=0, prepend=cells[order[:1]] - 1) != 0, axis=1)
    return order[new]


def _grow(
    depth: Float,
    dynamic: Float,
    at: Float,
    away: Float,
    p_dynamic: NDArray[np.float32],
    focal: float,
    margin: float,
) -> None:
    """Notes discs around what moves, the nearest of them in each cell.

    Args:
        depth, dynamic: (h, w), changed.
        at: (n, 2) in cells.
        away: (n,) metres ahead of the camera.
        p_dynamic: (n,).
        focal: length in cells.
        margin: metres.
    """
    h, w = depth.shape
    radius = np.minimum((margin / away + _SLOPE) * focal, _RADII)
    parts = []
    for whole in range(_RADII + 1):
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
    # of several in a cell the last one that is written stays: the nearest
    order = np.lexsort((point, -away[point]))
    depth.flat[cell[order]] = away[point[order]]
    dynamic.flat[cell[order]] = p_dynamic[point[order]]


_NEVER = np.iinfo(np.int64).max


@dataclass(frozen=True, eq=False)
class LidarReturns:
    """T scans with M beams of a recording in 3D, to be asked for by time.

    Attributes:
        recording: as it was read; its times count.
        seen: without the motion during its scans; its points count.
        T_map_sensor: (T, 4, 4).
        p_static: (M,) P(c = 1).
        boxes: of things that move, their times in seconds after `start_ns`.
        owned: for each of these the beams (n,) that ended on it, rising.
        start_ns: when the time of the boxes begins.
        planar: whether scans lie in a plane, so that each sees only a line of what is there.
    """

    recording: Recording
    deskewed: Recording
    T_map_sensor: Float
    p_static: NDArray[np.float32]
    boxes: Sequence[Box]
    owned: Sequence[Index]
    start_ns: int
    planar: bool = False

    @cached_property
    def _moving(self) -> NDArray[np.bool_]:
        """(M,) whether a beam ended on one of the things, and rather moves."""
        out = np.zeros(len(self.p_static), np.bool_)
        for owned in self.owned:
            out[owned] = self.p_static[owned] < 0.5
        return out

    def near_time(self, stamp_ns: int, options: ChoiceOptions) -> tuple[Float, NDArray[np.float32]]:
        """Where hits ended about a time, had things that move been where they are then.

        Those within `options.window` seconds; of planar scans those within `options.rows`, and
        what ended on a thing that is followed within `options.carried`.

        Returns:
            (n, 3) metres in the map frame, and P(static) (n,).
        """
        window = options.rows if self.planar else options.window
        carried = max(options.carried, window) if self.planar else window
        scans = self._scans(stamp_ns, carried)
        if scans.stop <= scans.start:
            return np.zeros((0, 3)), np.zeros(0, np.float32)
        first, last = self.deskewed.offset[[scans.start, scans.stop]]
        at_ns = beam_stamps_ns(self.recording, scans)
        apart = np.abs(at_ns - stamp_ns)
        # at least what is nearest, as where scans count as taken at once
        near = apart <= max(int(1e9 * window), int(apart.min(initial=_NEVER)))
        if carried > window:
            near |= (apart <= int(1e9 * carried)) & self._moving[first:last]
        kept = np.flatnonzero(self.deskewed.hit[first:last] & near)
        beams = int(first) + kept
        ends = np.empty((len(beams), 3))
        bounds = np.searchsorted(beams, self.deskewed.offset[scans.start : scans.stop + 1])
        for scan, (low, high) in zip(range(scans.start, scans.stop), pairwise(bounds), strict=True):
            T = self.T_map_sensor[scan]
            ends[low:high] = self.deskewed.points[beams[low:high]] @ T[:3, :3].T + T[:3, 3]
        self._go_on(ends, beams, at_ns[kept], stamp_ns)
        return ends, self.p_static[beams]

    def _scans(self, stamp_ns: int, window: float) -> slice:
        """Those of which some beam may have been taken then; at least the nearest."""
        stamps = self.recording.stamp_ns
        reach = 1e9 * window + self._longest
        first = int(np.searchsorted(stamps, stamp_ns - reach))
        last = int(np.searchsorted(stamps, stamp_ns + reach, side="right"))
        return slice(first, last)

    @cached_property
    def _longest(self) -> int:
        """Nanoseconds that a scan takes at most, about."""
        return max_scan_duration_ns(self.recording)

    def _go_on(self, ends: Float, beams: Index, at_ns: NDArray[np.int64], stamp_ns: int) -> None:
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
