"""Scans in the plane as laser drivers state them: angles, ranges and times that rise evenly.

When the beams of a lidar that spins were taken, where nothing but their directions tells.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.preprocessing.options import ReadOptions

Float = NDArray[np.float64]

# how far an end point may lie beside its beam: across it in metres, or as an angle in radians
_ASIDE_M, _ASIDE_RAD = 1e-3, 1e-4

_UNEVEN = 0.01  # share of the time that a scan takes, by which a beam may come early or late

_LONE_STEP = np.pi / 180  # rad, of a scan of one beam: any will do

_ANOTHER = "a recording folder or a point cloud holds any directions"


class RangeLimits(NamedTuple):
    """How far one laser sees, in metres.

    Attributes:
        hit: the longest beam that hit something; 0 where none did.
        declared: from which range on its readings meant that nothing came back, as noted or as the
            beams without a return show; None where nothing tells.
    """

    longest_hit: float
    declared: float | None

    def max_range(self) -> float:
        """A largest range that all hits lie below, as float32 holds it."""
        above = float(np.nextafter(np.float32(self.longest_hit), np.float32(np.inf)))
        return above if self.declared is None else max(self.declared, above)


def beam_angles(recording: Recording) -> Float:
    """(T, 2) first angle and step of every scan in radians, counterclockwise; the step is negative
    where angles fall from beam to beam.

    As the reader noted them where they fit the points, else fitted. A scan in which no two beams
    are usable has the angles of another one of its laser.

    Raises:
        InputError: the recording is 3D, or the directions of a scan are not evenly spaced.
    """
    if recording.dimension != 2:
        raise InputError("is 3D: beams in the plane are asked for", hint=_ANOTHER)
    out = np.full((recording.n_scans, 2), np.nan)
    counts = np.diff(recording.offset)
    known = {
        number: {int(n): noted for n in np.unique(counts[recording.sensor == number])}
        for number, noted in enumerate(map(_noted, _sensors(recording)))
    }
    unclear = []
    for t in recording.iter_scans(range(recording.n_scans)):
        points = recording.points[recording.beams_of(t)].astype(np.float64)
        of_laser, n = known.setdefault(int(recording.sensor[t]), {}), len(points)
        usable = np.flatnonzero(np.isfinite(points[:, 0]))
        candidate = of_laser.get(n)
        if candidate is None or not _fits(candidate, points, usable):
            if len(usable) < 2 and n > 1:
                unclear.append(t)
                continue
            candidate = _fitted(points, usable)
            if not _fits(candidate, points, usable):
                raise InputError(
                    f"scan {t}: the directions of its beams are not evenly spaced", hint=_ANOTHER
                )
            of_laser[n] = candidate
        out[t] = candidate
    for t in unclear:
        out[t] = _any_that_fits(recording, t, known)
    return out


def beam_ranges(recording: Recording, scan: int, no_return: float) -> Float:
    """(n,) metres of each beam of a scan: `no_return` at maximum range, NaN where unusable."""
    beams = recording.beams_of(scan)
    x, y = recording.points[beams].astype(np.float64).T
    length = np.hypot(x, y)
    known = recording.hit[beams] | np.isnan(length)
    return np.where(known, length, no_return)


def range_limits(recording: Recording) -> list[RangeLimits]:
    """How far each of the S lasers sees."""
    hit, far = np.zeros((2, len(recording.T_base_sensor)))
    for t in recording.iter_scans(range(recording.n_scans)):
        beams, s = recording.beams_of(t), recording.sensor[t]
        x, y = recording.points[beams].astype(np.float64).T
        length, is_hit = np.hypot(x, y), recording.hit[beams]
        hit[s] = max(hit[s], length.max(where=is_hit, initial=0.0))
        far[s] = max(far[s], length.max(where=~is_hit & ~np.isnan(length), initial=0.0))
    noted = [_threshold(notes) for notes in _sensors(recording)]
    return [
        RangeLimits(float(h), n or float(f) or None)
        for h, f, n in zip(hit, far, noted, strict=True)
    ]


def time_increments(recording: Recording) -> tuple[Float, int]:
    """(T,) seconds from beam to beam of each scan, and how many scans have times that are not even.

    Those, and all without beam times, have 0. Even are times that begin with the stamp and go on
    in equal steps, but for a hundredth of the time that the scan takes.
    """
    out, uneven = np.zeros(recording.n_scans), 0
    if recording.beam_time is None:
        return out, 0
    for t in recording.iter_scans(range(recording.n_scans)):
        times = recording.beam_time[recording.beams_of(t)].astype(np.float64)
        number = np.arange(len(times))
        step = float(times @ number) / max(float(number @ number), 1.0)
        span = np.ptp(times) if len(times) else 0.0
        if np.all(np.abs(times - step * number) <= max(_UNEVEN * span, 1e-6)):
            out[t] = step
        else:
            uneven += 1
    return out, uneven


def _sensors(recording: Recording) -> list[dict[str, Any]]:
    """What the reader noted of each sensor, {} where it noted nothing."""
    noted = recording.source.get("sensors")
    noted = noted if isinstance(noted, list) else []
    count = len(recording.T_base_sensor)
    found = [one if isinstance(one, dict) else {} for one in noted[:count]]
    return found + [{}] * (count - len(found))


def _noted(notes: dict[str, Any]) -> tuple[float, float] | None:
    start, step = (notes.get(name) for name in ("start_angle", "angle_step"))
    return (start, step) if isinstance(start, float) and isinstance(step, float) else None


def _threshold(notes: dict[str, Any]) -> float | None:
    rule = notes.get("ranges")
    value = rule.get("threshold") if isinstance(rule, dict) else None
    return value if isinstance(value, float) and 0.0 < value < np.inf else None


def _fits(fan: tuple[float, float], points: Float, usable: NDArray[np.intp]) -> bool:
    angle = fan[0] + fan[1] * usable
    x, y = points[usable].T
    c, s = np.cos(angle), np.sin(angle)
    along, aside = x * c + y * s, np.abs(x * s - y * c)
    return bool(np.all((along >= 0.0) & (aside <= np.maximum(_ASIDE_M, _ASIDE_RAD * along))))


def _fitted(points: Float, usable: NDArray[np.intp]) -> tuple[float, float]:
    """First angle and step of the beams that point best at their end points."""
    x, y = points[usable].T
    angle, length = np.arctan2(y, x), np.hypot(x, y)
    if len(points) <= 1:
        return (float(angle[0]) if len(angle) else 0.0), _LONE_STEP
    gap = np.diff(usable)
    near = gap == gap.min()
    step = np.median(se2.wrap(np.diff(angle))[near]) / gap.min()
    beyond = angle - angle[0] - step * (usable - usable[0])
    angle -= 2 * np.pi * np.round(beyond / (2 * np.pi))
    # far end points tell angles best; those at the laser itself tell none
    weight = length**2 + 1e-12
    middle_n, middle_a = np.average(usable, weights=weight), np.average(angle, weights=weight)
    off = usable - middle_n
    slope = float(weight @ (off * (angle - middle_a)) / (weight @ off**2))
    return float(middle_a - slope * middle_n), slope


def _any_that_fits(
    recording: Recording, t: int, known: dict[int, dict[int, tuple[float, float] | None]]
) -> tuple[float, float]:
    """Angles for a scan whose beams hardly tell: of another scan, as long as they fit."""
    points = recording.points[recording.beams_of(t)].astype(np.float64)
    usable = np.flatnonzero(np.isfinite(points[:, 0]))
    found = known[int(recording.sensor[t])].get(len(points))
    if found is not None and _fits(found, points, usable):
        return found
    # one usable beam at most: any step that lets it point at its end will do
    step = 2 * np.pi / max(len(points), 1)
    angle = [np.arctan2(points[k, 1], points[k, 0]) - step * k for k in usable]
    return (float(angle[0]) if angle else -np.pi), step


SPIN_KEY = "spin"  # in the source, of recordings whose times are such

_SENSE = {"clockwise": -1.0, "counter-clockwise": 1.0}

_TURN = 2.0 * math.pi

_RATES = (0.5, 200.0)  # turns per second of lidars; stamps farther apart miss sweeps


def add_beam_times(recording: Recording, options: ReadOptions) -> Recording:
    """The recording with beam times as the direction of the spin says.

    A turn takes from one stamp to the next, or as long as `spin_rate` says. Where it begins,
    directions jump from the last beam to the first.

    Args:
        recording: 3D. It comes back as it is where `spin` names no direction; where its beams have
            times, or there is no rate, with a warning.
        options: `spin`, `spin_rate`, `spin_start` and `spin_stamp`.
    """
    if options.spin not in _SENSE or SPIN_KEY in recording.source:
        return recording
    if recording.beam_time is not None:
        return _warned(recording, "the spin is not used: beams have times of their own")
    rates = [_rate(recording, k, options) for k in range(len(recording.T_base_sensor))]
    if not all(rates):
        return _warned(recording, "the spin is not used: stamps tell no rate, set read.spin_rate")
    per_second = np.array(rates, np.float64)
    beam_time = recording.allocate_per_beam(np.float32)
    for t in recording.iter_scans(range(recording.n_scans), beam_time):
        beams = recording.beams_of(t)
        turned = rotation_since_stamp(recording.points[beams], options)
        beam_time[beams] = turned / per_second[recording.sensor[t]]
    noted = {
        "direction": options.spin,
        "turns_per_second": [round(float(rate), 4) for rate in per_second],
        "start": options.spin_start,
        "stamp": options.spin_start if options.spin_stamp is None else options.spin_stamp,
    }
    return replace(recording, beam_time=beam_time, source={**recording.source, SPIN_KEY: noted})


def rotation_since_stamp(points: NDArray[np.float32], options: ReadOptions) -> Float:
    """(n,) turns from the stamp to each of points (n, 3) in the sensor's frame; 0 for unusable."""
    sense = _SENSE[options.spin]
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    stamp = options.spin_start if options.spin_stamp is None else options.spin_stamp
    after = np.mod(sense * (azimuth - options.spin_start), _TURN)
    until_stamp = math.fmod(sense * (stamp - options.spin_start), _TURN) % _TURN
    return np.nan_to_num((after - until_stamp) / _TURN)


def _rate(recording: Recording, sensor: int, options: ReadOptions) -> float | None:
    """Turns per second of a sensor; None where nothing tells."""
    if options.spin_rate is not None:
        return options.spin_rate
    stamps = recording.stamp_ns[recording.sensor == sensor]
    if len(stamps) < 2:
        return None
    seconds = float(np.median(np.diff(stamps))) / 1e9
    return 1.0 / seconds if 1.0 / _RATES[1] <= seconds <= 1.0 / _RATES[0] else None


def _warned(recording: Recording, what: str) -> Recording:
    warnings = [*recording.source.get("warnings", []), what]
    return replace(recording, source={**recording.source, "warnings": warnings})
