"""Parses the lines of CARMEN logs.

One message per line: name, content, then `ipc_timestamp hostname logger_timestamp`, of which old
logs omit the last one or two. The first of the two stamps is the record's time.

    FLASER, RLASER  n r*n  laser_pose  robot_pose
    RAWLASER1-4     header n r*n  m remission*m
    ROBOTLASER1-2   header n r*n  m remission*m  laser_pose robot_pose
                    tv rv forward_safety side_safety turn_axis
    ODOM            x y theta tv rv acceleration
    PARAM           name value
    header          laser_type start_angle field_of_view angular_resolution maximum_range
                    accuracy remission_mode

Source: the header that CARMEN's logger writes, and logs: the header omits ROBOTLASER's remissions.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from stillmap.core.timestamps import parse_ns

WRONG_COUNT = "wrong number of readings"
UNREADABLE = "unreadable number"
BAD_POSE = "pose not finite"

_HEADER_FIELDS = 7
_MAX_POSE = 1e7  # m or rad, far beyond any odometry


class BadRecord(Exception):
    """A line that cannot be used; it is counted under `reason`."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(reason)


class ScanConfig(NamedTuple):
    """Beam angles of a scan, and its declared maximum range."""

    start_angle: float  # rad
    angle_step: float  # rad
    max_range: float | None  # m
    field_of_view: float | None  # rad, as declared


class ScanLine(NamedTuple):
    """A laser line. `poses` are x, y, theta of laser and robot, None for kinds without them."""

    stamp_ns: int
    ranges: list[float]
    config: ScanConfig
    poses: tuple[float, ...] | None
    stamp_fields: int  # 1 to 3: how many of `ipc_timestamp hostname logger_timestamp` are present
    host_is_number: bool  # in a log with named hosts a sign of shifted fields


class OdometryLine(NamedTuple):
    stamp_ns: int
    pose: tuple[float, ...]
    stamp_fields: int


def flaser_config(n: int, fov: float = math.pi) -> ScanConfig:
    """Beam angles of a FLASER or RLASER line, which declares none: a half circle from -90 degrees.

    The step is 180 / n degrees for even n, which omits the last beam, and 180 / (n - 1) for odd n.
    Likewise for another field of view `fov`, in radians.
    """
    steps = n if n % 2 == 0 else max(n - 1, 1)
    return ScanConfig(-fov / 2, fov / steps, None, None)


def parse_flaser(fields: list[bytes]) -> ScanLine:
    """Parse FLASER and RLASER, `fields` without the name.

    Raises:
        BadRecord: the line cannot be used.
    """
    n = _parse_count(fields, 0)
    tail = fields[1 + n :]
    if not _is_stamp(tail[6:]):
        raise BadRecord(WRONG_COUNT)
    ranges = _parse_numbers(fields[1 : 1 + n])
    stamp_ns = _parse_stamp(tail[6])
    poses = _parse_pose(tail[0:3]) + _parse_pose(tail[3:6])
    return ScanLine(stamp_ns, ranges, flaser_config(n), poses, *_stamp_form(tail[6:]))


def parse_with_header(fields: list[bytes], n_fixed: int) -> ScanLine:
    """Parse RAWLASER1-4 and ROBOTLASER1-2, see `parse_flaser`.

    `n_fixed` fields, none or those from the poses on, stand between readings and stamp.
    """
    n = _parse_count(fields, _HEADER_FIELDS)
    tail = _skip_remissions(fields[_HEADER_FIELDS + 1 + n :], n_fixed)
    config = _parse_header(fields[:_HEADER_FIELDS], n)
    ranges = _parse_numbers(fields[_HEADER_FIELDS + 1 : _HEADER_FIELDS + 1 + n])
    stamp_ns = _parse_stamp(tail[n_fixed])
    poses = _parse_pose(tail[0:3]) + _parse_pose(tail[3:6]) if n_fixed else None
    return ScanLine(stamp_ns, ranges, config, poses, *_stamp_form(tail[n_fixed:]))


def parse_odom(fields: list[bytes]) -> OdometryLine:
    """Parse ODOM, `fields` without the name.

    Raises:
        BadRecord: the line cannot be used.
    """
    if not _is_stamp(fields[6:]):
        raise BadRecord("wrong number of fields")
    stamp_ns = _parse_stamp(fields[6])
    return OdometryLine(stamp_ns, _parse_pose(fields[0:3]), len(fields) - 6)


SCAN_PARSERS: dict[bytes, Callable[[list[bytes]], ScanLine]] = {
    b"FLASER": parse_flaser,
    b"RLASER": parse_flaser,
    **{b"RAWLASER%d" % number: partial(parse_with_header, n_fixed=0) for number in (1, 2, 3, 4)},
    **{b"ROBOTLASER%d" % number: partial(parse_with_header, n_fixed=11) for number in (1, 2)},
}


def _parse_count(fields: list[bytes], at: int) -> int:
    """The stated number of readings, no larger than what the line can hold."""
    if len(fields) <= at:
        raise BadRecord(WRONG_COUNT)
    if not fields[at].isdigit() or len(fields[at]) > 9:
        raise BadRecord(UNREADABLE)
    n = int(fields[at])
    if n == 0 or n > len(fields) - at - 2:
        raise BadRecord(WRONG_COUNT)
    return n


def _skip_remissions(rest: list[bytes], n_fixed: int) -> list[bytes]:
    """The fields after the remissions: `n_fixed` ones, then the stamp."""
    if rest and rest[0].isdigit() and len(rest[0]) <= 9:
        tail = rest[1 + int(rest[0]) :]
        if _is_stamp(tail[n_fixed:]):
            return tail
    raise BadRecord(WRONG_COUNT)


def _is_stamp(fields: list[bytes]) -> bool:
    """True if `fields` have the form `ipc_timestamp [hostname [logger_timestamp]]`.

    A host name is no number, or an integer followed by the logger's stamp: so a wrong number of
    readings is noticed even where stamps are missing.
    """
    if len(fields) == 1:
        return True
    if len(fields) == 2:
        return not _is_number(fields[1])
    return (
        len(fields) == 3
        and (fields[1].isdigit() or not _is_number(fields[1]))
        and _is_number(fields[2])
    )


def _stamp_form(fields: list[bytes]) -> tuple[int, bool]:
    return len(fields), len(fields) > 1 and _is_number(fields[1])


def _is_number(field: bytes) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _parse_numbers(fields: list[bytes]) -> list[float]:
    try:
        values = [float(field) for field in fields]
    except ValueError as error:
        raise BadRecord(UNREADABLE) from error
    if b"_" in b" ".join(fields):  # Python reads 1_000 as a number
        raise BadRecord(UNREADABLE)
    return values


def _parse_pose(fields: list[bytes]) -> tuple[float, ...]:
    pose = tuple(_parse_numbers(fields))
    # written so that NaN fails too
    if not all(abs(value) < _MAX_POSE for value in pose):
        raise BadRecord(BAD_POSE)
    return pose


def _parse_stamp(field: bytes) -> int:
    try:
        return parse_ns(field.decode("ascii"))
    except ValueError as error:
        raise BadRecord(UNREADABLE) from error


def _parse_header(header: list[bytes], n: int) -> ScanConfig:
    """Start, step and declared maximum; a missing step follows from the field of view."""
    start, fov, step, max_range = _parse_numbers(header[1:5])
    stated_fov = fov if 0.0 < fov <= 2.1 * math.pi else None
    if not 0.0 < step < math.pi and stated_fov is not None:
        step = stated_fov / max(n - 1, 1)
    if not (0.0 < step < math.pi and abs(start) <= 4.0 * math.pi):
        raise BadRecord(UNREADABLE)
    stated_max = max_range if 0.0 < max_range < math.inf else None
    return ScanConfig(start, step, stated_max, stated_fov)
