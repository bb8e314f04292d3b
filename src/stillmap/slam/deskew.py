"""Deskewing: removes the motion of the robot during a scan from its end points."""

from dataclasses import replace

import numpy as np

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.arrays import finite_rows, iter_blocks
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.slam import motion_model
from stillmap.slam.options import SlamOptions

MAX_SPEED, MAX_TURN_RATE = 100.0, 12.0  # m/s, rad/s; faster steps are leaps, not motion
# share of a scan's duration between two poses, at least: over less, their errors dominate
_MIN_SPAN = 0.5
MAX_SCAN_GAP = 1.0  # s between two scans over which the pose is unknown
_BLOCK = 1 << 14  # beams per block


def deskew_recording(
    recording: Recording, poses: Float | None, options: SlamOptions, threads: int = 1
) -> Recording:
    """The recording as if each scan had been taken at its stamp.

    The velocity during a scan is constant: from its pose to the next one, after the last scan that
    before it. Beams before the stamp use the velocity from the previous pose. Where several sensors
    alternate, the other pose is the first one at least half a scan away.

    Args:
        recording: returned unchanged if beams have no times.
        poses: (T, D+1, D+1) of the base at the stamps in any frame; None: returned unchanged.
        options: see SlamOptions.
        threads: of 3D recordings; the result does not depend on it.
    """
    times = recording.beam_time
    if times is None or not len(times) or poses is None or not options.deskew:
        return recording
    if recording.dimension == 3:
        return _deskew_3d(recording, poses, times, threads)
    after, before = _select_scan_pairs(recording.stamp_ns, *_max_beam_times(times))
    later, earlier = (_sensor_twists(recording, poses, *pair) for pair in (after, before))
    points = recording.allocate_per_beam(np.float32, (recording.dimension,))
    scans = max(1, _BLOCK * recording.n_scans // len(times))
    for first in range(0, recording.n_scans, scans):
        offset = recording.offset[first : first + scans + 1]
        beams, counts = slice(int(offset[0]), int(offset[-1])), np.diff(offset)
        tau = times[beams].astype(np.float64)
        twist = later[:, first : first + scans].repeat(counts, axis=1)
        if before is not after:
            back = earlier[:, first : first + scans].repeat(counts, axis=1)
            twist = np.where(tau < 0.0, back, twist)
        points[beams] = _transform_by_twist(recording.points[beams], twist * tau)
        recording.release_pages(points)
    return replace(recording, points=points, beam_time=None)


def _deskew_3d(recording: Recording, poses: Float, times: Float32, threads: int) -> Recording:
    twists = _base_twists_3d(recording.stamp_ns, poses)
    points = recording.allocate_per_beam(np.float32, (3,))

    def deskew_scan(t: int) -> Float32:
        beams = recording.beams_of(t)
        T = recording.T_base_sensor[recording.sensor[t]]
        in_base = recording.points[beams] @ T[:3, :3].T + T[:3, 3]
        usable = np.flatnonzero(finite_rows(in_base))
        moved = _core.transform_by_twist(
            in_base.take(usable, axis=0).astype(np.float32), times[beams].take(usable), twists[t]
        )
        out = np.full(in_base.shape, np.nan, np.float32)
        out[usable] = (moved - T[:3, 3]) @ T[:3, :3]
        return out

    scans = recording.iter_scans(range(recording.n_scans), points)
    for t, found in enumerate(map_ordered(deskew_scan, scans, threads)):
        points[recording.beams_of(t)] = found
    return replace(recording, points=points, beam_time=None)


def _base_twists_3d(stamp_ns: Int64, poses: Float) -> Float:
    """(T, 6) m/s and rad/s from each pose to the next in the base frame; 0 over leaps."""
    seconds = 1e-9 * np.diff(stamp_ns)
    if not len(seconds):
        return np.zeros((len(poses), 6))
    steps = se3.log(se2.increments(poses))
    twists = steps / np.where(seconds > 0.0, seconds, np.inf)[:, None]
    leaps = np.linalg.norm(twists[:, :3], axis=1) > MAX_SPEED
    leaps |= np.linalg.norm(twists[:, 3:], axis=1) > MAX_TURN_RATE
    twists[leaps] = 0.0
    return np.concatenate([twists, twists[-1:]])


def _max_beam_times(times: Float32) -> tuple[float, float]:
    """Seconds after the stamp of the last beam of all, and before the stamp of the first."""
    parts = [(float(times[b].max()), -float(times[b].min())) for b in iter_blocks(times)]
    latest, earliest = zip(*parts, strict=True)
    return max(latest), max(earliest)


def _select_scan_pairs(
    stamp_ns: Int64, latest: float, earliest: float
) -> tuple[tuple[Index, Index], tuple[Index, Index]]:
    """Two scans from whose poses each scan's velocity follows: after its stamp, and before it.

    Twice the same, so that there is none, where the recording is too short to tell.

    Args:
        stamp_ns: (T,).
        latest: seconds after the stamp of the last beam.
        earliest: seconds before the stamp of the first beam; 0 or less: none.
    """
    T = len(stamp_ns)
    here = np.arange(T)

    def neighbors(seconds: float) -> tuple[Index, Index]:
        span = max(round(_MIN_SPAN * seconds * 1e9), 1)
        preceding = np.searchsorted(stamp_ns, stamp_ns - span, side="right") - 1
        return np.searchsorted(stamp_ns, stamp_ns + span), preceding

    next_, last = neighbors(latest)
    ahead = next_ < T
    after = (np.where(ahead | (last < 0), here, last), np.where(ahead, next_, here))
    if earliest <= 0.0:
        return after, after
    next_, last = neighbors(earliest)
    behind = last >= 0
    before = (np.where(behind, last, here), np.where(behind | (next_ == T), here, next_))
    return after, before


def _sensor_twists(recording: Recording, poses: Float, first: Index, second: Index) -> Float:
    """(3, T) m/s, m/s, rad/s of each scan's sensor in its own frame, between two scans."""
    seconds = 1e-9 * (recording.stamp_ns[second] - recording.stamp_ns[first])
    steps = se2.log(se2.inverse(poses[first]) @ poses[second])
    twists = steps / np.where(seconds > 0.0, seconds, np.inf)[:, None]
    is_leap = _has_leap(poses, recording.stamp_ns, first, second) | (
        np.abs(twists[:, 2]) > MAX_TURN_RATE
    )
    is_leap |= np.hypot(twists[:, 0], twists[:, 1]) > MAX_SPEED
    twists[is_leap] = 0.0
    vx, vy, turn = _smooth(twists).T
    # lever arm: a sensor off the center of rotation moves with the rotation
    x, y, theta = se2.parameters(recording.T_base_sensor[recording.sensor]).T
    vx, vy = vx - turn * y, vy + turn * x
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * vx + s * vy, c * vy - s * vx, turn])


def _has_leap(poses: Float, stamp_ns: Int64, first: Index, second: Index) -> Bool:
    """(T,) whether an implausible step lies between two scans."""
    plausible = motion_model.compute_odometry_steps(poses, stamp_ns).plausible
    count = np.concatenate([[0], np.cumsum(~plausible)])
    return np.asarray(count[second] > count[first])


def _smooth(twists: Float) -> Float:
    """Twists (T, 3), filtered by 1/4, 1/2, 1/4, which suppresses alternating errors.

    A pose ahead of its neighbors shortens its own scan and stretches the one before by as much;
    unfiltered, such errors would reproduce themselves in every iteration.
    """
    padded = np.pad(twists, ((1, 1), (0, 0)), mode="edge")
    return 0.25 * padded[:-2] + 0.5 * twists + 0.25 * padded[2:]


def _transform_by_twist(points: Float32, log_T: Float) -> Float32:
    """Points (N, 2), each transformed by the exponential of log_T (3, N): x, y, angle."""
    dx, dy, angle = log_T
    half = 0.5 * angle
    c, s = np.cos(half), np.sin(half)
    chord = se2.sinc(half, s)
    x, y = points.T.astype(np.float64)
    cos_angle, sin_angle = 1.0 - 2.0 * s * s, 2.0 * s * c
    out = np.empty_like(points)
    out[:, 0] = cos_angle * x - sin_angle * y + chord * (c * dx - s * dy)
    out[:, 1] = sin_angle * x + cos_angle * y + chord * (s * dx + c * dy)
    return out
