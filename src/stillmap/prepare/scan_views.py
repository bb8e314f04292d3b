"""Comparison of scans of a planar laser: whether one looks past what another saw, or agrees."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.recording import Recording

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

PASSED, AGREED, SHORTER = 1, 2, 3  # how another scan's beam relates to an end point; 0: unknown
_MARGIN, _MARGIN_SHARE = 0.2, 0.04  # m plus share of the range; odometry over 2 s is better


@dataclass(frozen=True, eq=False)
class ScanViews:
    """S scans of one sensor with up to n beams, as lists of beams and as polar profiles.

    Attributes:
        points: (S, n, 2) end points in the sensor frame, m; NaN: unusable, or no such beam.
        hit: (S, n).
        ranges, bearings: (S, n) of them.
        nearest, farthest: (S, B) range in each of B sectors and the two beside it; NaN: unknown.
        T_map_sensor: (S, 3, 3).
    """

    points: Float
    hit: Bool
    ranges: Float
    bearings: Float
    nearest: Float
    farthest: Float
    T_map_sensor: Float

    @classmethod
    def read(cls, recording: Recording, scans: Index, T_map_sensor: Float) -> "ScanViews":
        """Reads some scans of a recording."""
        counts = np.diff(recording.offset)[scans]
        n = int(counts.max())
        beam = np.minimum(recording.offset[scans][:, None] + np.arange(n), recording.n_beams - 1)
        points = recording.points[beam].astype(np.float64)
        points[np.arange(n) >= counts[:, None]] = np.nan
        ranges = np.hypot(points[..., 0], points[..., 1])
        hit = recording.hit[beam] & np.isfinite(ranges)
        bearings = np.arctan2(points[..., 1], points[..., 0])
        spacing = np.diff(np.sort(bearings, axis=1), axis=1)
        usual = float(np.nanmedian(spacing)) if np.isfinite(spacing).any() else 1.0
        sectors = int(np.clip(2.0 * np.pi / max(usual, 1e-4), 8, 4096))
        profiles = _polar_profiles(ranges, bearings, sectors)
        return cls(points, hit, ranges, bearings, *profiles, T_map_sensor[scans])

    def compare(self, scan: Index, beams: Index, other: Index) -> NDArray[np.int8]:
        """(K, R, N) how beams of R other scans relate to the end points of N beams of K scans.

        Args:
            scan: (K,) the scans.
            beams: (N,) beams of all of them.
            other: (K, R) scans to compare with; -1: none, nothing is known.
        """
        T = se2.inverse(self.T_map_sensor[other]) @ self.T_map_sensor[scan][:, None]
        c, s, tx, ty = (T[..., i, j, None] for i, j in ((0, 0), (1, 0), (0, 2), (1, 2)))
        x, y = np.moveaxis(self.points[scan[:, None], beams], -1, 0)[:, :, None]
        u, v = c * x - s * y + tx, s * x + c * y + ty
        r, sectors = np.hypot(u, v), self.nearest.shape[1]
        with np.errstate(invalid="ignore"):  # NaN becomes some sector
            sector = (np.arctan2(v, u) * (sectors / (2.0 * np.pi)) + sectors).astype(np.int64)
            cell = other[:, :, None] * sectors + sector % sectors
            near, far = self.nearest.take(cell), self.farthest.take(cell)
            margin = _MARGIN + _MARGIN_SHARE * r
            relation = np.where(far < r - margin, np.int8(SHORTER), np.int8(AGREED))
            relation[near > r + margin] = PASSED
            relation[~(near > 0.0) | ~np.isfinite(r) | (other < 0)[:, :, None]] = 0
        return relation


def _polar_profiles(ranges: Float, bearings: Float, sectors: int) -> tuple[Float, Float]:
    """(S, B) least and greatest range of the usable beams in each sector and those beside it."""
    scan, beam = np.nonzero(np.isfinite(ranges))
    turns = bearings[scan, beam] / (2.0 * np.pi) + 1.0
    cell = scan * sectors + (turns * sectors).astype(np.int64) % sectors
    near = np.full(len(ranges) * sectors, np.inf)
    far = np.zeros(len(ranges) * sectors)
    np.minimum.at(near, cell, ranges[scan, beam])
    np.maximum.at(far, cell, ranges[scan, beam])
    least, most = near.reshape(-1, sectors), far.reshape(-1, sectors)
    least = np.minimum(least, np.minimum(np.roll(least, 1, axis=1), np.roll(least, -1, axis=1)))
    most = np.maximum(most, np.maximum(np.roll(most, 1, axis=1), np.roll(most, -1, axis=1)))
    return np.where(np.isfinite(least), least, np.nan), np.where(most > 0.0, most, np.nan)
