"""E-step (6), (8) and the likelihood (5) over whole recordings, chunk by chunk."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.options import field_with_doc
from stillmap.recording.model import Recording

Float = NDArray[np.float64]

# beams that one kernel call sees: bounds what is touched at once, whatever the recording's length
CHUNK_BEAMS = 1 << 20


@dataclass(frozen=True)
class EmOptions:
    """The loop of Fig. 2."""

    prior: float = field_with_doc(0.9, "p(c = 1), share of beams thought static beforehand")
    max_iterations: int = field_with_doc(6, "iterations at most")
    tolerance: float = field_with_doc(
        1e-3, "nats per beam of the bound: the loop stops when it gains less"
    )
    patience: int = field_with_doc(2, "iterations without a better bound before the loop stops")

    def __post_init__(self) -> None:
        if not 0.0 < self.prior < 1.0:
            raise ValueError("'em.prior' wants a probability between 0 and 1, both excluded")
        if self.max_iterations < 1 or self.patience < 1:
            raise ValueError("'em.max_iterations' and 'em.patience' want at least 1")
        if not self.tolerance >= 0.0:
            raise ValueError("'em.tolerance' wants a number that is not negative")


@dataclass(frozen=True)
class Likelihood:
    """Terms of the log likelihood, summed over all beams, in nats.

    Attributes:
        expected: (5) with gamma (7): E_c[ln p(c, z | x, m)], the curve of Fig. 5.
        bound: expected + entropy of e. After an E-step with the same map it equals
            ln p(z | x, m), and with fixed poses no EM iteration can lower it.
    """

    expected: float
    bound: float


def initial_expectations(recording: Recording, options: EmOptions) -> NDArray[np.float32]:
    """(M,) e := p(c = 1) for every beam: the start of Fig. 2."""
    return np.full(recording.n_beams, options.prior, dtype=np.float32)


def e_step(
    recording: Recording, poses: Float, grid: _core.Grid2D, options: EmOptions, threads: int = 1
) -> NDArray[np.float32]:
    """(M,) e of (6), (8): NaN for unusable beams, the prior at maximum range."""
    e = np.empty(recording.n_beams, dtype=np.float32)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in chunks(recording):
        e[beams] = _core.e_step(
            grid,
            recording.points[beams],
            recording.hit[beams],
            offset,
            T_map_sensor[scans],
            options.prior,
            threads,
        )
    return e


def log_likelihood(
    recording: Recording,
    poses: Float,
    grid: _core.Grid2D,
    e: NDArray[np.float32],
    options: EmOptions,
    threads: int = 1,
) -> Likelihood:
    """(5) and the bound of EM, at the map of `grid`."""
    total = np.zeros(4)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in chunks(recording):
        per_scan = _core.log_likelihood(
            grid,
            recording.points[beams],
            recording.hit[beams],
            e[beams],
            offset,
            T_map_sensor[scans],
            options.prior,
            threads,
        )
        total += per_scan.sum(axis=0)
    expected = float(total[:3].sum())
    return Likelihood(expected=expected, bound=expected + float(total[3]))


def add_recording(
    grid: _core.Grid2D,
    recording: Recording,
    poses: Float,
    e: NDArray[np.float32] | None,
    threads: int = 1,
) -> None:
    """Adds the sums of (10) of all scans at given poses; e = None counts every hit as static."""
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in chunks(recording):
        points, hit = recording.points[beams], recording.hit[beams]
        weights = np.ones(len(hit), np.float32) if e is None else e[beams]
        _core.add_beams(grid, points, hit, weights, offset, T_map_sensor[scans], threads)


def changed_share(
    before: NDArray[np.float32], after: NDArray[np.float32], hit: NDArray[np.bool_]
) -> float:
    """Share of the hits whose e moved by more than 0.1 between two iterations."""
    changed = int(np.count_nonzero(np.abs(after - before)[hit] > 0.1))
    return changed / max(int(np.count_nonzero(hit)), 1)


def chunks(recording: Recording) -> Iterator[tuple[slice, slice, NDArray[np.int64]]]:
    """Scans, beams and the scans' own offsets, of chunks of about CHUNK_BEAMS beams."""
    offset, first = recording.offset, 0
    while first < recording.n_scans:
        end = int(np.searchsorted(offset, offset[first] + CHUNK_BEAMS, side="right")) - 1
        end = min(max(end, first + 1), recording.n_scans)
        beams = slice(int(offset[first]), int(offset[end]))
        yield (
            slice(first, end),
            beams,
            np.ascontiguousarray(offset[first : end + 1] - offset[first]),
        )
        first = end
