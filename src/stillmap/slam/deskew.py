"""Motion while a scan was taken: its beams, each from where the laser was, as seen at its stamp."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.arrays import finite_rows, iter_blocks
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.slam import motion_model
from stillmap.slam.odometry_2d import SlamOptions

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_KNOWN = 0.5  # of the time that a scan takes: over less, poses tell of their own errors
MAX_TURN_RATE = 12.0  # rad/s; what is faster is a leap, no motion
MAX_SPEED = 100.0  # m/s, likewise
_BLOCK = 1 << 14  # beams worked on together


def deskew_recording(
    recording: Recording, poses: Float | None, options: SlamOptions, threads: int = 1
) -> Recording:
    """The recording as if every scan had been taken at once, at its stamp.

    During a scan the robot is taken to go on evenly, along an arc, as from this pose to the next;
    after the last as before it. A beam that was taken before the stamp goes by the motion from the
    pose before. Where one sensor soon follows another, the next pose is the first one that lies
    half a scan away.

    Args:
        recording: it comes back as it is where beams have no times.
        poses: (T, D+1, D+1) of the robot's base at the stamps, in any frame: T_map_base or
            T_odom_base. None: nobody knows, and the recording comes back as it is.
        options: see SlamOptions.
        threads: for sweeps in space; same result with any number.
    """
    times = recording.beam_time
    if times is None or not len(times) or poses is None or not options.deskew:
        return recording
    if recording.dimension == 3:
        return _in_space(recording, poses, times, threads)
    after, before = _pairs(recording.stamp_ns, *_span(times))
    later, earlier = (_twists(recording, poses, *pair) for pair in (after, before))
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
        points[beams] = _carried(recording.points[beams], twist * tau)
        recording.release_pages(points)
    return replace(recording, points=points, beam_time=None)


def _in_space(
    recording: Recording, poses: Float, times: NDArray[np.float32], threads: int
) -> Recording:
    """The same of sweeps in space, which last from one stamp to the next."""
    twists = _twists_in_space(recording.stamp_ns, poses)
    points = recording.allocate_per_beam(np.float32, (3,))

    def of_scan(t: int) -> NDArray[np.float32]:
        beams = recording.beams_of(t)
        T = recording.T_base_sensor[recording.sensor[t]]
        in_base = recording.points[beams] @ T[:3, :3].T + T[:3, 3]
        usable = np.flatnonzero(finite_rows(in_base))
        carried = _core.transform_by_twist(
            in_base.take(usable, axis=0).astype(np.float32), times[beams].take(usable), twists[t]
        )
        out = np.full(in_base.shape, np.nan, np.float32)
        out[usable] = (carried - T[:3, 3]) @ T[:3, :3]
        return out

    in_turn = recording.iter_scans(range(recording.n_scans), points)
    for t, found in enumerate(map_ordered(of_scan, in_turn, threads)):
        points[recording.beams_of(t)] = found
    return replace(recording, points=points, beam_time=None)


def _twists_in_space(stamp_ns: NDArray[np.int64], poses: Float) -> Float:
    """(T, 6) m/s and rad/s from each pose to the next, in the frame of the base; 0 over leaps."""
    seconds = 1e-9 * np.diff(stamp_ns)
    if not len(seconds):
        return np.zeros((len(poses), 6))
    moved = se3.log(se2.inverse(poses[:-1]) @ poses[1:])
    twists = moved / np.where(seconds > 0.0, seconds, np.inf)[:, None]
    leaps = np.linalg.norm(twists[:, :3], axis=1) > MAX_SPEED
    leaps |= np.linalg.norm(twists[:, 3:], axis=1) > MAX_TURN_RATE
    twists[leaps] = 0.0
    return np.concatenate([twists, twists[-1:]])


def _span(times: NDArray[np.float32]) -> tuple[float, float]:
    """Seconds after the stamp of the last beam of all, and before it of the first."""
    parts = [(float(times[b].max()), -float(times[b].min())) for b in iter_blocks(times)]
    longest, earliest = zip(*parts, strict=True)
    return max(longest), max(earliest)


def _pairs(
    stamp_ns: NDArray[np.int64], longest: float, earliest: float
) -> tuple[tuple[Index, Index], tuple[Index, Index]]:
    """Two scans between which each scan's motion is taken: after its stamp, and before it.

    Args:
        stamp_ns: (T,).
        longest: seconds after the stamp, of the last beam.
        earliest: seconds before the stamp, of the first one; 0 or less where none is.
    """
    T = len(stamp_ns)
    here = np.arange(T)

    def following(seconds: float) -> Index:
        return np.searchsorted(stamp_ns, stamp_ns + _span_ns(seconds))

    def preceding(seconds: float) -> Index:
        return np.searchsorted(stamp_ns, stamp_ns - _span_ns(seconds), side="right") - 1

    next_, last = following(longest), preceding(longest)
    ahead = next_ < T
    after = (np.where(ahead, here, np.maximum(last, 0)), np.where(ahead, next_, here))
    if earliest <= 0.0:
        return after, after
    next_, last = following(earliest), preceding(earliest)
    behind = last >= 0
    before = (np.where(behind, last, here), np.where(behind, here, np.minimum(next_, T - 1)))
    return after, before


def _span_ns(seconds: float) -> int:
    return max(round(_KNOWN * seconds * 1e9), 1)


def _twists(recording: Recording, poses: Float, first: Index, second: Index) -> Float:
    """(3, T) m/s, m/s, rad/s of each scan's sensor, in its own frame, between two scans."""
    seconds = 1e-9 * (recording.stamp_ns[second] - recording.stamp_ns[first])
    moved = se2.log(se2.inverse(poses[first]) @ poses[second])
    twists = moved / np.where(seconds > 0.0, seconds, np.inf)[:, None]
    twists[_leaps(poses, first, second) | (np.abs(twists[:, 2]) > MAX_TURN_RATE)] = 0.0
    vx, vy, turn = _steadied(twists).T
    # off the centre of a robot that turns, a sensor goes along with the turn
    x, y, theta = se2.parameters(recording.T_base_sensor[recording.sensor]).T
    vx, vy = vx - turn * y, vy + turn * x
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * vx + s * vy, c * vy - s * vx, turn])


def _leaps(poses: Float, first: Index, second: Index) -> NDArray[np.bool_]:
    """(T,) whether there is a step between two scans that no robot goes."""
    steps = motion_model.compute_odometry_steps(poses)
    implausible = np.zeros(0, np.bool_) if steps is None else ~steps.plausible
    so_far = np.concatenate([[0], np.cumsum(implausible)])
    return np.asarray(so_far[second] > so_far[first])


def _steadied(twists: Float) -> Float:
    """Twists (T, 3), each averaged with those beside it.

    A pose that lies ahead of its neighbours shortens its own scan and stretches the one before by
    as much: both would then be laid where the errors say, again and again. The average of 1/4, 1/2,
    1/4 does not see errors that alternate.
    """
    padded = np.pad(twists, ((1, 1), (0, 0)), mode="edge")
    return 0.25 * padded[:-2] + 0.5 * twists + 0.25 * padded[2:]


def _carried(points: NDArray[np.float32], log_T: Float) -> NDArray[np.float32]:
    """Points (N, 2), each carried by the exponential of log_T (3, N): x, y, angle."""
    dx, dy, angle = log_T
    half = 0.5 * angle
    c, s = np.cos(half), np.sin(half)
    chord = se2.sinc(half, s)
    x, y = points.T.astype(np.float64)
    turned_c, turned_s = 1.0 - 2.0 * s * s, 2.0 * s * c
    out = np.empty_like(points)
    out[:, 0] = turned_c * x - turned_s * y + chord * (c * dx - s * dy)
    out[:, 1] = turned_s * x + turned_c * y + chord * (s * dx + c * dy)
    return out
