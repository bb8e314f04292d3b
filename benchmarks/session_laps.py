"""Recordings cut into sessions: a log into laps, a simulated run evenly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import stillmap
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder

_AWAY, _BACK = 15.0, 8.0  # m from the start: a lap has been there, and ends near it
_FAR = 200.0  # m, within which each lap is shifted


def select_scans(recording: Recording, scans: NDArray[np.intp]) -> Recording:
    """A recording of some scans, in order, without the poses that lie in it."""
    beams = np.concatenate([np.arange(*_range(recording, k)) for k in scans.tolist()])
    counts = np.diff(recording.offset)[scans]
    time = recording.beam_time
    return replace(
        recording,
        stamp_ns=recording.stamp_ns[scans],
        offset=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        points=np.asarray(recording.points)[beams],
        hit=np.asarray(recording.hit)[beams],
        sensor=recording.sensor[scans],
        T_recorded_base=None,
        record=None,
        T_odom_base=None if recording.T_odom_base is None else recording.T_odom_base[scans],
        beam_time=None if time is None else np.asarray(time)[beams],
    )


def _range(recording: Recording, scan: int) -> tuple[int, int]:
    part = recording.beams_of(scan)
    return part.start, part.stop


def find_laps(reference: NDArray[np.float64]) -> list[float]:
    """Times at which a lap ends and the next begins: nearest to the start, after having been away.

    Args:
        reference: (N, 4) t, x, y, theta.
    """
    far = np.hypot(*(reference[:, 1:3] - reference[0, 1:3]).T)
    cuts, is_away, best = [], False, -1
    for k, d in enumerate(far.tolist()):
        if d > _AWAY:
            if best >= 0:
                cuts.append(float(reference[best, 0]))
            is_away, best = True, -1
        elif is_away and d < _BACK and (best < 0 or d < far[best]):
            best = k
    return cuts


def write_laps(log: Path, reference: Path, folder: Path, rng: np.random.Generator) -> list[Path]:
    """Cut a log into laps, each with odometry that is turned and shifted at random.

    Stamps stay as they are, by which known relations name poses.
    """
    recording = stillmap.read(log)
    cuts = find_laps(np.loadtxt(reference))
    seconds = recording.stamp_ns / 1e9
    which = np.searchsorted(cuts, seconds, side="right")
    laps = []
    for lap in range(len(cuts) + 1):
        part = _turn_odometry(select_scans(recording, np.flatnonzero(which == lap)), rng)
        laps.append(folder / f"lap-{lap + 1}")
        stillmap_folder.write(part, laps[-1])
    return laps


def write_cuts(run: Path, folder: Path, count: int, rng: np.random.Generator) -> list[Path]:
    """Cut a simulated run into equal sessions, each with odometry turned and shifted at random."""
    whole = stillmap.read(run)
    cuts = []
    for k, scans in enumerate(np.array_split(np.arange(whole.n_scans), count)):
        part = _turn_odometry(select_scans(whole, scans), rng)
        cuts.append(folder / f"cut-{k + 1}")
        stillmap_folder.write(part, cuts[-1])
    return cuts


def _turn_odometry(part: Recording, rng: np.random.Generator) -> Recording:
    T = se2.matrix(*rng.uniform(-_FAR, _FAR, 2), rng.uniform(-np.pi, np.pi))
    return part if part.T_odom_base is None else replace(part, T_odom_base=T @ part.T_odom_base)
