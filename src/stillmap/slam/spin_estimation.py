"""The direction in which a spinning lidar turns, where points have no times of their own.

A sweep without times is taken for a picture of one moment. If it was not one, the motion during the
sweep distorts it. Beam times of the right direction take the distortion out, those of the wrong one
double it, so that a map of several such sweeps occupies more cells. Sweeps that were corrected
before they were recorded become worse by either direction alike.
"""

import math
from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.recording import Recording
from stillmap.preprocessing.scan_timing import add_beam_times
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.lidar_odometry import LidarOdometry, register_sweeps
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_subset import beams_of_scans, sees_all_round, select_beams

Float = NDArray[np.float64]

Spin = Literal["clockwise", "counter-clockwise"]

_DIRECTIONS: tuple[Spin, Spin] = ("clockwise", "counter-clockwise")
_WINDOW, _MIN_WINDOWS, _MAX_WINDOWS = 16, 4, 5  # sweeps; with fewer windows noise is not known
_MAX_BEAMS = 30_000  # of a sweep; of larger ones every so many beams are used
_CELL, _MAX_RANGE = 0.2, 50.0  # m, of the map whose cells are counted
_P_STATIC = 0.9  # of every return: labels are not known yet
# m by which a sweep must be distorted at _LEVER_ARM for the directions to differ
_MIN_DISTORTION, _LEVER_ARM = 0.1, 10.0
# contrast: logarithm of the ratio of the cells that the two directions occupy, mean of the windows,
# and in standard errors; docs/registration/deskewing.md has what simulated drives show
_MIN_CONTRAST, _MIN_SCORE = 0.012, 4.0


def estimate_spin(recording: Recording, options: SlamOptions, threads: int = 1) -> Spin | None:
    """`clockwise` or `counter-clockwise` seen from above; None: sweeps are best taken as they are.

    The sweeps of up to five windows are registered as they are. At these poses both directions are
    compared: errors of the poses are the same for both. The better one must also improve on the
    sweeps as they are, each registered on its own.

    Args:
        recording: 3D, without beam times.
        options: noise of odometry; without `deskew` nothing is estimated.
        threads: does not change the result.
    """
    count = min(recording.n_scans // _WINDOW, _MAX_WINDOWS)
    if not options.deskew or count < _MIN_WINDOWS or not sees_all_round(recording):
        return None
    windows, contrasts = [], []
    for window in _select_windows(recording, count):
        registered = _register(window, options, threads)
        contrast = _contrast_of_directions(window, registered, options)
        if contrast is not None:
            windows.append((window, registered.poses))
            contrasts.append(contrast)
    if len(contrasts) < _MIN_WINDOWS:
        return None
    mean = float(np.mean(contrasts))
    error = float(np.std(contrasts, ddof=1)) / math.sqrt(len(contrasts))
    if abs(mean) <= max(_MIN_CONTRAST, _MIN_SCORE * error):
        return None
    direction = _DIRECTIONS[int(mean < 0.0)]
    gains = []
    for window, poses in windows:
        timed = add_beam_times(window, direction)
        cells = _count_cells(timed, _register(timed, options, threads).poses, options)
        gains.append(math.log(_count_cells(window, poses, options) / cells))
    return direction if float(np.mean(gains)) > 0.0 else None


def _select_windows(recording: Recording, count: int) -> Iterator[Recording]:
    """Windows of successive sweeps, evenly spread over the recording."""
    for first in np.linspace(0, recording.n_scans - _WINDOW, count).astype(np.int64).tolist():
        scans = np.arange(first, first + _WINDOW)
        yield select_beams(recording, scans, beams_of_scans(recording, scans, _MAX_BEAMS), None)


def _register(window: Recording, options: SlamOptions, threads: int) -> LidarOdometry:
    e = np.full(window.n_beams, _P_STATIC, np.float32)
    return register_sweeps(window, e, options.odometry, lambda *_: None, threads)


def _contrast_of_directions(
    window: Recording, registered: LidarOdometry, options: SlamOptions
) -> float | None:
    """How much fewer cells clockwise sweeps occupy, as logarithm; None: too slow to tell."""
    if _distortion(window, registered.twists) < _MIN_DISTORTION:
        return None
    cells = []
    for direction in _DIRECTIONS:
        timed = add_beam_times(window, direction)
        if timed.beam_time is None:
            return None
        cells.append(_count_cells(timed, registered.poses, options))
    return math.log(cells[1] / cells[0])


def _distortion(window: Recording, twists: Float) -> float:
    """Metres that the motion during a sweep moves a point at _LEVER_ARM, on average."""
    stamps = [window.stamp_ns[window.sensor == k] for k in np.unique(window.sensor)]
    seconds = 1e-9 * max(float(np.median(np.diff(of))) for of in stamps if len(of) > 1)
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
