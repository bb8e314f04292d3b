"""The direction in which a spinning lidar turns, where points have no times of their own.

A sweep without times is taken for a picture of one moment. If it was not one, the motion during the
sweep distorts it. Beam times of the right direction take the distortion out, those of the wrong one
double it, so that a map of several such sweeps occupies more cells. Sweeps that were corrected
before they were recorded become worse by either direction alike.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Float
from stillmap.core.recording import Recording
from stillmap.prepare.beam_times import add_beam_times
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.lidar_odometry import LidarOdometry, register_sweeps
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import beams_of_scans, sees_all_round, select_beams

Spin = Literal["clockwise", "counter-clockwise"]

_DIRECTIONS: tuple[Spin, Spin] = ("clockwise", "counter-clockwise")
_WINDOW, _MIN_WINDOWS, _MAX_WINDOWS = 16, 4, 5  # sweeps; with fewer windows noise is not known
_MAX_BEAMS = 30_000  # of a sweep; of larger ones every so many beams are used
_CELL, _MAX_RANGE = 0.2, 50.0  # m, of the map whose cells are counted
_P_STATIC = 0.9  # of every return: labels are not known yet
# m by which a sweep must be distorted at _LEVER_ARM for the directions to differ
_MIN_DISTORTION, _LEVER_ARM = 0.1, 10.0
# contrast: logarithm of the ratio of the cells that the two directions occupy, mean of the windows,
# and in standard errors; docs/poses.md has what simulated drives show
_MIN_CONTRAST, _MIN_SCORE = 0.012, 4.0


class WindowContrast(NamedTuple):
    """A window of sweeps, registered as they are.

    Attributes:
        window: successive sweeps.
        poses: (n, 4, 4) T_map_base of these sweeps.
        contrast: logarithm of the ratio of the cells that counter-clockwise and clockwise beam
            times occupy at these poses.
    """

    window: Recording
    poses: Float
    contrast: float


def estimate_spin(recording: Recording, options: SlamOptions, threads: int = 1) -> Spin | None:
    """`clockwise` or `counter-clockwise` seen from above; None: sweeps are best taken as they are.

    The better of both directions must also improve on the sweeps as they are, each registered on
    its own.

    Args:
        recording: 3D, without beam times.
        options: noise of odometry; without `deskew` nothing is estimated.
        threads: does not change the result.
    """
    if not options.deskew or not sees_all_round(recording):
        return None
    windows = measure_contrasts(recording, options, threads)
    if len(windows) < _MIN_WINDOWS:
        return None
    mean, error = summarize_contrasts(windows)
    if abs(mean) <= max(_MIN_CONTRAST, _MIN_SCORE * error):
        return None
    direction = _DIRECTIONS[int(mean < 0.0)]
    gains = [_measure_gain(one, direction, options, threads) for one in windows]
    return direction if float(np.mean(gains)) > 0.0 else None


def measure_contrasts(
    recording: Recording, options: SlamOptions, threads: int = 1
) -> list[WindowContrast]:
    """Compares both directions in up to five windows, at the poses of the sweeps as they are.

    Errors of the poses are the same for both. Windows without enough motion are left out; of fewer
    than 64 sweeps there are none.
    """
    count = min(recording.n_scans // _WINDOW, _MAX_WINDOWS)
    found = []
    if count >= _MIN_WINDOWS:
        for window in _select_windows(recording, count):
            odometry = _register(window, options, threads)
            if _distortion(window, odometry.twists) < _MIN_DISTORTION:
                continue
            cells = _count_both(window, odometry.poses, options)
            if cells is not None:
                contrast = math.log(cells[1] / cells[0])
                found.append(WindowContrast(window, odometry.poses, contrast))
    return found


def summarize_contrasts(windows: Sequence[WindowContrast]) -> tuple[float, float]:
    """Mean contrast of two windows or more, and its standard error."""
    contrasts = [one.contrast for one in windows]
    return float(np.mean(contrasts)), float(np.std(contrasts, ddof=1)) / math.sqrt(len(contrasts))


def _select_windows(recording: Recording, count: int) -> Iterator[Recording]:
    """Windows of successive sweeps, evenly spread over the recording."""
    for first in np.linspace(0, recording.n_scans - _WINDOW, count).astype(np.int64).tolist():
        scans = np.arange(first, first + _WINDOW)
        yield select_beams(recording, scans, beams_of_scans(recording, scans, _MAX_BEAMS), None)


def _register(window: Recording, options: SlamOptions, threads: int) -> LidarOdometry:
    e = np.full(window.n_beams, _P_STATIC, np.float32)
    return register_sweeps(window, e, options.odometry, lambda *_: None, threads)


def _count_both(window: Recording, poses: Float, options: SlamOptions) -> list[int] | None:
    """Cells occupied with each direction's beam times; None: the stamps give no rate of turns."""
    timed = [add_beam_times(window, direction) for direction in _DIRECTIONS]
    if any(one.beam_time is None for one in timed):
        return None
    return [_count_cells(one, poses, options) for one in timed]


def _measure_gain(
    one: WindowContrast, direction: Spin, options: SlamOptions, threads: int
) -> float:
    """Logarithm of how much fewer cells a window occupies once it has beam times."""
    timed = add_beam_times(one.window, direction)
    cells = _count_cells(timed, _register(timed, options, threads).poses, options)
    return math.log(_count_cells(one.window, one.poses, options) / cells)


def _distortion(window: Recording, twists: Float) -> float:
    """Metres that the motion during a sweep moves a point at _LEVER_ARM, on average."""
    stamps = [window.stamp_ns[window.sensor == k] for k in np.unique(window.sensor)]
    periods = [float(np.median(np.diff(of))) for of in stamps if len(of) > 1]
    seconds = 1e-9 * max(periods, default=0.0)
    speed, turn_rate = (np.linalg.norm(part, axis=1) for part in (twists[:, :3], twists[:, 3:]))
    return seconds * float(np.mean(speed + _LEVER_ARM * turn_rate))


def _count_cells(window: Recording, poses: Float, options: SlamOptions) -> int:
    """Cells that the returns of all sweeps occupy."""
    deskewed = deskew_recording(window, poses, options)
    T_map_sensor = deskewed.T_map_sensor(poses)
    ends = []
    for t in range(deskewed.n_scans):
        beams = deskewed.beams_of(t)
        points = deskewed.points[beams][deskewed.hit[beams]].astype(np.float64)
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(points, axis=1) < _MAX_RANGE  # not those that are NaN
        ends.append(points[near] @ T_map_sensor[t, :3, :3].T + T_map_sensor[t, :3, 3])
    found = np.concatenate(ends).astype(np.float32)
    return max(1, len(_core.voxel_downsample(found, np.ones(len(found), np.float32), _CELL)))
