"""Scans of a planar laser on a joint as one recording in 3D, and which of them are of one sweep."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.core.timestamps import beam_stamps_ns

Float = NDArray[np.float64]

_BLOCK = 1 << 16  # beams worked on together


def assemble_tilting_laser(
    recording: Recording,
    joint_ns: NDArray[np.int64],
    joint_angle: Float,
    axis: tuple[float, float, float],
    T_base_joint: Float,
    T_joint_laser: Float | None = None,
) -> Recording:
    """The recording in 3D, its points in the frame of the joint, which stands still on the robot.

    Between two readings the joint goes on evenly; before the first and after the last it stands.

    Args:
        recording: 2D, M beams of a laser that is turned by a joint.
        joint_ns: (J,) stamps of the joint's readings, non-decreasing, by the same clock; J > 0.
        joint_angle: (J,) rad, right-handed about `axis`: about (0, 1, 0) positive is nose down,
            about (0, 0, 1) to the left.
        axis: of length one, in the frame of the joint.
        T_base_joint: (4, 4).
        T_joint_laser: (4, 4) at the angle zero; None: the laser sits in the joint.

    Raises:
        ValueError: the recording is not 2D, or there is not one stamp for each reading.
    """
    if recording.dimension != 2:
        raise ValueError(f"recording: expected 2 dimensions, got {recording.dimension}")
    if len(joint_ns) != len(joint_angle) or not len(joint_ns):
        raise ValueError(f"joint: {len(joint_ns)} stamps, {len(joint_angle)} angles")
    T = np.eye(4) if T_joint_laser is None else T_joint_laser
    points = recording.allocate_per_beam(np.float32, (3,))
    seconds = 1e-9 * (joint_ns - joint_ns[0])
    step = max(1, _BLOCK * recording.n_scans // max(recording.n_beams, 1))
    for first in range(0, recording.n_scans, step):
        scans = slice(first, min(first + step, recording.n_scans))
        beams = slice(int(recording.offset[scans.start]), int(recording.offset[scans.stop]))
        at = 1e-9 * (beam_stamps_ns(recording, scans) - joint_ns[0])
        flat = recording.points[beams].astype(np.float64)
        local = flat @ T[:3, :2].T + T[:3, 3]
        points[beams] = rotate_about_axis(
            local, np.array(axis), np.interp(at, seconds, joint_angle)
        )
        recording.release_pages(points)
    return replace(
        recording,
        points=points,
        T_base_sensor=np.asarray(T_base_joint, np.float64)[None],
        sensor=np.zeros(recording.n_scans, np.int32),
        T_odom_base=None,
        T_recorded_base=None,
    )


def rotate_about_axis(points: Float, axis: Float, angle: Float) -> Float:
    """(n, 3) points turned about an axis (3,) of length one by (n,) rad: Rodrigues' formula."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along = (points @ axis)[:, None] * axis
    return np.asarray(along + c * (points - along) + s * np.cross(axis, points))


def sweep_indices(joint_angle: Float, min_reversal: float = 0.02) -> NDArray[np.int64]:
    """(T,) which sweep each scan is of: another one begins where the joint turns round.

    Args:
        joint_angle: (T,) rad at each scan.
        least: rad by which it must go back: less is noise of the encoder.
    """
    out = np.zeros(len(joint_angle), np.int64)
    number, direction, farthest = 0, 0, 0
    for t in range(1, len(joint_angle)):
        gone = float(joint_angle[t] - joint_angle[farthest])
        if direction * gone >= 0.0 and direction:
            farthest = t
        elif abs(gone) >= min_reversal:
            if direction:  # what came since the farthest scan is of the way back already
                number += 1
                out[farthest + 1 : t] = number
            direction, farthest = (1 if gone > 0.0 else -1), t
        out[t] = number
    return out
