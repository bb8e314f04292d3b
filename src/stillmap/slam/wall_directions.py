"""Directions of walls: in most buildings they are parallel or at right angles to each other.

Scan matching drifts in heading. Walls that were never seen before mostly have directions, modulo a
quarter turn, that others had, and so measure the heading all the way. Where directions are of all
kinds, they say nothing.
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]

_BINS = 360  # of a quarter turn
_BIN = 0.5 * np.pi / _BINS  # rad, 0.25 degrees
_UNRELATED = 0.3  # share of normals of any direction, at least
_WINDOW = 12  # bins to either side: 3 degrees; heading drifts less before it is corrected


class HeadingOffset(NamedTuple):
    """Correction of a heading, rad, and its variance, rad2."""

    value: float
    variance: float


class Directions:
    """Histogram of the directions of normals, modulo a quarter turn.

    Attributes:
        weights: (360,) of the bins.
    """

    def __init__(self, weights: Float | None = None) -> None:
        self.weights = np.zeros(_BINS) if weights is None else weights

    @classmethod
    def of_scan(cls, scan: Scan, heading: float) -> "Directions":
        """Normals of the flat surfaces of a scan at a heading in rad, weighted by e."""
        weights = scan.weights * (1.0 - scan.isotropy)
        flat = (weights > 0.0) & ((scan.normals[:, 0] != 0.0) | (scan.normals[:, 1] != 0.0))
        normals = scan.normals[flat].astype(np.float64)
        bins = (np.arctan2(normals[:, 1], normals[:, 0]) + heading) / _BIN
        low = np.floor(bins).astype(np.int64)
        share, weight = bins - low, weights[flat]
        out = np.bincount(low % _BINS, (1.0 - share) * weight, _BINS)
        out += np.bincount((low + 1) % _BINS, share * weight, _BINS)
        return cls(out.astype(np.float64))

    def rotate(self, angle: float) -> "Directions":
        """The same, rotated by `angle` rad."""
        bins = angle / _BIN
        whole = int(np.floor(bins))
        share = bins - whole
        rotated = np.roll(self.weights, whole)
        return Directions((1.0 - share) * rotated + share * np.roll(rotated, 1))


class DirectionDensity:
    """Likelihood of the direction of a normal, given those of a building.

    Args:
        seen: directions of the building.
        kernel: standard deviation of normals about the direction of their wall, rad.
    """

    def __init__(self, seen: Directions, kernel: float) -> None:
        total = seen.weights.sum()
        smoothed = np.fft.rfft(seen.weights / total) * _transform_kernel(kernel)
        density = np.fft.irfft(smoothed, _BINS)
        log_ratio = np.log((1.0 - _UNRELATED) * _BINS * density.clip(0.0) + _UNRELATED)
        self._around = np.concatenate([log_ratio[-_WINDOW:], log_ratio, log_ratio[:_WINDOW]])

    def measure(self, scan: Directions, evidence: float) -> HeadingOffset | None:
        """The offset within 3 degrees that maximizes the likelihood of the normals of a scan.

        Args:
            scan: its directions at the heading so far.
            evidence: of a normal, as a share of that of an independent one.

        Returns:
            The offset; None if the likelihood has no maximum in the window, or a flat one.
        """
        gain = evidence * np.correlate(self._around, scan.weights)
        best = int(gain.argmax())
        if best in (0, 2 * _WINDOW):
            return None
        before, here, after = gain[best - 1 : best + 2]
        curvature = 2.0 * here - before - after
        if curvature <= _WINDOW**-2:
            return None  # less certain than the window is wide
        offset = best - _WINDOW + 0.5 * (after - before) / curvature
        return HeadingOffset(float(offset * _BIN), float(_BIN**2 / curvature))


@functools.cache
def _transform_kernel(std: float) -> NDArray[np.complex128]:
    """Fourier transform of a Gaussian of `std` rad on the bins."""
    away = np.minimum(np.arange(_BINS), _BINS - np.arange(_BINS)) * _BIN
    kernel = np.exp(-0.5 * (away / std) ** 2)
    return np.fft.rfft(kernel / kernel.sum())
