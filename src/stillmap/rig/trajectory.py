"""Where a laser was at each of its beams, known from the scans of another one on the same robot."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.core.timestamps import beam_stamps_ns

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Stamps = NDArray[np.int64]

_BLOCK = 1 << 16  # beams worked on together
_FASTEST = 100.0  # m/s; what is faster is a leap, no motion


@dataclass(frozen=True, eq=False)
class PosedRecording:
    """A recording in 3D on the way that a planar one tells.

    Attributes:
        seen: T scans with M beams, without motion during a scan; what was taken when nobody knows
            the way is unusable.
        poses: (T, 4, 4) T_map_base at the stamps, upright and at the height zero.
        left_out: beams that were taken then.
    """

    seen: Recording
    poses: Float
    left_out: int


def interpolate_poses(
    stamp_ns: Stamps, poses: Float, at_ns: Stamps, pause: float
) -> tuple[Float, Bool]:
    """Poses between those of scans: from one to the next the robot went on evenly along an arc.

    Args:
        stamp_ns: (T,) of the scans, non-decreasing, T > 0.
        poses: (T, 3, 3) T_map_base.
        at_ns: (N,) when they are wanted.
        pause: s between two scans, over which nobody knows.

    Returns:
        (N, 3, 3) poses, outside the scans' time the first and the last one; (N,) whether they are
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
    leaps = np.linalg.norm(twist[:, :2], axis=1) > _FASTEST * seconds
    between = (share > 0.0) & (share < 1.0)
    known &= ~(between & ((seconds > pause) | leaps))
    return poses[before] @ se2.exp(share[:, None] * twist), known


def pose_recording(
    recording: Recording, stamp_ns: Stamps, poses: Float, pause: float
) -> PosedRecording:
    """Every beam of a recording at its place, from where the robot was at its time.

    Args:
        recording: 3D, M beams.
        stamp_ns: (T,) of other scans on the same robot, by the same clock.
        poses: (T, 3, 3) T_map_base of these.
        pause: s between two of them, over which nobody knows where the robot was.
    """
    at_scan, known = interpolate_poses(stamp_ns, poses, recording.stamp_ns, pause)
    points, hit = (
        recording.allocate_per_beam(np.float32, (3,)),
        recording.allocate_per_beam(np.bool_),
    )
    left_out, step = 0, max(1, _BLOCK * recording.n_scans // max(recording.n_beams, 1))
    for first in range(0, recording.n_scans, step):
        scans = slice(first, min(first + step, recording.n_scans))
        beams = slice(int(recording.offset[scans.start]), int(recording.offset[scans.stop]))
        scan = np.repeat(
            np.arange(scans.start, scans.stop), np.diff(recording.offset[scans.start :][: step + 1])
        )
        moved, there = recording.points[beams], known[scan]
        if recording.beam_time is not None:
            T, there = interpolate_poses(stamp_ns, poses, beam_stamps_ns(recording, scans), pause)
            T_base_sensor = recording.T_base_sensor[recording.sensor[scan]]
            moved = _carried(moved, T_base_sensor, se2.inverse(at_scan[scan]) @ T)
        points[beams] = np.where(there[:, None], moved, np.nan)
        hit[beams] = recording.hit[beams] & there
        left_out += int(np.count_nonzero(~there))
        recording.release_pages(points, hit)
    seen = replace(recording, points=points, hit=hit, beam_time=None)
    return PosedRecording(seen, lift_poses(at_scan), left_out)


def lift_poses(poses: Float) -> Float:
    """(T, 4, 4) upright poses in space at the height zero, of (T, 3, 3) in the plane."""
    out = np.zeros((len(poses), 4, 4))
    out[:, :2, :2], out[:, :2, 3] = poses[:, :2, :2], poses[:, :2, 2]
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    return out


def _carried(points: NDArray[np.float32], T_base_sensor: Float, T: Float) -> NDArray[np.float32]:
    """Points (n, 3) of sensors (n, 4, 4) on a robot that was at T (n, 3, 3) when they were seen."""
    R, t = T_base_sensor[:, :3, :3], T_base_sensor[:, :3, 3]
    in_base = np.einsum("nij,nj->ni", R, points) + t
    in_base[:, :2] = np.einsum("nij,nj->ni", T[:, :2, :2], in_base[:, :2]) + T[:, :2, 2]
    return np.asarray(np.einsum("nji,nj->ni", R, in_base - t), np.float32)
