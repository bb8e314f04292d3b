"""Removal of what cannot be: beams that are too long, leaps, far poses, late odometry.

Beams that are too long take time and memory in proportion to the cells that they cross, and few of
them lie close enough together to show a surface.

Late readings of odometry are older than the scans that they are attached to: the step to such a
scan is too short and the next ones are too long, until odometry has caught up; the average speed
over the whole interval is the usual one. Where scans show the motion they correct such readings.
Along a bare corridor they do not.
"""

import math
from dataclasses import replace

import numpy as np

from stillmap.core import arrays, se2, se3
from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.errors import advise
from stillmap.core.recording import Recording
from stillmap.core.square_box import find_busiest
from stillmap.prepare.max_range import DECLARED, GIVEN
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE, MAX_POINT_DISTANCE

# m, and cells, by dimension: a beam is followed up to the greater of both. Planar lasers of robots
# reach 80 m, lidars 300 m; 2000 cells in all directions take half a gigabyte in 2D
_LEAST_REACH = {2: 100.0, 3: MAX_PLAUSIBLE_RANGE}
_REACH_CELLS = {2: 2000, 3: 8000}
# m and m/s: beyond both, a step of odometry is none; airliners do 250 m/s, and odometry that starts
# again within the same building is told from the scans
_MIN_LEAP, _MAX_SPEED = 100.0, 300.0
# cells from the middle, by dimension: a quarter of those that kernels number
_REACH = {2: 1 << 22, 3: 1 << 21}
_MAX_STEPS = 4  # of an interval from one timely reading to the next
_ACCELERATION, _ANGULAR_ACCELERATION = 2.0, 4.0  # m/s^2, rad/s^2 that robots reach
_MIN_LAG = 0.15  # m and rad behind constant speed from which a reading is late
# difference between the speeds before and after an interval, and twice that between their mean and
# the interval's, as shares of their mean
_MAX_SPEED_CHANGE = 0.5
_MIN_DURATION = 1e-3  # s: scans at the same time show no speed
_MAX_LATE_SHARE = 0.02  # of the scans: if more seem late, their stamps are uneven


def stated_max_range(recording: Recording) -> float | None:
    """The longest maximum range of its lasers, in metres, that the user or the recording states.

    None: nobody does; a code among the readings says nothing about the reach of a laser.
    """
    rules = [sensor.ranges for sensor in recording.source.sensors if sensor.ranges is not None]
    stated = (r.threshold for r in rules if r.threshold_how.startswith((GIVEN, DECLARED)))
    return max(filter(None, stated), default=None)


def mapped_range(dimension: int, resolution: float, max_range: float | None = None) -> float:
    """Range in metres up to which beams are mapped.

    Args:
        dimension: 2 or 3.
        resolution: m, edge of a cell.
        max_range: m, that the user or the recording states of the sensor; None: not stated.
    """
    reach = max(_LEAST_REACH[dimension], _REACH_CELLS[dimension] * resolution)
    return reach if max_range is None else max(reach, max_range)


def leave_out_far_returns(
    recording: Recording, resolution: float, max_range: float | None = None
) -> tuple[Recording, list[str]]:
    """The recording with beams up to the mapped range alone, and a sentence about the others.

    Returns from farther away are not used. Beams without a return are shortened to the longest
    return that is left: they were as long because of the others. Where all beams are near, the
    recording itself.

    Args:
        recording: M beams.
        resolution, max_range: as of `mapped_range`.
    """
    reach = mapped_range(recording.dimension, resolution, max_range)
    blocks = [np.zeros(0, np.intp)]
    for block in arrays.iter_blocks(recording.points):
        squared = arrays.squared_lengths(recording.points[block])
        blocks.append(np.flatnonzero(squared > reach * reach) + block.start)
    far = np.concatenate(blocks)
    if not len(far):
        return recording, []
    points, hit = recording.copy_beams()
    returns, free = far[recording.hit[far]], far[~recording.hit[far]]
    points[returns], hit[returns] = np.nan, False
    kept = replace(recording, points=points, hit=hit)
    if len(free):
        limit = _longest_return(kept) or reach
        length = np.linalg.norm(points[free].astype(np.float64), axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):  # infinite ones become NaN
            points[free] = (points[free] * (limit / length)).astype(np.float32)
    if not len(returns):
        return kept, []
    total = int(np.count_nonzero(recording.hit))
    what = f"{len(returns)} of {total} returns are farther than {reach:.4g} m: they are not used"
    todo = "if the sensor reaches that far, say so by read.max_range"
    if reach >= MAX_PLAUSIBLE_RANGE:
        todo = "a coarser slam.voxel_size, in 2D slam.resolution, maps them"
    return kept, [advise(what, todo)]


def shorten_far_beams(points: Float32, hit: Bool, reach: float) -> tuple[Float32, Bool]:
    """The beams of one scan up to a range: returns beyond it show nothing, other beams end there.

    Args:
        points: (N, D) end points in the sensor frame, m.
        hit: (N,) beams with a return.
        reach: m.
    """
    length = np.linalg.norm(points.astype(np.float64), axis=1)
    far = length > reach
    if not far.any():
        return points, hit
    scale = np.where(far & ~hit, reach / np.where(far, length, 1.0), np.where(far, np.nan, 1.0))
    return (points * scale[:, None]).astype(np.float32), hit & ~far


def _longest_return(recording: Recording) -> float:
    """Length of the longest return, m; 0: there is none."""
    longest = 0.0
    for block in arrays.iter_blocks(recording.points, recording.hit):
        squared = arrays.squared_lengths(recording.points[block])
        longest = max(longest, float(squared[recording.hit[block]].max(initial=0.0)))
    return math.sqrt(longest)


def remove_leaps(recording: Recording) -> tuple[Recording, list[str]]:
    """The recording with odometry that goes on as before where it leapt, and a sentence about it.

    Without leaps the recording itself.
    """
    T = recording.T_odom_base
    if T is None or len(T) < 2:
        return recording, []
    steps = np.linalg.norm(np.diff(T[:, :-1, -1], axis=0), axis=1)
    seconds = 1e-9 * np.diff(recording.stamp_ns)
    leaps = np.flatnonzero(steps > np.maximum(_MIN_LEAP, _MAX_SPEED * seconds))
    if not len(leaps):
        return recording, []
    corrected = T.copy()
    for last, end in zip(leaps, [*leaps[1:].tolist(), len(T) - 1], strict=True):
        part, start = slice(last + 1, end + 1), corrected[last]
        step = se2.inverse(corrected[last - 1]) @ start if last else np.eye(len(start))
        corrected[part] = start @ step @ se2.inverse(T[last + 1]) @ T[part]
    corrected = (se2 if recording.dimension == 2 else se3).normalize(corrected)
    first = leaps[0]
    sentence = (
        f"odometry leaps at {len(leaps)} scan{'s' * (len(leaps) > 1)}, first before scan "
        f"{first + 1} by {steps[first]:.4g} m in {seconds[first]:.3g} s: the scans alone say how "
        "the robot moved there"
    )
    return replace(recording, T_odom_base=corrected), [sentence]


def leave_out_far_scans(
    recording: Recording, poses: Float, resolution: float
) -> tuple[Recording, list[str]]:
    """The recording without the beams of scans too far from most others, and a sentence about it.

    Where no scan is, the recording itself.

    Args:
        recording: T scans.
        poses: (T, D+1, D+1) T_map_base that were given, in a frame that begins at one of them.
        resolution: m, edge of a cell.
    """
    xy = poses[:, :2, -1]
    numbered = _REACH[recording.dimension] * resolution
    reach = min(MAX_POINT_DISTANCE, numbered)
    middle = find_busiest(np.floor(xy).astype(np.int64), int(reach))
    if np.abs(middle).max() > numbered:  # of two places the one where the frame begins
        middle = np.zeros(2, np.int64)
    distance = np.linalg.norm(poses[:, :-1, -1] - [*middle, 0.0][: recording.dimension], axis=1)
    far = np.flatnonzero(distance > reach)
    if not len(far):
        return recording, []
    points, hit = recording.copy_beams()
    for t in far.tolist():
        beams = recording.beams_of(t)
        points[beams], hit[beams] = np.nan, False
    first, places = far[0], poses[far[0], :2, -1]
    sentence = advise(
        f"{len(far)} scan{'s are' if len(far) > 1 else ' is'} farther than {reach / 1e3:g} km from "
        f"most others by the given poses, first scan {first} at ({places[0]:.7g}, {places[1]:.7g}) "
        "m: the beams are not used",
        "correct these poses",
    )
    return replace(recording, points=points, hit=hit), [sentence]


def interpolate_late_odometry(stamp_ns: Int64, T_odom_base: Float) -> tuple[Float, Index]:
    """Odometry (T, 3, 3) with late readings interpolated, and the scans (K,) that they belong to.

    Args:
        stamp_ns: (T,) of the scans.
        T_odom_base: (T, 3, 3).
    """
    out, late = T_odom_base.copy(), set[int]()
    seconds: Float = 1e-9 * (stamp_ns - stamp_ns[:1]).astype(np.float64)
    for n in range(2, _MAX_STEPS + 1):
        for first in _find_late_intervals(seconds, out, n).tolist():
            inside = range(first + 1, first + n)
            if not late.intersection(inside):
                out[inside] = _interpolate(seconds, out, first, n)
                late.update(inside)
    if len(late) > max(_MAX_LATE_SHARE * len(out), 1.0):
        return T_odom_base, np.zeros(0, np.intp)
    return out, np.array(sorted(late), np.intp)


def _find_late_intervals(seconds: Float, T_odom_base: Float, n: int) -> Index:
    """First scans of the intervals of n steps within which odometry is late."""
    first = np.arange(1, len(seconds) - n - 1)
    if len(first) == 0:
        return first
    dt = np.diff(seconds).clip(_MIN_DURATION)
    velocity = se2.log(se2.increments(T_odom_base)) / dt[:, None]
    before, after = velocity[first - 1], velocity[first + n]
    usual = 0.5 * (before + after)
    duration = (seconds[first + n] - seconds[first]).clip(_MIN_DURATION)
    motion = se2.log(se2.inverse(T_odom_base[first]) @ T_odom_base[first + n])
    excess = motion / duration[:, None] - usual
    is_late = np.zeros(len(first), np.bool_)
    for axes, acceleration in (([0, 1], _ACCELERATION), ([2], _ANGULAR_ACCELERATION)):
        vectors = (usual, after - before, 2.0 * excess)
        speed, change, deviation = (np.linalg.norm(each[:, axes], axis=1) for each in vectors)
        is_steady = np.maximum(change, deviation) < _MAX_SPEED_CHANGE * speed
        for k in range(1, n):
            since = (seconds[first + k] - seconds[first]).clip(0.0, duration)
            expected = T_odom_base[first] @ se2.exp((since / duration)[:, None] * motion)
            off = se2.parameters(se2.inverse(expected) @ T_odom_base[first + k])[:, axes]
            lag = -(off * usual[:, axes]).sum(axis=1) / speed.clip(1e-9)
            min_lag = np.maximum(_MIN_LAG, 0.5 * acceleration * since * (duration - since))
            is_late |= is_steady & (lag > min_lag)
    return first[is_late]


def _interpolate(seconds: Float, T_odom_base: Float, first: int, n: int) -> Float:
    """(n - 1, 3, 3) poses between two scans at constant speed."""
    here, there = T_odom_base[first], T_odom_base[first + n]
    since = seconds[first + 1 : first + n] - seconds[first]
    share = since / (seconds[first + n] - seconds[first])
    return np.asarray(here @ se2.exp(share[:, None] * se2.log(se2.inverse(here) @ there)))
