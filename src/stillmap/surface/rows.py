"""In which order a sensor looks about: by rows of beams, by a plane at a time, or in any."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_SAMPLES = 2000  # beams that are asked
_SHORTEST = 4  # beams in a row
_NEXT = 0.15  # rad, between neighbours in a row or in a column, at most
_STEPS = 30.0  # as far as so many beams of a row may two rows be from each other
_ACROSS = 0.5  # cosine between a row and a column
_FLAT = 0.04  # rad from a plane, of the beams of a planar laser: it may sit off the joint
_WIDE = 0.2  # rad, what these spread within the plane


def directions(points: NDArray[np.floating]) -> Float:
    """(n, 3) of length one, NaN where points (n, 3) are, or lie in the sensor."""
    wide = points.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.asarray(wide / np.where(length > 0.0, length, np.nan))


def row_length(looking: Float) -> int:
    """How many beams each row of a range image has; 0: beams are in no such order.

    Between neighbours in a row directions change little, and across from row to row, at a right
    angle. Of the lengths that divide the number of beams the shortest one for which this holds.

    Args:
        looking: (n, 3) directions of the beams, row by row, NaN where unknown.
    """
    n = len(looking)
    step = max(n // _SAMPLES, 1)
    for length in range(_SHORTEST, n // 2 + 1):
        if n % length == 0 and _is_row(looking, length, step):
            return length
    return 0


def _is_row(looking: Float, length: int, step: int) -> bool:
    # not all in one column
    k = np.arange(0, len(looking) - length - 1, step)
    k += np.arange(len(k)) % 7
    k = k[(k + length < len(looking)) & (k % length != length - 1)]
    along, across = looking[k + 1] - looking[k], looking[k + length] - looking[k]
    known = np.isfinite(along).all(axis=1) & np.isfinite(across).all(axis=1)
    if np.count_nonzero(known) < max(8, len(k) // 20):
        return False
    along, across = along[known], across[known]
    one, other = np.linalg.norm(along, axis=1), np.linalg.norm(across, axis=1)
    usual, farthest = float(np.median(one)), float(np.percentile(other, 90))
    if not 0.0 < usual <= _NEXT or not 0.0 < farthest <= min(_NEXT, _STEPS * usual):
        return False
    cosine = np.abs(np.einsum("ni,ni->n", along, across)) / np.maximum(one * other, 1e-300)
    return float(np.median(cosine)) < _ACROSS


def is_planar(looking: Float) -> bool:
    """Whether beams with directions (n, 3), NaN where unknown, all lie in one plane."""
    known = looking[np.isfinite(looking).all(axis=1)]
    if len(known) < _SHORTEST:
        return False
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(known.T @ known / len(known)), 0.0))
    return bool(spread[0] < _FLAT and spread[1] > _WIDE)


def apart(one: Float, other: Float) -> float:
    """rad, median angle between directions (n, 3) and (n, 3); NaN where none are known of both."""
    chord = np.linalg.norm(one - other, axis=1)
    known = chord[np.isfinite(chord)]
    return float(2.0 * np.arcsin(0.5 * np.median(known))) if len(known) else float("nan")
