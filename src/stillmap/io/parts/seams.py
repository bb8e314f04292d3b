"""Decides whether a recording goes on where another one ends, by stamps, odometry and sensors.

A part begins about where another one ends, in time and in odometry. Recordings of the same time
with other scans come from another robot; after a pause, or with an odometry that starts anew, a
recording is a session of its own.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.io.parts.facts import RecordingFacts

Float = NDArray[np.float64]

# a pause between parts: as long as pauses within them or some scans, but no longer than recorders
# take for a new file; odometry that goes on shows that it is the same run
_MAX_PAUSE_SCANS = 20
_MIN_PAUSE, _MAX_PAUSE, _MAX_PAUSE_WITH_ODOMETRY = 1.0, 10.0, 60.0  # s
_MAX_STRAY_SCANS = 3  # of an overlap that are in one part only: recorders lose some at the seam
_MAX_STRAY_SHARE = 0.1
_MIN_EQUAL_RANGES = 0.9  # share of the ranges that equal scans have in common
_SAME_RANGE = 1e-3  # m: the same reading, converted twice
_SAME_PLACE, _SAME_ANGLE = 0.01, 0.02  # m, rad: of a sensor on the robot
# odometry from one part to the next: faster than usual, but within reach
_SPEED_FACTOR, _MIN_SPEED, _MIN_TURN_RATE = 1.5, 1.0, 1.0  # m/s, rad/s
_SPEED_SPAN = 0.5  # s over which speed is measured
_USUAL_SHARE = 0.98  # quantile of speeds: odometry has single jumps
_SLACK = 0.3  # s: readings of odometry lie before or after the scans
_ROUNDING = 0.05  # m, rad
_ZERO = 1e-3  # m, rad: where odometry begins when it is switched on


@dataclass(frozen=True)
class Seam:
    """The seam at which a part goes on after another one.

    Attributes:
        gap: seconds from the end of one to the beginning of the other; negative: they overlap.
        repeated: number of scans that are in both.
        step: metres between their odometry; None: without odometry.
    """

    gap: float
    repeated: int
    step: float | None


def compare(earlier: RecordingFacts, later: RecordingFacts) -> Seam | str:
    """The seam between a recording and one that begins no earlier; else why there is none."""
    if earlier.dimension != later.dimension:
        return f"is {later.dimension}D, {earlier.path} is {earlier.dimension}D"
    if other := _compare_sensors(earlier, later):
        return other
    if (earlier.T_odom_base is None) != (later.T_odom_base is None):
        has, lacks = ("has no", "has") if later.T_odom_base is None else ("has", "has none")
        return f"{has} odometry, {earlier.path} {lacks}"
    gap = (later.first_ns - earlier.last_ns) / 1e9
    if gap > _longest_pause(earlier, later):
        return f"begins {format_duration(gap)} after {earlier.path} ends"
    pairs = _find_repeats(earlier, later) if gap <= 0.0 else np.zeros((0, 2), np.intp)
    if gap <= 0.0 and not _is_overlap_of_parts(earlier, later, len(pairs)):
        return f"is of the same time as {earlier.path}, with other scans"
    step = _compare_odometry(earlier, later, gap, pairs)
    if isinstance(step, str):
        return step
    return Seam(gap, len(pairs), step)


def _compare_sensors(earlier: RecordingFacts, later: RecordingFacts) -> str:
    """The difference between the sensors; "" where they may be the same."""
    if len(earlier.sensors) != len(later.sensors):
        return f"has {len(later.sensors)} sensors, {earlier.path} has {len(earlier.sensors)}"
    for a, b in zip(earlier.sensors, later.sensors, strict=True):
        if a.name != b.name:
            return f"has scans of {b.name or 'a sensor without a name'}, {earlier.path} of {a.name}"
        if None not in (a.n_beams, b.n_beams) and a.n_beams != b.n_beams:
            return f"has {b.n_beams} beams per scan, {earlier.path} has {a.n_beams}"
        if a.T_base_sensor is not None and b.T_base_sensor is not None:
            metres, radians = _measure_motion(a.T_base_sensor, b.T_base_sensor)
            if metres > _SAME_PLACE or radians > _SAME_ANGLE:
                return f"has a sensor at another place on the robot than {earlier.path}"
    return ""


def _longest_pause(*facts: RecordingFacts) -> float:
    """The longest time, s, from one part to the next."""
    steps = np.concatenate([np.diff(one.stamp_ns) for one in facts]) / 1e9
    interval = _usual_interval(*facts)
    usual = max(_MAX_PAUSE_SCANS * interval, float(steps.max(initial=0.0)))
    has_odometry = all(one.T_odom_base is not None for one in facts)
    longest = _MAX_PAUSE_WITH_ODOMETRY if has_odometry else _MAX_PAUSE
    return max(float(np.clip(usual, _MIN_PAUSE, longest)), 2.0 * interval)


def _usual_interval(*facts: RecordingFacts) -> float:
    """Median time between scans, s; 0 where there is one scan each."""
    steps = np.concatenate([np.diff(one.stamp_ns) for one in facts])
    steps = steps[steps > 0]  # scans of several sensors at once
    return float(np.median(steps)) / 1e9 if len(steps) else 0.0


def _overlap(earlier: RecordingFacts, later: RecordingFacts) -> tuple[slice, slice]:
    """The scans of each that lie in the time of both."""
    first, last = later.first_ns, min(earlier.last_ns, later.last_ns)
    a = slice(*np.searchsorted(earlier.stamp_ns, [first, last + 1]).tolist())
    return a, slice(0, int(np.searchsorted(later.stamp_ns, last, side="right")))


def _find_repeats(earlier: RecordingFacts, later: RecordingFacts) -> NDArray[np.intp]:
    """(R, 2) the scans of both that have the same stamp and ranges."""
    _, b = _overlap(earlier, later)
    pairs, taken = [], set[int]()
    for k in range(b.stop):
        stamp = later.stamp_ns[k]
        for n in range(*np.searchsorted(earlier.stamp_ns, [stamp, stamp + 1]).tolist()):
            if n not in taken and _are_equal(earlier.ranges[n], later.ranges[k]):
                taken.add(n)
                pairs.append((n, k))
                break
    return np.array(pairs, np.intp).reshape(-1, 2)


def _are_equal(a: NDArray[np.float32], b: NDArray[np.float32]) -> bool:
    """True if ranges are those of the same scan: what is a hit may have been judged differently."""
    known = ~np.isnan(a) & ~np.isnan(b)
    if not known.any():
        return bool(np.isnan(a).all() and np.isnan(b).all())
    return bool(np.mean(np.abs(a[known] - b[known]) < _SAME_RANGE) >= _MIN_EQUAL_RANGES)


def _is_overlap_of_parts(earlier: RecordingFacts, later: RecordingFacts, repeated: int) -> bool:
    """True if an overlap holds the same scans in both, or hardly any."""
    a, b = _overlap(earlier, later)
    n: int = max(a.stop - a.start, b.stop)
    stray = n - repeated
    if repeated > stray:
        return stray <= max(_MAX_STRAY_SCANS, _MAX_STRAY_SHARE * n)
    return n <= _MAX_STRAY_SCANS and 2 * n < min(len(earlier.stamp_ns), len(later.stamp_ns))


def _compare_odometry(
    earlier: RecordingFacts, later: RecordingFacts, gap: float, pairs: NDArray[np.intp]
) -> float | str | None:
    """Metres between the odometry of both, None without odometry; else how they disagree."""
    A, B = earlier.T_odom_base, later.T_odom_base
    if A is None or B is None:
        return None
    if len(pairs):
        distances, angles = measure_motions(A[pairs[:, 0]], B[pairs[:, 1]])
        metres, radians = float(np.median(distances)), float(np.median(angles))
        seconds = 0.0
    else:
        metres, radians = _measure_motion(A[-1], B[0])
        seconds = min(abs(gap), _MAX_PAUSE)
    reach, turn = _reach(earlier, later, seconds)
    if not len(pairs) and _is_at_zero(B[0]) and max(metres, radians) > _ROUNDING:
        reach = turn = 0.0  # it starts anew, not by chance where the robot could have come
    if metres > reach:
        return f"has odometry that begins {metres:.2f} m from where that of {earlier.path} ends"
    if radians > turn:
        degrees = np.degrees(radians)
        return f"has odometry turned by {degrees:.0f} degrees against the end of {earlier.path}"
    return metres


def _is_at_zero(T: Float) -> bool:
    return max(_measure_motion(np.eye(len(T)), T)) < _ZERO


def _reach(earlier: RecordingFacts, later: RecordingFacts, seconds: float) -> tuple[float, float]:
    """Greatest motion of the robot in a time: metres and radians."""
    speed, rate = _MIN_SPEED, _MIN_TURN_RATE
    for one in (earlier, later):
        fastest, turning = _usual_speed(one)
        speed, rate = max(speed, _SPEED_FACTOR * fastest), max(rate, _SPEED_FACTOR * turning)
    seconds += _SLACK + _usual_interval(earlier, later)
    return speed * seconds + _ROUNDING, rate * seconds + _ROUNDING


def _usual_speed(facts: RecordingFacts) -> tuple[float, float]:
    """Speed, m/s, and turn rate, rad/s, of fast motion."""
    T, stamps = facts.T_odom_base, facts.stamp_ns
    ahead = np.searchsorted(stamps, stamps + int(1e9 * _SPEED_SPAN))
    start = np.flatnonzero(ahead < len(stamps))
    if T is None or not len(start):
        return 0.0, 0.0
    seconds = (stamps[ahead[start]] - stamps[start]) / 1e9
    metres, radians = measure_motions(T[start], T[ahead[start]])
    fastest = np.quantile([metres / seconds, radians / seconds], _USUAL_SHARE, axis=1)
    return float(fastest[0]), float(fastest[1])


def measure_motions(A: Float, B: Float) -> tuple[Float, Float]:
    """(n,) distances, m, and angles, rad, between poses (n, D+1, D+1)."""
    step = se2.inverse(A) @ B
    D = A.shape[-1] - 1
    # the angle of a rotation in any dimension follows from its trace
    cosine = (np.trace(step[:, :D, :D], axis1=1, axis2=2) - (D - 2)) / 2.0
    metres: Float = np.linalg.norm(step[:, :D, D], axis=1)
    return metres, np.arccos(np.clip(cosine, -1.0, 1.0))


def _measure_motion(A: Float, B: Float) -> tuple[float, float]:
    metres, radians = measure_motions(A[None], B[None])
    return float(metres[0]), float(radians[0])


def format_duration(seconds: float) -> str:
    """`0.10 s`, `5 min`, `3.0 h`, `2.0 days`."""
    if seconds < 120.0:
        return f"{seconds:.2f} s"
    for size, unit in ((86400.0, "days"), (3600.0, "h")):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds / 60.0:.0f} min"
