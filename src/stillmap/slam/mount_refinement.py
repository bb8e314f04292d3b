"""Positions of lasers once more, from registered poses: more exact than short stretches can be.

Where the robot hardly turns, a few millimetres of error in each match are centimetres in the
position. Poses that were registered against all scans, with loops closed, have less, and odometry's
heading errors matter least over short motions.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.slam.hand_eye import GAIN, SCALE, HandEye, Values, laser_names
from stillmap.slam.mount_calibration import POSITION, Calibration
from stillmap.slam.scan_motion import MotionWindows

Float = NDArray[np.float64]

_WINDOW = 0.3  # m or rad of motion
_WINDOWS_PER_SEGMENT = 5  # whose residuals may depend on each other
_STD = (0.005, 0.005, 0.002)  # m, m, rad of a motion, before the residuals scale them


def refine_positions(recording: Recording, poses: Float, found: Calibration) -> Calibration:
    """The calibration with the positions that were applied fitted to registered poses.

    Args:
        recording: 2D, as calibrated, with odometry.
        poses: (T, 3, 3) T_map_base of the recording.
        found: its calibration; other parameters stay as they are.
    """
    nominal: Values = {SCALE: 1.0, GAIN: 1.0}
    for k, pose in enumerate(se2.parameters(recording.T_base_sensor)):
        x, y, theta = pose.tolist()
        nominal.update(zip(laser_names(k), (theta, x, y), strict=True))
    free = [
        f"{name}{k}"
        for k, laser in enumerate(found.lasers)
        for name in POSITION
        if name in laser and laser[name].significant
    ]
    if not free:
        return found
    assert recording.T_odom_base is not None
    windows = [_windows(recording, poses, k) for k in range(len(found.lasers))]
    problem = HandEye(windows, [False] * len(windows), recording.T_odom_base, nominal)
    fit = problem.fit(nominal, [*free, SCALE, GAIN])
    lasers = [
        {
            name: dataclasses.replace(
                one, value=fit.values[f"{name}{k}"], std=fit.std[f"{name}{k}"]
            )
            if f"{name}{k}" in free
            else one
            for name, one in laser.items()
        }
        for k, laser in enumerate(found.lasers)
    ]
    return dataclasses.replace(found, lasers=lasers)


def _windows(recording: Recording, poses: Float, laser: int) -> MotionWindows:
    """Motions of a laser between scans that odometry has so far apart."""
    assert recording.T_odom_base is not None
    scans = np.flatnonzero(recording.sensor == laser)
    odometry = recording.T_odom_base[scans]
    x, y, turn = np.abs(se2.parameters(se2.inverse(odometry[:-1]) @ odometry[1:])).T
    ends, since = [0], 0.0
    for k, step in enumerate((np.hypot(x, y) + turn).tolist(), start=1):
        since += step
        if since >= _WINDOW:
            ends.append(k)
            since = 0.0
    first, last = scans[ends[:-1]], scans[ends[1:]]
    T = poses @ recording.T_base_sensor[laser]
    none = np.zeros(0, np.intp)
    return MotionWindows(
        first,
        last,
        np.arange(len(first)) // _WINDOWS_PER_SEGMENT,
        se2.parameters(se2.inverse(T[first]) @ T[last]),
        np.tile(np.diag(np.square(_STD)), (len(first), 1, 1)),
        np.zeros((0, 2), np.intp),
        np.zeros(0),
        none,
    )
