"""Place recognition in 3D: which earlier sweep was taken where this one was, and turned how."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
View = NDArray[np.float32]

_RINGS, _RING_WIDTH = 20, 2.0  # m; farther points are rare
_SECTORS = 60
_LOWEST, _HIGHEST = -1.0, 5.0  # m above the base: what is higher is one and the same


class Candidate(NamedTuple):
    """A sweep that looks alike.

    Attributes:
        number: of it.
        yaw: rad of the later base in the frame of the earlier one.
        similarity: up to 1.
    """

    number: int
    yaw: float
    similarity: float


def view_from_above(points: NDArray[np.floating]) -> View:
    """(R, S) height of the highest points (N, 3), in the base frame, by distance and azimuth; less
    the mean of all, and scaled to length 1."""
    ring = np.floor(np.hypot(points[:, 0], points[:, 1]) / _RING_WIDTH).astype(np.int64)
    turn = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    sector = np.floor(turn * _SECTORS).astype(np.int64) % _SECTORS
    height = np.clip(points[:, 2], _LOWEST, _HIGHEST) - _LOWEST
    out = np.zeros((_RINGS, _SECTORS))
    near = ring < _RINGS
    np.maximum.at(out, (ring[near], sector[near]), height[near])
    out -= out.mean()
    return (out / max(float(np.linalg.norm(out)), 1e-9)).astype(np.float32)


def find_alike(view: View, earlier: NDArray[np.float32], count: int) -> list[Candidate]:
    """The sweeps that look most alike, best first, turned as they fit best.

    Args:
        view: (R, S).
        earlier: (K, R, S) views of earlier sweeps.
        count: of sweeps, at most; none next to a better one.
    """
    spectra = np.fft.rfft(earlier, axis=2) * np.conj(np.fft.rfft(view, axis=1))
    correlation = np.fft.irfft(spectra.sum(axis=1), _SECTORS, axis=1)  # (K, S)
    best = correlation.max(axis=1)
    found = list[Candidate]()
    for k in np.argsort(-best, kind="stable").tolist():
        if len(found) == count:
            break
        if all(abs(k - one.number) > 1 for one in found):
            yaw = float(np.argmax(correlation[k])) * 2.0 * np.pi / _SECTORS
            found.append(Candidate(k, yaw, float(best[k])))
    return found
