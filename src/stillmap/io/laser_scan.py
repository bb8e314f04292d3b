"""2D scans in the form of a LaserScan message: first angle, angle step, ranges, time increment."""

from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Index
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes

# tolerance of an end point across its beam, in metres and radians
_TOLERANCE_M, _TOLERANCE_RAD = 1e-3, 1e-4

_TIME_TOLERANCE = 0.01  # share of the duration of a scan

_DEFAULT_STEP = np.pi / 180  # rad, of scans of one beam

_HINT = "a recording folder or a point cloud holds any directions"


class RangeLimits(NamedTuple):
    """Range limits of one laser in metres.

    Attributes:
        longest_hit: range of the longest hit; 0 without hits.
        declared: range from which on readings mean no return, as recorded or as the
            maximum-range beams show; None: unknown.
    """

    longest_hit: float
    declared: float | None

    def max_range(self) -> float:
        """A maximum range above all hits, in float32."""
        above = float(np.nextafter(np.float32(self.longest_hit), np.float32(np.inf)))
        return above if self.declared is None else max(self.declared, above)


def beam_angles(recording: Recording) -> Float:
    """(T, 2) first angle and signed angle step of every scan, in radians.

    As recorded where they fit the points, else fitted. A scan with fewer than two usable beams
    gets the angles of another scan of its laser, else a full turn.

    Raises:
        InputError: the recording is 3D, or the directions of a scan are not evenly spaced.
    """
    if recording.dimension != 2:
        raise InputError("is 3D: a 2D recording is required", hint=_HINT)
    out = np.full((recording.n_scans, 2), np.nan)
    counts = np.diff(recording.offset)
    known: dict[int, dict[int, tuple[float, float]]] = {}
    for number, notes in enumerate(_sensor_notes(recording)):
        if notes.start_angle is not None and notes.angle_step is not None:
            angles = notes.start_angle, notes.angle_step
            sizes = np.unique(counts[recording.sensor == number]).tolist()
            known[number] = dict.fromkeys(sizes, angles)
    undetermined = []
    for t in recording.iter_scans(range(recording.n_scans)):
        points = recording.points[recording.beams_of(t)].astype(np.float64)
        of_laser, n = known.setdefault(int(recording.sensor[t]), {}), len(points)
        usable = np.flatnonzero(np.isfinite(points[:, 0]))
        candidate = of_laser.get(n)
        if candidate is None or not _fits(candidate, points, usable):
            if len(usable) < 2 and n > 1:
                undetermined.append(t)
                continue
            candidate = _fit_angles(points, usable)
            if not _fits(candidate, points, usable):
                what = f"scan {t}: the directions of its beams are not evenly spaced"
                raise InputError(what, hint=_HINT)
            of_laser[n] = candidate
        out[t] = candidate
    for t in undetermined:
        n = int(counts[t])
        full_turn = -np.pi, 2 * np.pi / max(n, 1)
        out[t] = known.get(int(recording.sensor[t]), {}).get(n, full_turn)
    return out


def beam_ranges(recording: Recording, scan: int, no_return: float) -> Float:
    """(n,) ranges (m) of a scan: `no_return` for maximum-range beams, NaN for unusable ones."""
    beams = recording.beams_of(scan)
    x, y = recording.points[beams].astype(np.float64).T
    length = np.hypot(x, y)
    known = recording.hit[beams] | np.isnan(length)
    return np.where(known, length, no_return)


def range_limits(recording: Recording) -> list[RangeLimits]:
    """Range limits of each of the S lasers."""
    hit, far = np.zeros((2, len(recording.T_base_sensor)))
    for t in recording.iter_scans(range(recording.n_scans)):
        beams, s = recording.beams_of(t), recording.sensor[t]
        x, y = recording.points[beams].astype(np.float64).T
        length, is_hit = np.hypot(x, y), recording.hit[beams]
        hit[s] = max(hit[s], length.max(where=is_hit, initial=0.0))
        far[s] = max(far[s], length.max(where=~is_hit & ~np.isnan(length), initial=0.0))
    rules = [notes.ranges for notes in _sensor_notes(recording)]
    recorded = [0.0 if rule is None else max(rule.threshold or 0.0, 0.0) for rule in rules]
    lasers = zip(hit, far, recorded, strict=True)
    return [RangeLimits(float(h), n or float(f) or None) for h, f, n in lasers]


def time_increments(recording: Recording) -> tuple[Float, int]:
    """(T,) time between beams of each scan in seconds, and the count of scans with uneven times.

    Uneven scans, and scans without beam times, have 0. Times are even where they start at the
    stamp and rise in equal steps, to a hundredth of the duration of the scan.
    """
    out, uneven = np.zeros(recording.n_scans), 0
    if recording.beam_time is None:
        return out, 0
    for t in recording.iter_scans(range(recording.n_scans)):
        times = recording.beam_time[recording.beams_of(t)].astype(np.float64)
        index = np.arange(len(times))
        step = float(times @ index) / max(float(index @ index), 1.0)
        span = np.ptp(times) if len(times) else 0.0
        if np.all(np.abs(times - step * index) <= max(_TIME_TOLERANCE * span, 1e-6)):
            out[t] = step
        else:
            uneven += 1
    return out, uneven


def _sensor_notes(recording: Recording) -> list[SensorNotes]:
    """Notes on each sensor, empty ones where there are none."""
    recorded, count = recording.source.sensors, len(recording.T_base_sensor)
    return recorded[:count] + [SensorNotes()] * (count - len(recorded))


def _fits(angles: tuple[float, float], points: Float, usable: Index) -> bool:
    angle = angles[0] + angles[1] * usable
    x, y = points[usable].T
    c, s = np.cos(angle), np.sin(angle)
    along, across = x * c + y * s, np.abs(x * s - y * c)
    tolerance = np.maximum(_TOLERANCE_M, _TOLERANCE_RAD * along)
    return bool(np.all((along >= 0.0) & (across <= tolerance)))


def _fit_angles(points: Float, usable: Index) -> tuple[float, float]:
    """Fit first angle and step to end points, weighted by squared range."""
    x, y = points[usable].T
    angle, length = np.arctan2(y, x), np.hypot(x, y)
    if len(points) <= 1:
        return (float(angle[0]) if len(angle) else 0.0), _DEFAULT_STEP
    gap = np.diff(usable)
    is_smallest = gap == gap.min()
    step = np.median(se2.wrap(np.diff(angle))[is_smallest]) / gap.min()
    excess = angle - angle[0] - step * (usable - usable[0])
    angle -= 2 * np.pi * np.round(excess / (2 * np.pi))
    weight = length**2 + 1e-12
    middle_n, middle_a = np.average(usable, weights=weight), np.average(angle, weights=weight)
    off = usable - middle_n
    slope = float(weight @ (off * (angle - middle_a)) / (weight @ off**2))
    return float(middle_a - slope * middle_n), slope
