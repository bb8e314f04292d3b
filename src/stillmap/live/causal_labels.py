"""The causal E-step: P(static) of beams from what is known so far, and the map of what stands."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
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
        self._prior, self._bin_ns = prior, round(1e9 * options.time_bin)
        self._first_ns: int | None = None

    @property
    def resolution(self) -> float:
        """m, edge of a cell."""
        return float(self.filter.resolution)

    def label(self, beams: ScanBeams, T_map_base: Float) -> NDArray[np.float32]:
        """(N,) P(static) of the beams of a scan at a pose; NaN: unusable."""
        T = (T_map_base @ beams.T_base_sensor)[None]
        offset = np.array([0, len(beams.points)])
        return self.filter.label(beams.points, beams.hit, offset, T, self._prior)

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
        T = (T_map_base @ beams.T_base_sensor)[None]
        margin = _margins(beams, normals) / np.float32(self.filter.resolution)
        offset = np.array([0, len(beams.points)])
        self.filter.add(beams.points, beams.hit, margin, offset, T, time_bin=time_bin, tag=tag)

    def correct(self, motion: Float) -> None:
        """Move all cells by the motions (K, D+1, D+1) of their keyframes."""
        self.filter = self.filter.moved(np.ascontiguousarray(motion))

    def take_changes(self) -> list[MapChange]:
        """The parts of the map that changed since the last call."""
        lowest = self.filter.take_changed_blocks()
        edge = 32 if lowest.shape[1] == 2 else 8
        shape = [edge] * lowest.shape[1]
        return [MapChange(cell, self.filter.dense(cell.tolist(), shape)[1]) for cell in lowest]


def _margins(beams: ScanBeams, normals: Float) -> NDArray[np.float32]:
    """(N,) m before the end of each beam that it has not passed."""
    points = np.where(beams.hit[:, None], beams.points, 0.0)
    length = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
    cos = np.abs(np.einsum("nd,nd->n", points, normals)) / length
    cos[~normals.any(axis=1)] = 1.0
    margin = np.minimum(_MARGIN / np.maximum(cos, 1e-3), _MAX_MARGIN)
    return margin.astype(np.float32)
