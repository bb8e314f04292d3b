"""Parses CARMEN logs, and collects their records in compact arrays.

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
from array import array
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from sys import maxsize
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float, Int64
from stillmap.core.timestamps import parse_ns
from stillmap.io.builder import SkippedRecords
from stillmap.io.text_lines import Line, Progress, read_lines, share_progress
from stillmap.prepare.lasers import RawLaser
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow

BAD_LINE = "line that cannot be read"
BYTE_ORDER_MARK = b"\xef\xbb\xbf"

# fields of the poses, and what follows them, between the readings and the stamp, by kind of line
_FIXED_FIELDS = {
    **dict.fromkeys((b"FLASER", b"RLASER"), 6),
    **dict.fromkeys((b"RAWLASER1", b"RAWLASER2", b"RAWLASER3", b"RAWLASER4"), 0),
    **dict.fromkeys((b"ROBOTLASER1", b"ROBOTLASER2"), 11),
}
SCAN_KINDS = tuple(_FIXED_FIELDS)
WITHOUT_ANGLES = ("FLASER", "RLASER")
_HEADER_FIELDS = 7
_MAX_POSE = 1e7  # m or rad, far beyond any odometry
_COMMENT = (b"#", b"//")
_MAX_UNKNOWN_KINDS = 50  # counted one by one; a text that is no log has thousands


class ScanConfig(NamedTuple):
    """Beam angles of a scan, its number of readings and its declared maximum range."""

    start_angle: float  # rad
    angle_step: float  # rad
    n: int
    max_range: float | None = None  # m


class ScanLine(NamedTuple):
    """A laser line. `poses` are x, y, theta of laser and robot, () for kinds without them.

    An ODOM line has the pose of the robot alone, and no ranges.
    """

    stamp_ns: int
    ranges: list[float]
    config: ScanConfig
    poses: tuple[float, ...]
    stamp: list[bytes]  # 1 to 3 fields `ipc_timestamp hostname logger_timestamp`


def flaser_config(n: int, fov: float = math.pi) -> ScanConfig:
    """Beam angles of a FLASER or RLASER line, which declares none: a half circle from -90 degrees.

    The step is 180 / n degrees for even n, which omits the last beam, and 180 / (n - 1) for odd n.
    Likewise for another field of view `fov`, in radians.
    """
    steps = n if n % 2 == 0 else max(n - 1, 1)
    return ScanConfig(-fov / 2, fov / steps, n)


def first_reading(kind: bytes) -> int:
    """Index of the first reading among the fields of a scan line, of which the name is field 0."""
    return 2 if kind.decode() in WITHOUT_ANGLES else _HEADER_FIELDS + 2


def parse_scan(kind: bytes, fields: list[bytes]) -> ScanLine:
    """Parse a laser line, `fields` without the name.

    Raises:
        ValueError: the line cannot be used.
    """
    first, n_fixed = first_reading(kind) - 1, _FIXED_FIELDS[kind]
    n, header = _parse_count(fields, first - 1), fields[: first - 1]
    tail = fields[first + n :]
    if header:  # remissions
        tail = tail[1 + _parse_count(tail, 0, least=0) :]
    stamp = tail[n_fixed:]
    if n > len(fields) - first - 1 or not _is_stamp(stamp):
        raise ValueError(BAD_LINE)
    ranges = _parse_numbers(fields[first : first + n])
    config = _parse_header(header, n) if header else flaser_config(n)
    poses = (*_parse_pose(tail[0:3]), *_parse_pose(tail[3:6])) if n_fixed else ()
    return ScanLine(parse_ns(stamp[0].decode("ascii")), ranges, config, poses, stamp)


def _parse_odometry(fields: list[bytes]) -> ScanLine:
    """Parse an ODOM line likewise."""
    if not _is_stamp(fields[6:]):
        raise ValueError(BAD_LINE)
    pose, stamp_ns = _parse_pose(fields[0:3]), parse_ns(fields[6].decode("ascii"))
    return ScanLine(stamp_ns, [], ScanConfig(0.0, 0.0, 0), tuple(pose), fields[6:])


def _parse_count(fields: list[bytes], at: int, least: int = 1) -> int:
    digits = fields[at] if at < len(fields) else b""
    if not digits.isdigit() or len(digits) > 9 or int(digits) < least:
        raise ValueError(BAD_LINE)
    return int(digits)


def _is_stamp(fields: list[bytes]) -> bool:
    """True if `fields` have the form `ipc_timestamp [hostname [logger_timestamp]]`.

    A host name is no number, or an integer followed by the logger's stamp: so a wrong number of
    readings is noticed even where stamps are missing.
    """
    if len(fields) == 3:
        is_host = fields[1].isdigit() or not _is_number(fields[1])
        return is_host and _is_number(fields[2])
    return len(fields) == 1 or (len(fields) == 2 and not _is_number(fields[1]))


def _is_number(field: bytes) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _parse_numbers(fields: list[bytes]) -> list[float]:
    if b"_" in b" ".join(fields):  # Python reads 1_000 as a number
        raise ValueError(BAD_LINE)
    return [float(field) for field in fields]


def _parse_pose(fields: list[bytes]) -> list[float]:
    pose = _parse_numbers(fields)
    # written so that NaN fails too
    if not all(abs(value) < _MAX_POSE for value in pose):
        raise ValueError(BAD_LINE)
    return pose


def _parse_header(header: list[bytes], n: int) -> ScanConfig:
    """Start, step and declared maximum; a missing step follows from the field of view."""
    start, fov, step, max_range = _parse_numbers(header[1:5])
    if not 0.0 < step < math.pi and 0.0 < fov <= 2.1 * math.pi:
        step = fov / max(n - 1, 1)
    if not (0.0 < step < math.pi and abs(start) <= 4.0 * math.pi):
        raise ValueError(BAD_LINE)
    return ScanConfig(start, step, n, max_range if 0.0 < max_range < math.inf else None)


class LaserLog:
    """The scans of one kind of line (`FLASER`), in log order.

    Attributes:
        rows: line, stamp, config and whether the host is a number, of each scan.
        ranges: readings of all scans, one after the other.
        configs: their numbers.
        poses: laser x y theta, robot x y theta of each scan, if there are any.

    Attributes of the T usable scans, in order of time, once they are selected:
        line, stamp_ns: (T,) line numbers, from 1, and stamps.
        robot_poses, laser_poses: (T, 3) on the lines; None: they have none.
    """

    line: Int64
    stamp_ns: Int64
    laser_poses: Float | None = None
    robot_poses: Float | None = None

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.rows, self.ranges, self.poses = array("q"), array("f"), array("d")
        self.configs: dict[ScanConfig, int] = {}

    def __len__(self) -> int:
        return len(self.rows) // 4

    def add(self, line: int, scan: ScanLine) -> None:
        # in a log with named hosts a number is a sign of shifted fields
        is_number = len(scan.stamp) > 1 and _is_number(scan.stamp[1])
        config = self.configs.setdefault(scan.config, len(self.configs))
        self.rows.extend((line, scan.stamp_ns, config, is_number))
        self.ranges.extend(scan.ranges)
        self.poses.extend(scan.poses)

    def select_usable(self, skipped: SkippedRecords) -> None:
        """Select the scans in order of time. Stamps of different lasers need not be in order."""
        line, stamps, config, is_number = np.asarray(self.rows).reshape(-1, 4).T
        shifted = (is_number > 0) & (is_number.mean() < 0.5)
        skipped.add_all(BAD_LINE, line[shifted])
        scans = np.flatnonzero(~shifted)
        scans = scans[skipped.order_in_time(stamps[scans], line[scans])]
        self.line, self.stamp_ns = line[scans], stamps[scans]
        count = np.array([one.n for one in self.configs])[config]
        self._start, self._shape = (np.cumsum(count) - count)[scans], config[scans]
        if len(self.poses):
            poses = np.asarray(self.poses).reshape(-1, 6)[scans]
            self.laser_poses, self.robot_poses = poses[:, :3], poses[:, 3:]

    def raw(self, directions: list[Float], max_range: float | None = None) -> RawLaser:
        """The usable scans with the directions (n, 2) of each config."""
        ranges = np.frombuffer(self.ranges, np.float32)
        scans = self.stamp_ns, ranges, self._start, self._shape
        known: list[NDArray[np.floating[Any]]] = list(directions)
        return RawLaser(self.kind, *scans, known, max_range=max_range, sample=maxsize)


class CarmenLog:
    """The records of a CARMEN log, or of the parts of one."""

    def __init__(self, window: TimeWindow) -> None:
        self._window = window
        self.lasers: dict[str, LaserLog] = {}
        self.odom_rows, self.odom_poses = array("q"), array("d")  # rows: line and stamp
        self.params: dict[str, str] = {}
        self.records: Counter[str] = Counter()
        self.ignored: Counter[str] = Counter()
        self.skipped = SkippedRecords()  # lines of unknown kind
        self.skipped_scans: dict[str, SkippedRecords] = {}  # by kind of line
        self.skipped_odometry = SkippedRecords()
        self.n_lines = 0
        self._stamp_fields: dict[bytes, int] = {}

    def add(self, line: Line) -> None:
        """Add a line; one that cannot be used is counted."""
        self.n_lines = line.number
        fields = line.text.split()
        if line.damage:
            self.skipped.add(BAD_LINE, line.number)
        elif line.text.lstrip().startswith(_COMMENT):
            self.ignored["comments"] += 1
        elif fields and fields[0] == b"PARAM":
            self.records["PARAM"] += 1
            if len(fields) >= 3:
                self.params[_text(fields[1])] = _text(fields[2])
        elif fields and fields[0] in (*SCAN_KINDS, b"ODOM"):
            self._add_measurement(line, fields[0], fields[1:])
        elif fields:
            self._ignore(line, fields[0])

    def _add_measurement(self, line: Line, name: bytes, fields: list[bytes]) -> None:
        """Add a scan or pose."""
        kind, is_pose = _text(name), name == b"ODOM"
        skipped = self.skipped_odometry
        if not is_pose:
            skipped = self.skipped_scans.setdefault(kind, SkippedRecords())
        try:
            record = _parse_odometry(fields) if is_pose else parse_scan(name, fields)
            # a line without an end may have lost fields, or digits of its stamp, unnoticed
            if not line.text.endswith(b"\n") and len(record.stamp) < self._stamp_fields.get(
                name, 1
            ):
                raise ValueError(BAD_LINE)
        except ValueError:
            skipped.add(BAD_LINE, line.number)
            return
        self.records[kind] += 1
        self._stamp_fields[name] = len(record.stamp)
        if is_pose:
            self.odom_rows.extend((line.number, record.stamp_ns))
            self.odom_poses.extend(record.poses)
        elif self._window.select(record.stamp_ns):
            self.lasers.setdefault(kind, LaserLog(kind)).add(line.number, record)

    def _ignore(self, line: Line, name: bytes) -> None:
        is_cut = not line.text.endswith(b"\n")
        if is_cut and any(kind.startswith(name) for kind in (*SCAN_KINDS, b"ODOM")):
            self.skipped.add(BAD_LINE, line.number)
            return
        kind = _text(name)
        known = kind in self.ignored or len(self.ignored) < _MAX_UNKNOWN_KINDS
        self.ignored[kind if known else "others"] += 1


def read_log(
    paths: Sequence[Path], progress: Progress | None = None, window: TimeWindow | None = None
) -> CarmenLog:
    """Read a CARMEN log, plain or gzip, or its parts. Lines are counted through all parts.

    Args:
        paths: the files, in order of time.
        progress: called with the share of the files that is read, 0 to 1.
        window: selects the scans; None: all.

    Raises:
        InputError: a file cannot be read, or has no scan in the window.
    """
    window = window or TimeWindow(ReadOptions())
    log = CarmenLog(window)
    for number, path in enumerate(paths):
        first = log.n_lines
        for line in read_lines(path, share_progress(progress, number, len(paths))):
            if line.number == 1:
                line = line._replace(text=line.text.removeprefix(BYTE_ORDER_MARK))
            log.add(line._replace(number=first + line.number))
    window.require_scans(str(paths[0]))
    return log


def _text(field: bytes) -> str:
    return field[:100].decode("ascii", "replace")
