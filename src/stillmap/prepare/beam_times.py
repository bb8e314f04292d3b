"""Times of the beams of a spinning lidar, and assembly of a tilting laser by its joint."""

import math
from dataclasses import replace

import numpy as np

from stillmap.core.array_types import Float, Float32, Int64
from stillmap.core.recording import Recording, beam_stamps_ns
from stillmap.core.source import Spin

_SIGN = {"clockwise": -1.0, "counter-clockwise": 1.0}
_TURN = 2.0 * math.pi
_SPIN_START = math.pi  # rad, azimuth at which a revolution begins: behind the robot
_RATES = (0.5, 200.0)  # 1/s, revolutions of lidars; stamps farther apart miss scans
_BLOCK = 1 << 16  # beams transformed at once


def add_beam_times(recording: Recording, direction: str) -> Recording:
    """Add `beam_time` from the azimuth of each point; one revolution lasts from stamp to stamp.

    The stamp is that of the beam at `source.stamp_azimuth`, else of the first one, behind.

    Args:
        recording: 3D. Returned unchanged, with a warning, where it has beam times or its stamps
            give no rate.
        direction: `clockwise` or `counter-clockwise` seen from above; any other: no change.
    """
    if direction not in _SIGN or recording.source.spin is not None:
        return recording
    if recording.beam_time is not None:
        return _with_warning(recording, "read.spin is ignored: beams have times of their own")
    rates = [_spin_rate(recording, k) for k in range(len(recording.T_base_sensor))]
    if not all(rates):
        return _with_warning(recording, "read.spin is ignored: the stamps give no rate of turns")
    per_second = np.array(rates, np.float64)
    noted = recording.source.stamp_azimuth
    stamp_azimuth = _SPIN_START if noted is None else noted
    beam_time = recording.allocate_per_beam(np.float32)
    for t in recording.iter_scans(range(recording.n_scans), beam_time):
        beams = recording.beams_of(t)
        turns = turns_since_stamp(recording.points[beams], direction, stamp_azimuth)
        beam_time[beams] = turns / per_second[recording.sensor[t]]
    rounded = [round(float(rate), 4) for rate in per_second]
    spin = Spin(direction, rounded, _SPIN_START, stamp_azimuth)
    return replace(recording, beam_time=beam_time, source=replace(recording.source, spin=spin))


def turns_since_stamp(points: Float32, direction: str, stamp_azimuth: float = _SPIN_START) -> Float:
    """(n,) revolutions between the stamp and each of points (n, 3); 0 for unusable points."""
    sign = _SIGN[direction]
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    since_start = np.mod(sign * (azimuth - _SPIN_START), _TURN)
    stamp = math.fmod(sign * (stamp_azimuth - _SPIN_START), _TURN) % _TURN
    return np.nan_to_num((since_start - stamp) / _TURN)


def _spin_rate(recording: Recording, sensor: int) -> float | None:
    """Revolutions per second of a sensor, from the median time between stamps; None: unknown."""
    stamps = recording.stamp_ns[recording.sensor == sensor]
    if len(stamps) < 2:
        return None
    seconds = float(np.median(np.diff(stamps))) / 1e9
    return 1.0 / seconds if 1.0 / _RATES[1] <= seconds <= 1.0 / _RATES[0] else None


def _with_warning(recording: Recording, what: str) -> Recording:
    source = replace(recording.source, warnings=[*recording.source.warnings, what])
    return replace(recording, source=source)


def assemble_tilting_laser(
    recording: Recording,
    joint_ns: Int64,
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
        angle = np.interp(seconds_of_beams, seconds, joint_angle)
        points[beams] = rotate_about_axis(local, np.array(axis), angle)
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
