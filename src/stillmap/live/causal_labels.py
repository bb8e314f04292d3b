"""The causal E-step: P(static) of beams from what is known so far, and the map of what stands."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.grid_map import GridMap
from stillmap.core.short_repr import ShortRepr
from stillmap.em.observations import P_DETECTION
from stillmap.em.options import EmOptions
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]
OccupancyFilter = _core.OccupancyFilter2D | _core.OccupancyFilter3D

# fewer classes than the E-step afterwards has: stationary probability, s of correlation
_STATIC = ((0.998, 25.0), (0.95, 25.0))
_DYNAMIC = ((0.04, 0.5), (0.04, 3.0), (0.15, 3.0), (0.04, 12.0), (0.04, 45.0))
_LATERAL_STD = 0.4  # cells, of a beam's lateral position
_HIT_RADIUS = 1.0  # cells from an end point to the centres of the cells that it hits
_MAX_LOG_RATIO = 20.0  # nats: what stood for hours is known to be gone after a few bins
# scans of a sensor in a time bin in which each beam is followed through the cells that it passed;
# in others only its end counts
_FOLLOWED, _MAX_STRIDE, _RATE_GAIN = 3.0, 8, 0.1
# of static surface in the map and in matching: one look at a walker is no evidence for a wall
_MAP_PRIOR = 0.5
# likewise for the local map until more is known: people who walk along with the robot are always
# ahead of it, where nobody has looked before
_RECENT_PRIOR = 0.05
_MARGIN, _MAX_MARGIN = 0.1, 1.0  # m behind a surface where a beam has passed it; at grazing angles


@dataclass(frozen=True, eq=False)
class MapChange(ShortRepr):
    """A part of the map that changed.

    Attributes:
        first_cell: (D,) int64, the lowest cell.
        p_occupied: (N, N) float32, in 3D (N, N, N), rows from the lowest y (z) on; NaN: unknown.
    """

    first_cell: NDArray[np.int64]
    p_occupied: NDArray[np.float32]


class CausalLabels:
    """Forward filters of all cells, updated scan by scan.

    Args:
        dimension: 2 or 3.
        resolution: m, edge of a cell.
        options: see EmOptions.
    """

    def __init__(self, dimension: int, resolution: float, options: EmOptions) -> None:
        kind = _core.OccupancyFilter2D if dimension == 2 else _core.OccupancyFilter3D
        rho, tau = zip(*_STATIC, *_DYNAMIC, strict=True)
        prior, n = options.prior, len(_STATIC)
        weights = [prior / n] * n + [(1.0 - prior) / len(_DYNAMIC)] * len(_DYNAMIC)
        self.filter: OccupancyFilter = kind(
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
        self._first_ns: int | None = None
        self.tags = 1  # numbers of keyframes are below
        self._rate = dict[str | int, _ScanRate]()

    @property
    def resolution(self) -> float:
        """m, edge of a cell."""
        return float(self.filter.resolution)

    def label(self, beams: ScanBeams, T_map_base: Float) -> NDArray[np.float32]:
        """(N,) P(static) of the beams of a scan at a pose; NaN: unusable."""
        T = (T_map_base @ beams.T_base_sensor)[None]
        offset = np.array([0, len(beams.points)])
        return self.filter.label(beams.points, beams.hit, offset, T, self._prior)

    def label_ends(self, points: NDArray[np.float32], T_map_base: Float) -> NDArray[np.float32]:
        """(N,) P(static) of hits that end at points (N, D) in the base frame, with the prior of the
        map."""
        every, offset = np.ones(len(points), np.bool_), np.array([0, len(points)])
        return self.filter.label(points, every, offset, T_map_base[None], _MAP_PRIOR)

    def doubt(self, e: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N,) P(static) of `label` with the prior of what was only just seen."""
        odds = _RECENT_PRIOR / (1.0 - _RECENT_PRIOR) * (1.0 - self._prior) / self._prior
        return np.asarray(odds * e / (odds * e + (1.0 - e)), np.float32)

    def add(self, beams: ScanBeams, T_map_base: Float, normals: Float, tag: int) -> None:
        """Add the hits of a scan at a pose.

        Args:
            beams: of the scan.
            T_map_base: (D+1, D+1).
            normals: (N, D) of the surfaces that were hit, in the sensor frame; 0: unknown.
            tag: number of the keyframe by which the cells move when the map is corrected.
        """
        if self._first_ns is None:
            self._first_ns = beams.stamp_ns
        time_bin = max(beams.stamp_ns - self._first_ns, 0) // self._bin_ns
        self.tags = max(self.tags, tag + 1)
        T = (T_map_base @ beams.T_base_sensor)[None]
        margin = _margins(beams, normals) / np.float32(self.filter.resolution)
        margin[~self._select_followed(beams)] = np.inf
        offset = np.array([0, len(beams.points)])
        self.filter.add(beams.points, beams.hit, margin, offset, T, time_bin=time_bin, tag=tag)

    def _select_followed(self, beams: ScanBeams) -> NDArray[np.bool_]:
        """(N,) beams to follow: fast sensors see the same several times in a time bin."""
        rate = self._rate.setdefault(beams.sensor, _ScanRate())
        rate.update(beams.stamp_ns)
        stride = int(np.clip(self._bin_ns / (_FOLLOWED * max(rate.period_ns, 1.0)), 1, _MAX_STRIDE))
        return np.asarray((np.arange(len(beams.points)) + rate.count) % stride == 0)

    def to_map(self) -> GridMap:
        """The planar map of what stands; NaN: unknown."""
        return self._to_map(self._odds_factor)

    def to_view(self) -> GridMap:
        """The same where one look is enough: for comparison with another map."""
        return self._to_map(1.0)

    def _to_map(self, odds_factor: float) -> GridMap:
        first, p_occupied = self.filter.dense(odds_factor=odds_factor)
        x, y = (first * self.resolution).tolist()
        return GridMap(p_occupied, (x, y, 0.0), self.resolution)

    def take_changes(self) -> list[MapChange]:
        """The parts of the map that changed since the last call."""
        lowest = self.filter.take_changed_blocks()
        edge = 32 if lowest.shape[1] == 2 else 8
        shape = [edge] * lowest.shape[1]
        tiles = [
            self.filter.dense(cell.tolist(), shape, odds_factor=self._odds_factor)[1]
            for cell in lowest
        ]
        return list(map(MapChange, lowest, tiles))


def take_over(
    to: OccupancyFilter, source: OccupancyFilter, motion: Float, first: int, count: int
) -> int:
    """Add `count` blocks of a filter of the same kind from `first` on, moved by the motions
    (K, D+1, D+1) of their tags; returns the first block that is left."""
    if isinstance(to, _core.OccupancyFilter2D):
        assert isinstance(source, _core.OccupancyFilter2D)
        return to.take_over(source, motion, first, count)
    assert isinstance(source, _core.OccupancyFilter3D)
    return to.take_over(source, motion, first, count)


@dataclass
class _ScanRate:
    """Running mean of the nanoseconds between the scans of a sensor, and their number."""

    period_ns: float = np.inf
    count: int = 0
    last_ns: int = 0

    def update(self, stamp_ns: int) -> None:
        step = float(stamp_ns - self.last_ns)
        if self.count == 1:
            self.period_ns = step
        elif self.count > 1:
            self.period_ns += _RATE_GAIN * (step - self.period_ns)
        self.count, self.last_ns = self.count + 1, stamp_ns


def _margins(beams: ScanBeams, normals: Float) -> NDArray[np.float32]:
    """(N,) m before the end of each beam that it has not passed."""
    points = np.where(beams.hit[:, None], beams.points, 0.0)
    length = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
    cos = np.abs(np.einsum("nd,nd->n", points, normals)) / length
    cos[~normals.any(axis=1)] = 1.0
    margin = np.minimum(_MARGIN / np.maximum(cos, 1e-3), _MAX_MARGIN)
    return np.asarray(margin, np.float32)
