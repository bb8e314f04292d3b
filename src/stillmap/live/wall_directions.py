"""Directions of the walls so far: new ones are mostly parallel to them or at right angles.

Scan matching drifts in heading, and what it drifts is known only when a loop is closed. In most
buildings walls that were never seen before have directions that were, modulo a quarter turn, which
tells the heading all the way. Where directions are of all kinds, they say nothing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]

_BINS = 360  # of a quarter turn
_BIN = 0.5 * np.pi / _BINS  # rad, 0.25 degrees
_KERNEL = np.radians(1.0)  # std of the normals about the direction of a wall
_UNRELATED = 0.3  # share of normals of any direction, at least
_WINDOW = 12  # bins to either side: 3 degrees; heading drifts less before it is corrected
_MIN_TRAVEL = 8.0  # m after which directions are known
# normals of one wall share their errors: evidence of each; std of a building's walls about its
# directions, rad, which one metre of travel shows once
_EVIDENCE, _MIN_STD = 0.1, np.radians(0.3)


class HeadingOffset(NamedTuple):
    """Correction of a heading, rad, and its variance, rad2."""

    value: float
    variance: float


class WallDirections:
    """Histogram of the normals of surfaces, modulo a quarter turn, weighted by travel."""

    def __init__(self) -> None:
        self._seen, self._travelled = np.zeros(_BINS), 0.0

    def add(self, scan: Scan, T: Float, metres: float) -> None:
        """Add the normals of a scan at a pose (3, 3), `metres` after the last one."""
        self._seen += min(metres, 1.0) * _count(scan, T)
        self._travelled += min(metres, 1.0)

    def rotate(self, angle: float) -> None:
        """Rotate the frame, in which directions are, by `angle` rad."""
        bins = angle / _BIN
        whole = int(np.floor(bins))
        share = bins - whole
        seen = np.roll(self._seen, whole)
        self._seen = (1.0 - share) * seen + share * np.roll(seen, 1)

    def measure(self, scan: Scan, T: Float) -> HeadingOffset | None:
        """Correction of the heading of a scan at a pose T (3, 3).

        It maximizes the likelihood of the normals of the scan near T; None: it is not defined.
        """
        if self._travelled < _MIN_TRAVEL or not self._seen.any():
            return None
        normals = _count(scan, T)
        density = np.fft.irfft(np.fft.rfft(self._seen / self._seen.sum()) * _SMOOTHING, _BINS)
        log_ratio = np.log((1.0 - _UNRELATED) * _BINS * density.clip(0.0) + _UNRELATED)
        around = np.concatenate([log_ratio[-_WINDOW:], log_ratio, log_ratio[:_WINDOW]])
        gain = _EVIDENCE * np.correlate(around, normals)
        best = int(gain.argmax())
        if best in (0, 2 * _WINDOW):
            return None
        before, here, after = gain[best - 1 : best + 2]
        curvature = 2.0 * here - before - after
        if curvature <= _WINDOW**-2:
            return None  # less certain than the window is wide
        offset = best - _WINDOW + 0.5 * (after - before) / curvature
        variance = max(_BIN**2 / curvature, _MIN_STD**2)
        return HeadingOffset(float(offset * _BIN), float(variance))


def correct_heading(T: Float, covariance: Float, offset: HeadingOffset) -> Float:
    """A pose (3, 3) with covariance (3, 3) after a Kalman update by its heading's offset."""
    gain = covariance[:, 2] / (covariance[2, 2] + offset.variance)
    out: Float = se2.matrix(*(se2.parameters(T) + offset.value * gain))
    return out


def _count(scan: Scan, T: Float) -> Float:
    """(_BINS,) weights of the normals of a scan by their direction at a pose (3, 3)."""
    weights = scan.weights * (1.0 - scan.isotropy)
    flat = (weights > 0.0) & ((scan.normals[:, 0] != 0.0) | (scan.normals[:, 1] != 0.0))
    normals = scan.normals[flat].astype(np.float64)
    angles = np.arctan2(normals[:, 1], normals[:, 0]) + se2.parameters(T)[2]
    bins = angles / _BIN
    low = np.floor(bins).astype(np.int64)
    share, weight = bins - low, weights[flat]
    out = np.bincount(low % _BINS, (1.0 - share) * weight, _BINS)
    out += np.bincount((low + 1) % _BINS, share * weight, _BINS)
    return out.astype(np.float64)


def _smoothing() -> NDArray[np.complex128]:
    away = np.minimum(np.arange(_BINS), _BINS - np.arange(_BINS)) * _BIN
    kernel = np.exp(-0.5 * (away / _KERNEL) ** 2)
    return np.fft.rfft(kernel / kernel.sum())


_SMOOTHING = _smoothing()
