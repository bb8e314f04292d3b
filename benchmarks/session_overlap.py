"""Overlap of sessions: the share of one that lies in the area that another observed."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float
from stillmap.core.recording import Recording
from stillmap.sim.truth import Truth

_CELL, _CELL_3D = 0.1, 0.5  # m, of the area that counts as observed
_EVERY = 3  # of the scans, for that area
_BLOCK = 200  # scans at once


class Sight(NamedTuple):
    """Observations of one session: cells (K, 2) that it observed, and of each static hit (H, 2)."""

    observed: NDArray[np.int64]
    hits: NDArray[np.int64]


def observe(recording: Recording, truth: Truth) -> Sight:
    """The cells that a session observed: passed or hit in 2D, hit in 3D."""
    in_3d = recording.dimension == 3
    cell = _CELL_3D if in_3d else _CELL
    hits, seen = [], [np.empty((0, 2), np.int64)]
    for scans, start, end, static in _beams_in_world(recording, truth):
        hits.append(np.floor(end[static] / cell).astype(np.int64))
        if in_3d:
            seen.append(np.unique(hits[-1], axis=0))
        else:
            some = scans % _EVERY == 0
            seen.append(_passed_cells(start[some], end[some], cell))
    return Sight(np.unique(np.concatenate(seen), axis=0), np.concatenate(hits))


def _beams_in_world(
    recording: Recording, truth: Truth
) -> Iterator[tuple[NDArray[np.int64], Float, Float, NDArray[np.bool_]]]:
    """Scan, start and end in the plane, and whether a static surface was hit, of M beams."""
    T_world_sensor = truth.T_world_base @ recording.T_base_sensor[recording.sensor]
    for first in range(0, recording.n_scans, _BLOCK):
        last = min(first + _BLOCK, recording.n_scans)
        part = slice(int(recording.offset[first]), int(recording.offset[last]))
        counts = np.diff(recording.offset[first : last + 1])
        scans = np.repeat(np.arange(first, last), counts)
        T = T_world_sensor[scans]
        points = np.asarray(recording.points[part], np.float64)
        end = np.einsum("nij,nj->ni", T[:, :2, :-1], points) + T[:, :2, -1]
        yield scans, T[:, :2, -1], end, np.asarray(truth.static[part])


def _passed_cells(start: Float, end: Float, cell: float) -> NDArray[np.int64]:
    """(K, 2) cells that hold points, a cell apart, along beams from (N, 2) to (N, 2)."""
    if not len(start):
        return np.empty((0, 2), np.int64)
    low = np.floor(np.minimum(start, end).min(axis=0) / cell).astype(np.int64)
    high = np.floor(np.maximum(start, end).max(axis=0) / cell).astype(np.int64)
    seen = np.zeros(high - low + 1, bool)
    steps = np.ceil(np.hypot(*(end - start).T) / cell).astype(np.int64)
    order = np.argsort(-steps)
    start, along, steps = start[order], (end - start)[order], steps[order]
    for n in range(int(steps.max()) + 1):
        longer = np.searchsorted(-steps, -n, side="right")
        at = start[:longer] + (n / np.maximum(steps[:longer], 1))[:, None] * along[:longer]
        seen[tuple((np.floor(at / cell).astype(np.int64) - low).T)] = True
    return np.asarray(np.argwhere(seen) + low)


def compute_overlap(sights: Sequence[Sight], places: Sequence[int]) -> Float:
    """(S, S) share of the static hits of session j in cells that session i observed.

    Sessions of different places have none in common.
    """
    every = np.concatenate([cells for sight in sights for cells in sight])
    low = every.min(axis=0)
    overlap = np.zeros((len(sights), len(sights)))
    for i, sight in enumerate(sights):
        seen = np.zeros(every.max(axis=0) - low + 1, bool)
        seen[tuple((sight.observed - low).T)] = True
        for j, later in enumerate(sights):
            if places[i] == places[j] and len(later.hits):
                overlap[i, j] = seen[tuple((later.hits - low).T)].mean()
    return overlap
