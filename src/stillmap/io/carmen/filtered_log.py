"""Writes filtered copies of CARMEN logs: with some beams blanked, all other bytes unchanged."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.carmen.log import BYTE_ORDER_MARK, read_log
from stillmap.io.carmen.messages import SCAN_PARSERS
from stillmap.io.carmen.scan_selection import Sensor, scan_order, select_scans
from stillmap.io.text_lines import read_lines, write_atomically
from stillmap.prepare.max_range import find_max_range
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE, ReadOptions
from stillmap.prepare.time_window import TimeWindow

_OVERFLOW = 81.91  # m: a value that SICK lasers report for no return
_FIRST_READING = {b"FLASER": 2, b"RLASER": 2}  # index of its field; the name is field 0
_FIRST_READING_AFTER_HEADER = 9
_FIELD = re.compile(rb"\S+")


def write_filtered_log(
    source: Path,
    out: Path,
    recording: Recording,
    blank: NDArray[np.bool_],
    options: ReadOptions | None = None,
) -> int:
    """Copy a log with some readings replaced by "no return".

    Args:
        source: the log.
        out: gzip by its name; it appears complete or not at all.
        recording: as it was read from `source`.
        blank: (M,) beams to blank.
        options: with which it was read; None: the defaults.

    Returns:
        Number of scan lines omitted: the recording lacks them, so that their labels are unknown, or
        they are too long to be read.

    Raises:
        InputError: `source` is not the log that was read, or `out` cannot be written.
    """
    window = TimeWindow(options or ReadOptions())
    sensors, _ = select_scans(read_log(source, window=window))
    scan_of = _number_lines(source, sensors, recording)
    codes = [
        find_no_return_code(sensor.ranges, notes["ranges"])
        for sensor, notes in zip(sensors, recording.source["sensors"], strict=True)
    ]
    omitted = 0
    with write_atomically(out) as file:
        for line in read_lines(source):
            t = scan_of.get(line.number)
            if t is not None:
                code = codes[recording.sensor[t]]
                file.write(_blank_readings(line.text, blank[recording.beams_of(t)], code))
            elif line.damaged or line.too_long or _is_scan(line.text):
                omitted += 1
            else:
                file.write(line.text)
    return omitted


def find_no_return_code(readings: NDArray[np.float32], rule: dict[str, Any]) -> bytes:
    """The reading that means "no return" for a laser.

    Args:
        readings: (T, n) metres.
        rule: its RangeRule as a dict.
    """
    if np.any(readings >= MAX_PLAUSIBLE_RANGE):
        return b"inf"
    found = find_max_range(readings)
    if found.coded and found.threshold is not None:
        codes = readings[readings >= np.float32(found.threshold)]
        values, count = np.unique(codes, return_counts=True)
        # the most frequent one: a further code would hide from readers that it is one
        return str(values[count.argmax()]).encode("ascii")
    if rule["zero_means"] == "max-range":
        return b"0.00"
    longest = max(float(rule["threshold"] or 0.0), float(readings.max(initial=0.0)))
    return f"{_OVERFLOW if longest < _OVERFLOW else 10.0 * longest:.2f}".encode("ascii")


def _number_lines(source: Path, sensors: list[Sensor], recording: Recording) -> dict[int, int]:
    """The scan of the recording by line number."""
    if sensors:
        order = scan_order(sensors)
        line = np.concatenate([sensor.line for sensor in sensors])[order]
        stamp_ns = np.concatenate([sensor.stamp_ns for sensor in sensors])[order]
        if np.array_equal(stamp_ns, recording.stamp_ns):
            return {number: t for t, number in enumerate(line.tolist())}
    raise InputError("is not the log that was mapped: other scans", where=str(source))


def _is_scan(text: bytes) -> bool:
    name = text.removeprefix(BYTE_ORDER_MARK).split(maxsplit=1)[:1]
    return bool(name) and name[0] in SCAN_PARSERS


def _blank_readings(text: bytes, blank: NDArray[np.bool_], code: bytes) -> bytes:
    """A scan line with the readings `blank` (n,) replaced by the code."""
    if not blank.any():
        return text
    at = len(BYTE_ORDER_MARK) if text.startswith(BYTE_ORDER_MARK) else 0
    fields, parts = list(_FIELD.finditer(text, at)), [text[:at]]
    first = _FIRST_READING.get(fields[0].group(), _FIRST_READING_AFTER_HEADER)
    for k in np.flatnonzero(blank).tolist():
        begin, end = fields[first + k].span()
        parts += [text[at:begin], code]
        at = end
    return b"".join([*parts, text[at:]])
