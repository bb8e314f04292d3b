"""The causal E-step: P(static) of beams from what is known so far, and the map of what stands."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.grid_map import GridMap
from stillmap.core.short_repr import ShortRepr
from stillmap.em import CellProbabilities
from stillmap.em.observations import P_DETECTION
from stillmap.em.options import EmOptions
from stillmap.live.scan import Observation, ScanBeams

_AZIMUTH = 0.006  # rad, of a pixel; lidars have finer steps than that
_MIN_ELEVATION, _MAX_ELEVATION, _FACTOR = 0.005, 0.07, 1.15  # rad
# share of the pixels between the lowest and the highest beam of their column that beams fill
_FILLED = 0.8
OccupancyFilter = _core.OccupancyFilter2D | _core.SweepFilter3D

# fewer classes than the E-step afterwards has: stationary probability, s of correlation
_STATIC = ((0.998, 25.0), (0.95, 25.0))
_DYNAMIC = ((0.04, 0.5), (0.04, 3.0), (0.15, 3.0), (0.04, 12.0), (0.04, 45.0))
_LATERAL_STD = 0.4  # cells, of a beam's lateral position
_HIT_RADIUS = 1.0  # cells from an end point to the centres of the cells that it hits
_MAX_LOG_RATIO = 20.0  # nats: what stood for hours is known to be gone after a few bins
_MAX_GAP = (
    1 << 20
)  # time bins, three hours at least, after which no filter knows anything of before
# of static surface in the map and in matching: one look at a walker is no evidence for a wall
_MAP_PRIOR = 0.5
# likewise for the local map until more is known: people who walk along with the robot are always
# ahead of it, where nobody has looked before
_RECENT_PRIOR = 0.05
# ns within which a part of the map that changed is reported, about; parts that are reported at once
_REPORTED_WITHIN_NS, _MIN_CHANGES = 10**9, 8


def find_pixel_size(points: Float32, hit: Bool) -> tuple[float, float]:
    """Azimuth and elevation (rad) of the smallest pixels that hardly any gaps lie between.

    Args:
        points: (N, 3) of one sweep, in the sensor frame.
        hit: (N,).
    """
    x, y, z = points[hit].T.astype(np.float64)
    if not len(x):
        return _AZIMUTH, _MAX_ELEVATION
    column = np.floor(np.arctan2(y, x) / _AZIMUTH).astype(np.int64)
    elevation = np.arctan2(z, np.hypot(x, y))
    edge = _MIN_ELEVATION
    while edge < _MAX_ELEVATION and _filled_share(column, elevation, edge) < _FILLED:
        edge *= _FACTOR
    return _AZIMUTH, min(edge, _MAX_ELEVATION)


def _filled_share(column: Int64, elevation: Float, edge: float) -> float:
    row = np.floor(elevation / edge).astype(np.int64)
    filled = len(np.unique(np.stack([column, row]), axis=1).T)
    order = np.argsort(column, kind="stable")
    first = np.flatnonzero(np.diff(column[order], prepend=column[order[0]] - 1))
    low, high = (f.reduceat(row[order], first) for f in (np.minimum, np.maximum))
    return filled / float((high - low + 1).sum())


@dataclass(frozen=True, eq=False)
class MapChange(ShortRepr):
    """A part of the map that changed.

    Attributes:
        first_cell: (D,) int64, the lowest cell.
        p_occupied: (N, N) float32, in 3D (N, N, N), rows from the lowest y (z) on; NaN: unknown.
    """

    first_cell: Int64
    p_occupied: Float32


class CausalLabels:
    """Forward filters of all cells, updated scan by scan.

    Args:
        dimension: 2 or 3.
        resolution: m, edge of a cell.
        options: see EmOptions.
        threads: the result does not depend on it.
    """

    def __init__(
        self, dimension: int, resolution: float, options: EmOptions, threads: int = 1
    ) -> None:
        kind = _core.OccupancyFilter2D if dimension == 2 else _core.SweepFilter3D
        rho, tau = zip(*_STATIC, *_DYNAMIC, strict=True)
        prior, n = options.prior, len(_STATIC)
        weights = [prior / n] * n + [(1.0 - prior) / len(_DYNAMIC)] * len(_DYNAMIC)
        self._filter: OccupancyFilter = kind(
            resolution,
            rho=list(rho),
            tau=list(tau),
            weights=weights,
            n_static=n,
            p_detection=P_DETECTION,
            bin_seconds=options.time_bin,
            lateral_std=_LATERAL_STD,
            hit_radius=_HIT_RADIUS,
            max_log_ratio=_MAX_LOG_RATIO,
        )
        self._odds_factor = _MAP_PRIOR / (1.0 - _MAP_PRIOR) * (1.0 - prior) / prior
        self._prior, self._bin_ns = prior, round(1e9 * options.time_bin)
        self._threads = threads
        self._first_ns: int | None = None
        self._last_bin = 0
        self.tags = 1  # numbers of keyframes are below
        self._pixels = dict[str | int, tuple[float, float]]()  # of the sensors, in 3D
        # lowest cells of the blocks in `take_changes` so far, as bytes; of another filter than now
        self._reported, self._is_replaced = set[bytes](), False
        self._reported_ns = -_REPORTED_WITHIN_NS

    @property
    def filter(self) -> OccupancyFilter:
        """The filters of all cells. Where they are replaced, the whole map has moved."""
        return self._filter

    @filter.setter
    def filter(self, new: OccupancyFilter) -> None:
        self._filter, self._is_replaced = new, True

    def clear(self) -> None:
        """Forget all scans."""
        self.filter, self._first_ns, self.tags = self.filter.sibling(), None, 1
        self._last_bin = 0

    @property
    def resolution(self) -> float:
        """m, edge of a cell."""
        return float(self.filter.resolution)

    def label(self, beams: ScanBeams, T_map_base: Float) -> Float32:
        """(N,) P(static) of the beams of a scan at a pose; NaN: unusable."""
        return self._label(beams.points, beams.hit, T_map_base @ beams.T_base_sensor, self._prior)

    def label_ends(self, points: Float32, T_map_base: Float) -> Float32:
        """(N,) P(static) of hits that end at points (N, D) in the base frame, with the prior of the
        map."""
        return self._label(points, np.ones(len(points), np.bool_), T_map_base, _MAP_PRIOR)

    def _label(self, points: Float32, hit: Bool, T: Float, prior: float) -> Float32:
        offset = np.array([0, len(points)])
        return self.filter.label(points, hit, offset, T[None], prior, threads=self._threads)

    def doubt(self, e: Float32, *, of_ends: bool = False) -> Float32:
        """(N,) P(static) of `label`, or of `label_ends`, with the prior of what was only just
        seen."""
        prior = _MAP_PRIOR if of_ends else self._prior
        odds = _RECENT_PRIOR / (1.0 - _RECENT_PRIOR) * (1.0 - prior) / prior
        return np.asarray(odds * e / (odds * e + (1.0 - e)), np.float32)

    def add(
        self, observation: Observation, T_map_base: Float, to: OccupancyFilter | None = None
    ) -> None:
        """Add the hits of a scan at a pose (D+1, D+1).

        Args:
            observation: of the scan.
            T_map_base: its pose.
            to: filters to add it to; None: those of the labels.
        """
        beams, to = observation.beams, self.filter if to is None else to
        time_bin = self._time_bin(beams.stamp_ns)
        self.tags = max(self.tags, observation.tag + 1)
        T, tag = (T_map_base @ beams.T_base_sensor)[None], observation.tag
        scan, offset = (beams.points, beams.hit), np.array([0, len(beams.points)])
        if isinstance(to, _core.SweepFilter3D):
            pixel = self._pixel_size(beams)
            n = self._threads
            to.add(*scan, offset, T, pixel=pixel, time_bin=time_bin, tag=tag, threads=n)
            return
        assert observation.margin is not None
        margin = observation.margin / np.float32(self.resolution)
        to.add(*scan, margin, offset, T, time_bin=time_bin, tag=tag)

    def _time_bin(self, stamp_ns: int) -> int:
        """Index of the time bin of a scan; where the clock leaps far, the bins between are left
        out: the filters count in 32 bits."""
        if self._first_ns is None:
            self._first_ns = stamp_ns
        time_bin = max(stamp_ns - self._first_ns, 0) // self._bin_ns
        left_out = max(time_bin - self._last_bin - _MAX_GAP, 0)
        self._first_ns += left_out * self._bin_ns
        self._last_bin = max(self._last_bin, time_bin - left_out)
        return time_bin - left_out

    def _pixel_size(self, beams: ScanBeams) -> tuple[float, float]:
        """Radians between the beams of a sensor, as of its first sweep that met anything."""
        if beams.sensor in self._pixels:
            return self._pixels[beams.sensor]
        size = find_pixel_size(beams.points, beams.hit)
        if beams.hit.any():
            self._pixels[beams.sensor] = size
        return size

    def to_map(self, *, is_seen_alone: bool = False) -> GridMap:
        """The planar map of what stands; NaN: unknown. For comparison with another map without the
        prior of the map."""
        assert isinstance(self.filter, _core.OccupancyFilter2D)
        factor = 1.0 if is_seen_alone else self._odds_factor
        first, p_occupied = self.filter.dense(odds_factor=factor)
        x, y = (first * self.resolution).tolist()
        return GridMap(p_occupied, (x, y, 0.0), self.resolution)

    def known_cells(
        self, of: OccupancyFilter | None = None, *, is_seen_alone: bool = False
    ) -> CellProbabilities:
        """P(static and occupied) of the cells in which beams ended.

        Args:
            of: filters; None: those of the labels.
            is_seen_alone: without the prior of the map, for comparison with another map.
        """
        known = self.filter if of is None else of
        factor = 1.0 if is_seen_alone else self._odds_factor
        return CellProbabilities(*known.known_cells(odds_factor=factor), 0.0)

    def take_changes(self, stamp_ns: int) -> list[MapChange]:
        """Parts of the map that changed, so many since the call before that each is told about once
        a second; and those that emptied.

        Args:
            stamp_ns: of the last scan.
        """
        share = min((stamp_ns - self._reported_ns) / _REPORTED_WITHIN_NS, 1.0)
        most = max(math.ceil(share * self.filter.changed_count), _MIN_CHANGES)
        self._reported_ns = stamp_ns
        lowest, tiles = self.filter.take_changed_blocks(most, odds_factor=self._odds_factor)
        changes = list(map(MapChange, lowest, tiles))
        if self._is_replaced:
            left = {cell.tobytes() for cell in self.filter.block_cells}
            gone = sorted(self._reported - left)
            emptied = np.frombuffer(b"".join(gone), lowest.dtype).reshape(-1, lowest.shape[1])
            unknown = np.full(tiles.shape[1:], np.nan, np.float32)
            changes += [MapChange(cell, unknown) for cell in emptied]
            self._reported, self._is_replaced = self._reported & left, False
        self._reported.update(cell.tobytes() for cell in lowest)
        return changes


def take_over(to: OccupancyFilter, source: Any, motion: Float, first: int, count: int) -> int:
    """Add `count` blocks of a filter of the same kind from `first` on, moved by the motions
    (K, D+1, D+1) of their tags; returns the first block that is left."""
    return to.take_over(source, motion, first, count)
