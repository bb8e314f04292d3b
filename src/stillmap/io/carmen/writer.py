"""Recordings in the plane as CARMEN logs.

A CARMEN log once more, with beams blanked: as if nothing had come back.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_file
from stillmap.core.recording import Recording
from stillmap.core.timestamps import format_seconds
from stillmap.io.carmen.extrinsics import is_stated_by_lines
from stillmap.io.carmen.log import read_log
from stillmap.io.carmen.messages import SCAN_PARSERS, flaser_config
from stillmap.io.carmen.reader import Sensor, scan_order, select_scans
from stillmap.io.text_lines import is_gzip_name, open_for_writing, read_lines
from stillmap.preprocessing import laser_scan
from stillmap.preprocessing.max_range import FREQUENT_ZEROS, find_max_range
from stillmap.preprocessing.options import MAX_PLAUSIBLE_RANGE

Float = NDArray[np.float64]

NO_RETURN = 81.83  # m, what a SICK LMS reports when nothing comes back

# line of the first and the second laser: over half a circle; with angles; with angles, no poses
_HALF_CIRCLE = ("FLASER", "RLASER")

_WITH_ANGLES = ("ROBOTLASER1", "ROBOTLASER2")

_WITHOUT_POSES = ("RAWLASER1", "RAWLASER2")

_PLACES = ("front", "rear")

_DIGITS = 4  # of ranges in metres

_READS_AS_CODE = 81.82  # m: from here on a FLASER reading means that nothing came back

_SAME_ANGLE = 1e-5  # rad

_UNKNOWN_LASER = 99  # CARMEN's laser_type

_ANOTHER = "write a bag or a recording folder instead"


@dataclass(frozen=True)
class LaserFormat:
    """How the scans of one laser are written.

    Attributes:
        kind: of its lines.
        no_return: metres, the reading that means that nothing came back; lines that state their
            angles declare it as the largest range.
        unusable: the reading of an unusable beam.
    """

    kind: str
    no_return: float = NO_RETURN
    unusable: float = 0.0


@dataclass(frozen=True, eq=False)
class LogFormat:
    """How a recording is written.

    Attributes:
        lasers: its one or two lasers.
        fans: (T, 2) first angle and step of each scan, as lines state them; None where none does.
        params: names and values of the PARAM lines.
        comment: the first line.
        host: the recording computer on each line.
        digits: of ranges in metres.
    """

    lasers: tuple[LaserFormat, ...]
    scan_angles: Float | None
    params: dict[str, str]
    comment: str
    host: str
    digits: int = _DIGITS


def write_log(recording: Recording, path: Path) -> list[str]:
    """Write a CARMEN log, gzip where the name ends so; it appears whole or not at all.

    With odometry FLASER and RLASER lines where lasers look at half a circle and no farther than
    these can say, else ROBOTLASER lines; without odometry RAWLASER lines.

    Returns:
        What could not be said, a sentence each.

    Raises:
        InputError: such a log cannot hold the recording, or cannot be written.
    """
    form = _form(recording)
    with atomic_file(path) as work, open_for_writing(work, packed=is_gzip_name(path)) as file:
        for line in format_lines(recording, form):
            file.write(line.encode("ascii"))
    if recording.beam_time is None:
        return []
    return ["when each beam was taken is left out: CARMEN logs cannot say it"]


def format_lines(recording: Recording, form: LogFormat) -> Iterator[str]:
    """The lines of a log, each with its end: of every scan the odometry, then the scan."""
    yield f"# {form.comment}\n"
    if not recording.n_scans:
        return
    first = int(recording.stamp_ns[0])
    for name, value in form.params.items():
        yield f"PARAM {name} {value} {format_seconds(first)} {form.host} {format_seconds(0)}\n"
    base, laser = _poses(recording)
    for t in recording.iter_scans(range(recording.n_scans)):
        stamp = int(recording.stamp_ns[t])
        times = f"{format_seconds(stamp)} {form.host} {format_seconds(stamp - first)}\n"
        if base is not None:
            yield f"ODOM {_pose(base[t])} 0 0 0 {times}"
        its = form.lasers[recording.sensor[t]]
        readings = _readings(laser_scan.beam_ranges(recording, t, its.no_return), its, form.digits)
        if its.kind in _HALF_CIRCLE:
            assert base is not None
            yield f"{its.kind} {readings} {_pose(laser[t])} {_pose(base[t])} {times}"
            continue
        assert form.scan_angles is not None
        header = _header(form.scan_angles[t], int(np.diff(recording.offset[t : t + 2])[0]), its)
        poses = f" {_pose(laser[t])} {_pose(base[t])} 0 0 0 0 0" if base is not None else ""
        yield f"{its.kind} {header} {readings} 0{poses} {times}"


def _poses(recording: Recording) -> tuple[Float | None, Float]:
    """(T, 3) poses of robot and laser in the odometry's frame; None, (0, 3) without odometry."""
    if recording.T_odom_base is None:
        return None, np.empty((0, 3))
    T_odom_sensor = recording.T_map_sensor(recording.T_odom_base)
    return se2.parameters(recording.T_odom_base), se2.parameters(T_odom_sensor)


def _readings(ranges: Float, laser: LaserFormat, digits: int) -> str:
    ranges = np.where(np.isnan(ranges), laser.unusable, ranges)
    form = " ".join([f"%.{digits}f"] * len(ranges))
    return f"{len(ranges)} {form % tuple(ranges.tolist())}"


def _header(fan: Float, n: int, laser: LaserFormat) -> str:
    start, step = fan.tolist()
    return f"{_UNKNOWN_LASER} {start!r} {step * (n - 1)!r} {step!r} {laser.no_return!r} 0 0"


def _pose(pose: Float) -> str:
    return " ".join(f"{value:.6f}" for value in pose.tolist())


def _form(recording: Recording) -> LogFormat:
    lasers = len(recording.T_base_sensor)
    if lasers > 2:
        raise InputError(f"CARMEN logs hold two lasers, here are {lasers}", hint=_ANOTHER)
    counts = np.diff(recording.offset)
    for number in range(lasers):
        _require_one_count(counts[recording.sensor == number])
    fans = laser_scan.beam_angles(recording)
    params = {}
    for number, place in enumerate(_PLACES[:lasers]):
        its = recording.sensor == number
        if _is_upside_down(fans[its]):
            fans[its] *= -1.0
            params[f"robot_{place}laser_flipped"] = "1"
    reaches = laser_scan.range_limits(recording)
    kinds = _WITHOUT_POSES
    if recording.T_odom_base is not None:
        near = all(round(reach.longest_hit, _DIGITS) < _READS_AS_CODE for reach in reaches)
        kinds = _HALF_CIRCLE if near and _are_half_circles(fans, counts) else _WITH_ANGLES
    written = []
    for number, reach in enumerate(reaches):
        no_return = NO_RETURN if kinds is _HALF_CIRCLE else _declared(reach)
        written.append(LaserFormat(kinds[number], no_return, _unusable(recording, number)))
        x, y, theta = se2.parameters(recording.T_base_sensor[number]).tolist()
        params |= _place(kinds[number], _PLACES[number], x, y, theta)
    return LogFormat(tuple(written), fans, params, "stillmap convert", "stillmap")


def _require_one_count(counts: NDArray[np.int64]) -> None:
    found = np.unique(counts)
    if len(found) > 1 or np.any(found == 0):
        raise InputError(
            f"scans of {found.min()} to {found.max()} beams: in a CARMEN log all scans of a laser "
            "have as many",
            hint=_ANOTHER,
        )


def _is_upside_down(fans: Float) -> bool:
    """Whether angles fall from beam to beam.

    Raises:
        InputError: in some scans only.
    """
    falls = fans[:, 1] < 0.0
    if falls.any() and not falls.all():
        raise InputError("beams turn one way in some scans and the other in others", hint=_ANOTHER)
    return bool(falls.any())


def _are_half_circles(fans: Float, counts: NDArray[np.int64]) -> bool:
    """Whether first and last beams point where FLASER lines of as many readings have them."""
    of = {int(n): flaser_config(int(n))[:2] for n in np.unique(counts)}
    off = fans - np.array([of[n] for n in counts.tolist()]).reshape(-1, 2)
    off[:, 1] = off[:, 0] + (counts - 1) * off[:, 1]
    return bool(np.all(np.abs(off) < _SAME_ANGLE))


def _declared(reach: laser_scan.RangeLimits) -> float:
    """A largest range that no reading of a hit reaches, with as many digits as readings have."""
    limit = round(reach.max_range(), _DIGITS)
    return (
        limit if round(reach.longest_hit, _DIGITS) < limit else round(limit + 10**-_DIGITS, _DIGITS)
    )


def _unusable(recording: Recording, number: int) -> float:
    """Zero, as lasers say it; not a number where frequent zeros would mean maximum range."""
    beams = unusable = 0
    for t in recording.iter_scans(np.flatnonzero(recording.sensor == number).tolist()):
        points = recording.points[recording.beams_of(t)]
        beams += len(points)
        unusable += int(np.count_nonzero(np.isnan(points[:, 0])))
    return 0.0 if unusable <= FREQUENT_ZEROS * beams else math.nan


def _place(kind: str, place: str, x: float, y: float, theta: float) -> dict[str, str]:
    """PARAMs that say where a laser sits, where nothing else does."""
    assumed = (0.0, 0.0, math.pi if kind == "RLASER" else 0.0)
    told = kind not in _WITHOUT_POSES and is_stated_by_lines(x, y, theta)
    if told or (x, y, theta) == assumed:
        return {}
    names = ("offset", "side_offset", "angular_offset")
    values = zip(names, (x, y, theta), strict=True)
    return {f"robot_{place}laser_{name}": f"{value:.6f}" for name, value in values}


_OVERFLOW = 81.91  # m: what a SICK laser says where nothing comes back, for want of another code

_FIRST = {b"FLASER": 2, b"RLASER": 2}  # field of the first reading, counted with the name

_FIRST_OF_OTHERS = 9

_MARK = b"\xef\xbb\xbf"  # before the first line of some texts

_FIELD = re.compile(rb"\S+")


@dataclass(frozen=True)
class FilteredLog:
    """What was written.

    Attributes:
        scans: with their lines as they were but for blanked readings.
        beams: readings that were blanked.
        left_out: lines of scans that the recording does not have: damaged, or of a laser that
            another kind of line shows, so that nothing is known of their beams; and lines that
            are too long to be read.
    """

    scans: int
    beams: int
    omitted: int


def write_filtered_log(
    source: Path, out: Path, recording: Recording, blank: NDArray[np.bool_]
) -> FilteredLog:
    """Write a log with some readings replaced; all other bytes stay.

    Args:
        source: the log.
        out: where to; gzip where the name ends so. It appears whole or not at all.
        recording: as it was read from `source`.
        blank: (M,) which of its beams.

    Raises:
        InputError: the log is not the one that was read, or cannot be written.
    """
    sensors, _ = select_scans(read_log(source))
    scan_of = _scan_of_lines(source, sensors, recording)
    rules = (sensor["ranges"] for sensor in recording.source["sensors"])
    codes = [
        find_no_return_code(sensor.ranges, rule)
        for sensor, rule in zip(sensors, rules, strict=True)
    ]
    scans = left_out = 0
    with atomic_file(out) as work, open_for_writing(work, packed=is_gzip_name(out)) as file:
        for line in read_lines(source):
            t = scan_of.get(line.number)
            if t is not None:
                beams = blank[recording.offset[t] : recording.offset[t + 1]]
                file.write(_blank_readings(line.text, beams, codes[recording.sensor[t]]))
                scans += 1
            elif line.damaged or line.too_long or _is_scan(line.text):
                left_out += 1
            else:
                file.write(line.text)
    return FilteredLog(scans, int(np.count_nonzero(blank)), left_out)


def find_no_return_code(readings: NDArray[np.float32], rule: dict[str, Any]) -> bytes:
    """What stands for "nothing came back" among the readings of a laser.

    Args:
        readings: (T, n) metres.
        rule: how they are understood, a RangeRule.
    """
    if np.any(readings >= MAX_PLAUSIBLE_RANGE):
        return b"inf"
    found = find_max_range(readings)
    if found.coded and found.threshold is not None:
        values, count = np.unique(
            readings[readings >= np.float32(found.threshold)], return_counts=True
        )
        # the one in use: another would keep readers from seeing that it is a code
        return str(values[count.argmax()]).encode("ascii")
    if rule["zero_means"] == "max-range":
        return b"0.00"
    farthest = max(float(rule["threshold"] or 0.0), float(readings.max(initial=0.0)))
    return f"{_OVERFLOW if farthest < _OVERFLOW else 10.0 * farthest:.2f}".encode("ascii")


def _scan_of_lines(source: Path, sensors: list[Sensor], recording: Recording) -> dict[int, int]:
    """Which scan of the recording each line is."""
    if sensors:
        order = scan_order(sensors)
        line = np.concatenate([sensor.line for sensor in sensors])[order]
        stamp_ns = np.concatenate([sensor.stamp_ns for sensor in sensors])[order]
        if np.array_equal(stamp_ns, recording.stamp_ns):
            return {number: t for t, number in enumerate(line.tolist())}
    raise InputError("is not the log that was mapped: other scans", where=str(source))


def _is_scan(text: bytes) -> bool:
    name = text.removeprefix(_MARK).split(maxsplit=1)[:1]
    return bool(name) and name[0] in SCAN_PARSERS


def _blank_readings(text: bytes, blank: NDArray[np.bool_], code: bytes) -> bytes:
    """A scan's line with the blanked readings replaced."""
    if not blank.any():
        return text
    at = len(_MARK) if text.startswith(_MARK) else 0
    fields, parts = list(_FIELD.finditer(text, at)), [text[:at]]
    first = _FIRST.get(fields[0].group(), _FIRST_OF_OTHERS)
    for k in np.flatnonzero(blank).tolist():
        begin, end = fields[first + k].span()
        parts += [text[at:begin], code]
        at = end
    return b"".join([*parts, text[at:]])
