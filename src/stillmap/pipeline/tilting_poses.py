"""Poses of one laser's beams, interpolated between the scans of another on the same robot."""

from dataclasses import dataclass, replace

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.recording import Recording, beam_stamps_ns
from stillmap.slam.deskew import MAX_SCAN_GAP, MAX_SPEED

_BLOCK = 1 << 16  # beams per block


@dataclass(frozen=True, eq=False)
class PosedRecording:
    """A 3D recording at the poses of a planar one.

    Attributes:
        deskewed: T scans with M beams without motion during a scan; beams without a known pose are
            unusable.
        poses: (T, 4, 4) T_map_base at the stamps, upright at height zero.
        unposed_beams: number of beams without a known pose.
    """

    deskewed: Recording
    poses: Float
    unposed_beams: int


def interpolate_poses(stamp_ns: Int64, poses: Float, at_ns: Int64) -> tuple[Float, Bool]:
    """Poses at given times, along the arc from one scan to the next.

    Args:
        stamp_ns: (T,) of the scans, non-decreasing, T > 0.
        poses: (T, 3, 3) T_map_base.
        at_ns: (N,) times.

    Returns:
        (N, 3, 3) poses, outside the scans' time the first or the last one; (N,) whether they are
        known.
    """
    last = max(len(poses) - 2, 0)
    before = np.clip(np.searchsorted(stamp_ns, at_ns, side="right") - 1, 0, last)
    after = np.minimum(before + 1, len(poses) - 1)
    seconds = 1e-9 * (stamp_ns[after] - stamp_ns[before])
    since = 1e-9 * (at_ns - stamp_ns[before])
    share = np.clip(since / np.where(seconds > 0.0, seconds, np.inf), 0.0, 1.0)
    twist = se2.log(se2.inverse(poses[before]) @ poses[after])
    known = (at_ns >= stamp_ns[0]) & (at_ns <= stamp_ns[-1])
    leaps = np.linalg.norm(twist[:, :2], axis=1) > MAX_SPEED * seconds
    between = (share > 0.0) & (share < 1.0)
    known &= ~(between & ((seconds > MAX_SCAN_GAP) | leaps))
    return poses[before] @ se2.exp(share[:, None] * twist), known


def pose_recording(recording: Recording, stamp_ns: Int64, poses: Float) -> PosedRecording:
    """Deskews a recording by the poses of other scans.

    Args:
        recording: 3D, M beams.
        stamp_ns: (T,) of the scans of another laser on the same robot, by the same clock.
        poses: (T, 3, 3) T_map_base of these.
    """
    at_scan, known = interpolate_poses(stamp_ns, poses, recording.stamp_ns)
    points = recording.allocate_per_beam(np.float32, (3,))
    hit = recording.allocate_per_beam(np.bool_)
    unposed, step = 0, max(1, _BLOCK * recording.n_scans // max(recording.n_beams, 1))
    for first in range(0, recording.n_scans, step):
        scans = slice(first, min(first + step, recording.n_scans))
        beams = slice(int(recording.offset[scans.start]), int(recording.offset[scans.stop]))
        counts = np.diff(recording.offset[scans.start : scans.stop + 1])
        scan = np.repeat(np.arange(scans.start, scans.stop), counts)
        moved, posed = recording.points[beams], known[scan]
        if recording.beam_time is not None:
            T, posed = interpolate_poses(stamp_ns, poses, beam_stamps_ns(recording, scans))
            T_base_sensor = recording.T_base_sensor[recording.sensor[scan]]
            moved = _transform_points(moved, T_base_sensor, se2.inverse(at_scan[scan]) @ T)
        points[beams] = np.where(posed[:, None], moved, np.nan)
        hit[beams] = recording.hit[beams] & posed
        unposed += int(np.count_nonzero(~posed))
        recording.release_pages(points, hit)
    deskewed = replace(recording, points=points, hit=hit, beam_time=None)
    return PosedRecording(deskewed, lift_poses(at_scan), unposed)


def lift_poses(poses: Float) -> Float:
    """(T, 4, 4) upright poses at height zero, of (T, 3, 3) in the plane."""
    out = np.zeros((len(poses), 4, 4))
    out[:, :2, :2], out[:, :2, 3] = poses[:, :2, :2], poses[:, :2, 2]
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    return out


def _transform_points(points: Float32, T_base_sensor: Float, T: Float) -> Float32:
    """Points (n, 3) of sensors at (n, 4, 4) on a base moved by T (n, 3, 3), in the sensor frame."""
    R, t = T_base_sensor[:, :3, :3], T_base_sensor[:, :3, 3]
    in_base = np.einsum("nij,nj->ni", R, points) + t
    in_base[:, :2] = np.einsum("nij,nj->ni", T[:, :2, :2], in_base[:, :2]) + T[:, :2, 2]
    return np.asarray(np.einsum("nji,nj->ni", R, in_base - t), np.float32)
