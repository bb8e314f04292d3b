"""Writes 2D recordings as CARMEN logs, and logs again with some beams blanked."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Float32, Int64
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import RangeRule
from stillmap.core.timestamps import format_seconds
from stillmap.io import laser_scan
from stillmap.io.carmen import log
from stillmap.io.carmen.reader import is_stated_by_lines, select_scans
from stillmap.io.filtered_clouds import FilterJob, Omissions, other_recording_error
from stillmap.io.text_lines import read_lines, replace_words, write_atomically
from stillmap.prepare.max_range import MIN_ZERO_SHARE, find_max_range
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE
from stillmap.prepare.time_window import TimeWindow

NO_RETURN = 81.83  # m, what a SICK LMS reports for no return

# kinds of lines of the first and the second laser
_HALF_CIRCLE = ("FLASER", "RLASER")
_WITH_ANGLES = ("ROBOTLASER1", "ROBOTLASER2")
_WITHOUT_POSES = ("RAWLASER1", "RAWLASER2")

_POSITIONS = ("front", "rear")
_DIGITS = 4  # of ranges in metres
_HOST = "stillmap"  # in each line
_MIN_CODE = 81.82  # m: from here on a FLASER reading means "no return"
_SAME_ANGLE = 1e-5  # rad
_UNKNOWN_LASER = 99  # CARMEN's laser_type
_OVERFLOW = 81.91  # m: a value that SICK lasers report for no return
_ALTERNATIVE = "write a bag or a recording folder instead"


class LaserFormat(NamedTuple):
    """Line format of one laser's scans.

    Attributes:
        kind: of its lines.
        no_return: reading in metres for no return; lines with angles declare it as maximum range.
        unusable: reading of an unusable beam.
    """

    kind: str
    no_return: float
    unusable: float


def write_log(recording: Recording, path: Path, overwrite: bool = True) -> list[str]:  # noqa: ARG001
    """Write a CARMEN log, gzip by its name; it appears complete or not at all, and replaces a file.

    With odometry FLASER and RLASER lines where lasers cover half a circle and ranges fit, else
    ROBOTLASER lines; without odometry RAWLASER lines.

    Returns:
        What could not be written, a sentence each.

    Raises:
        InputError: such a log cannot hold the recording, or cannot be written.
    """
    form = _choose_format(recording)
    with write_atomically(path) as file:
        for line in _format_lines(recording, *form):
            file.write(line.encode("ascii"))
    if recording.beam_time is None:
        return []
    return ["beam times are left out: CARMEN logs cannot hold them"]


def _format_lines(
    recording: Recording, lasers: list[LaserFormat], angles: Float, params: dict[str, str]
) -> Iterator[str]:
    """The lines of a log with line ends: for every scan its odometry, then the scan."""
    yield "# written by stillmap\n"
    first = int(recording.stamp_ns[0])
    for name, value in params.items():
        yield f"PARAM {name} {value} {format_seconds(first)} {_HOST} {format_seconds(0)}\n"
    T_odom_base = recording.T_odom_base
    if T_odom_base is not None:
        base = se2.parameters(T_odom_base)
        laser = se2.parameters(recording.T_map_sensor(T_odom_base))
    counts = np.diff(recording.offset)
    for t in recording.iter_scans(range(recording.n_scans)):
        stamp = int(recording.stamp_ns[t])
        times = f"{format_seconds(stamp)} {_HOST} {format_seconds(stamp - first)}\n"
        poses = ""
        if T_odom_base is not None:
            yield f"ODOM {_format_pose(base[t])} 0 0 0 {times}"
            poses = f"{_format_pose(laser[t])} {_format_pose(base[t])} "
        sensor = lasers[recording.sensor[t]]
        ranges = laser_scan.beam_ranges(recording, t, sensor.no_return)
        readings = _format_readings(ranges, sensor)
        if sensor.kind in _HALF_CIRCLE:
            yield f"{sensor.kind} {readings} {poses}{times}"
            continue
        header = _format_header(angles[t], int(counts[t]), sensor)
        velocities = "0 0 0 0 0 " if poses else ""
        yield f"{sensor.kind} {header} {readings} 0 {poses}{velocities}{times}"


def _format_readings(ranges: Float, laser: LaserFormat) -> str:
    ranges = np.where(np.isnan(ranges), laser.unusable, ranges)
    form = " ".join([f"%.{_DIGITS}f"] * len(ranges))
    return f"{len(ranges)} {form % tuple(ranges.tolist())}"


def _format_header(angles: Float, n: int, laser: LaserFormat) -> str:
    start, step = angles.tolist()
    return f"{_UNKNOWN_LASER} {start!r} {step * (n - 1)!r} {step!r} {laser.no_return!r} 0 0"


def _format_pose(pose: Float) -> str:
    return " ".join(f"{value:.6f}" for value in pose.tolist())


def _choose_format(recording: Recording) -> tuple[list[LaserFormat], Float, dict[str, str]]:
    """Line formats of one or two lasers, first angle and step (T, 2) of each scan, PARAM lines."""
    n_lasers = len(recording.T_base_sensor)
    counts = np.diff(recording.offset)
    if np.any(counts == 0):
        raise InputError("a CARMEN log holds no scan without beams", hint=_ALTERNATIVE)
    angles = laser_scan.beam_angles(recording)
    params = {}
    for number, position in enumerate(_POSITIONS[:n_lasers]):
        scans = recording.sensor == number
        if _is_upside_down(angles[scans]):
            angles[scans] *= -1.0
            params[f"robot_{position}laser_flipped"] = "1"
    limits = laser_scan.range_limits(recording)
    kinds = _WITHOUT_POSES
    if recording.T_odom_base is not None:
        near = all(round(limit.longest_hit, _DIGITS) < _MIN_CODE for limit in limits)
        kinds = _HALF_CIRCLE if near and _are_half_circles(angles, counts) else _WITH_ANGLES
    lasers = []
    for number, limit in enumerate(limits):
        no_return = NO_RETURN if kinds is _HALF_CIRCLE else _declared_max_range(limit)
        lasers.append(LaserFormat(kinds[number], no_return, _unusable_reading(recording, number)))
        x, y, theta = se2.parameters(recording.T_base_sensor[number]).tolist()
        params |= _extrinsics_params(kinds[number], _POSITIONS[number], x, y, theta)
    return lasers, angles, params


def _is_upside_down(angles: Float) -> bool:
    """True if beam angles (first, step) (T, 2) decrease from beam to beam.

    Raises:
        InputError: in some scans only.
    """
    decrease = angles[:, 1] < 0.0
    if decrease.any() and not decrease.all():
        what = "beams turn one way in some scans and the other in others"
        raise InputError(what, hint=_ALTERNATIVE)
    return bool(decrease.any())


def _are_half_circles(angles: Float, counts: Int64) -> bool:
    """True if first and last beams have the directions of FLASER lines with as many readings."""
    expected = {int(n): log.flaser_config(int(n))[:2] for n in np.unique(counts)}
    off = angles - np.array([expected[n] for n in counts.tolist()]).reshape(-1, 2)
    off[:, 1] = off[:, 0] + (counts - 1) * off[:, 1]
    return bool(np.all(np.abs(off) < _SAME_ANGLE))


def _declared_max_range(limit: laser_scan.RangeLimits) -> float:
    """A maximum range above the reading of every hit, rounded as readings are."""
    max_range = round(limit.max_range(), _DIGITS)
    above = round(limit.longest_hit, _DIGITS) < max_range
    return max_range if above else round(max_range + 10**-_DIGITS, _DIGITS)


def _unusable_reading(recording: Recording, number: int) -> float:
    """Zero, as lasers report it; NaN where frequent zeros would mean maximum range."""
    scans, n_unusable = np.flatnonzero(recording.sensor == number), 0
    n_beams = int(np.diff(recording.offset)[scans].sum())
    for t in recording.iter_scans(scans.tolist()):
        n_unusable += int(np.count_nonzero(np.isnan(recording.points[recording.beams_of(t), 0])))
    return 0.0 if n_unusable <= MIN_ZERO_SHARE * n_beams else math.nan


def _extrinsics_params(
    kind: str, position: str, x: float, y: float, theta: float
) -> dict[str, str]:
    """PARAMs with the pose of a laser where neither its lines nor the default imply it."""
    default = (0.0, 0.0, math.pi if kind == "RLASER" else 0.0)
    stated = kind not in _WITHOUT_POSES and is_stated_by_lines(x, y, theta)
    if stated or (x, y, theta) == default:
        return {}
    names = ("offset", "side_offset", "angular_offset")
    values = zip(names, (x, y, theta), strict=True)
    return {f"robot_{position}laser_{name}": f"{value:.6f}" for name, value in values}


def write_filtered(job: FilterJob) -> Omissions:
    """Copy a log with some readings replaced by "no return", gzip by its name.

    Scan lines that the recording lacks are left out: nothing is known of their beams.

    Raises:
        InputError: the source is not the log that was read, or the output cannot be written.
    """
    recording = job.recording
    lasers, _ = select_scans(log.read_log([job.source], window=TimeWindow(job.options)))
    none = np.empty(0, np.int64)
    stamp_ns = np.concatenate([none, *(own.stamp_ns for own in lasers)])
    order = np.argsort(stamp_ns, kind="stable")
    if not np.array_equal(stamp_ns[order], recording.stamp_ns):
        raise other_recording_error(job.source)
    lines = np.concatenate([none, *(own.line for own in lasers)])[order]
    scan_of = {number: t for t, number in enumerate(lines.tolist())}
    codes = [
        find_no_return_code(
            own.raw([np.empty((config.n, 2)) for config in own.configs]).sample_readings(),
            notes.ranges,
        )
        for own, notes in zip(lasers, recording.source.sensors, strict=True)
    ]
    omitted = 0
    with write_atomically(job.output) as file:
        for line in read_lines(job.source):
            t = scan_of.get(line.number)
            text = line.text.removeprefix(log.BYTE_ORDER_MARK)
            name = b"".join(text.split(maxsplit=1)[:1])
            if t is not None:
                blank = np.flatnonzero(job.blank[recording.beams_of(t)]) + log.first_reading(name)
                new = replace_words(text, dict.fromkeys(blank.tolist(), codes[recording.sensor[t]]))
                file.write(line.text[: len(line.text) - len(text)] + new)
            elif line.damage or name in log.SCAN_KINDS:
                omitted += 1
            else:
                file.write(line.text)
    return Omissions(omitted)


def find_no_return_code(readings: Float32, rule: RangeRule | None) -> bytes:
    """The reading that means "no return" for a laser.

    Args:
        readings: (T, n) metres.
        rule: of the laser.
    """
    if np.any(readings >= MAX_PLAUSIBLE_RANGE):
        return b"inf"
    detected = find_max_range(readings)
    if detected.coded and detected.threshold is not None:
        codes = readings[readings >= np.float32(detected.threshold)]
        values, count = np.unique(codes, return_counts=True)
        # the most frequent one: a further code would hide from readers that it is one
        return str(values[count.argmax()]).encode("ascii")
    if rule is not None and rule.zero_means == "max-range":
        return b"0.00"
    longest = max(float((rule and rule.threshold) or 0.0), float(readings.max(initial=0.0)))
    return f"{_OVERFLOW if longest < _OVERFLOW else 10.0 * longest:.2f}".encode("ascii")
