"""Tilting-laser assembly: scans of a 2D laser on a joint become a 3D recording."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core.beam_times import beam_stamps_ns
from stillmap.core.recording import Recording

Float = NDArray[np.float64]

_BLOCK = 1 << 16  # beams transformed at once


def assemble_tilting_laser(
    recording: Recording,
    joint_ns: NDArray[np.int64],
    joint_angle: Float,
    axis: tuple[float, float, float],
    T_base_joint: Float,
    T_joint_laser: Float | None = None,
) -> Recording:
    """Transform a 2D recording to 3D points in the frame of the joint's fixed part.

    The angle is interpolated linearly between readings, and constant outside them.

    Args:
        recording: 2D, of a laser on a joint.
        joint_ns: (J,) stamps of the joint readings, non-decreasing, on the same clock; J > 0.
        joint_angle: (J,) rad, right-handed about `axis`.
        axis: unit vector in the frame of the joint.
        T_base_joint: (4, 4).
        T_joint_laser: (4, 4) at angle zero; None: identity.

    Raises:
        ValueError: the recording is not 2D, or counts of stamps and angles differ.
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
        seconds_of_beams = 1e-9 * (beam_stamps_ns(recording, scans) - joint_ns[0])
        flat = recording.points[beams].astype(np.float64)
        local = flat @ T[:3, :2].T + T[:3, 3]
        points[beams] = rotate_about_axis(
            local, np.array(axis), np.interp(seconds_of_beams, seconds, joint_angle)
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
    """(n, 3) points rotated about a unit axis (3,) by angles (n,) in rad: Rodrigues' formula."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along = (points @ axis)[:, None] * axis
    return np.asarray(along + c * (points - along) + s * np.cross(axis, points))


def sweep_indices(joint_angle: Float, min_reversal: float = 0.02) -> NDArray[np.int64]:
    """(T,) sweep index of each scan; a sweep ends where the joint reverses.

    Args:
        joint_angle: (T,) rad at each scan.
        min_reversal: rad; smaller reversals are encoder noise.
    """
    out = np.zeros(len(joint_angle), np.int64)
    sweep, direction, turning = 0, 0, 0
    for t in range(1, len(joint_angle)):
        change = float(joint_angle[t] - joint_angle[turning])
        if direction * change >= 0.0 and direction:
            turning = t
        elif abs(change) >= min_reversal:
            if direction:  # scans since the turning point belong to the new sweep
                sweep += 1
                out[turning + 1 : t] = sweep
            direction, turning = (1 if change > 0.0 else -1), t
        out[t] = sweep
    return out
