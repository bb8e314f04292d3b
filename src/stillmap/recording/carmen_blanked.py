"""A CARMEN log once more, with beams blanked: as if nothing had come back."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.output.atomic import new_file
from stillmap.recording.carmen_log import read_log
from stillmap.recording.carmen_messages import SCAN_PARSERS
from stillmap.recording.carmen_scans import Sensor, in_order, used
from stillmap.recording.lines import is_gzip_name, numbered_lines, opened_to_write
from stillmap.recording.model import Recording
from stillmap.recording.options import BEYOND
from stillmap.recording.ranges import find_max_range

_OVERFLOW = 81.91  # m: what a SICK laser says where nothing comes back, for want of another code
_FIRST = {b"FLASER": 2, b"RLASER": 2}  # field of the first reading, counted with the name
_FIRST_OF_OTHERS = 9
_MARK = b"\xef\xbb\xbf"  # before the first line of some texts
_FIELD = re.compile(rb"\S+")


@dataclass(frozen=True)
class Blanked:
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
    left_out: int


def write(source: Path, out: Path, recording: Recording, blank: NDArray[np.bool_]) -> Blanked:
    """Write a log with some readings replaced; all other bytes stay.

    Args:
        source: the log.
        out: where to; gzip where the name ends so. It appears whole or not at all.
        recording: as it was read from `source`.
        blank: (M,) which of its beams.

    Raises:
        InputError: the log is not the one that was read, or cannot be written.
    """
    sensors, _ = used(read_log(source))
    scan_of = _scan_of_lines(source, sensors, recording)
    rules = (sensor["ranges"] for sensor in recording.source["sensors"])
    codes = [code(sensor.ranges, rule) for sensor, rule in zip(sensors, rules, strict=True)]
    scans = left_out = 0
    with new_file(out) as work, opened_to_write(work, packed=is_gzip_name(out)) as file:
        for line in numbered_lines(source):
            t = scan_of.get(line.number)
            if t is not None:
                beams = blank[recording.offset[t] : recording.offset[t + 1]]
                file.write(_replaced(line.text, beams, codes[recording.sensor[t]]))
                scans += 1
            elif line.damaged or line.too_long or _is_scan(line.text):
                left_out += 1
            else:
                file.write(line.text)
    return Blanked(scans, int(np.count_nonzero(blank)), left_out)


def code(readings: NDArray[np.float32], rule: dict[str, Any]) -> bytes:
    """What stands for "nothing came back" among the readings of a laser.

    Args:
        readings: (T, n) metres.
        rule: how they are understood, a RangeRule.
    """
    if np.any(readings >= BEYOND):
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
        order = in_order(sensors)
        line = np.concatenate([sensor.line for sensor in sensors])[order]
        stamp_ns = np.concatenate([sensor.stamp_ns for sensor in sensors])[order]
        if np.array_equal(stamp_ns, recording.stamp_ns):
            return {number: t for t, number in enumerate(line.tolist())}
    raise InputError("is not the log that was mapped: other scans", where=str(source))


def _is_scan(text: bytes) -> bool:
    name = text.removeprefix(_MARK).split(maxsplit=1)[:1]
    return bool(name) and name[0] in SCAN_PARSERS


def _replaced(text: bytes, blank: NDArray[np.bool_], code: bytes) -> bytes:
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
