"""Collects the records of a CARMEN log in compact arrays."""

from array import array
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.carmen.messages import (
    SCAN_PARSERS,
    BadRecord,
    OdometryLine,
    ScanConfig,
    ScanLine,
    parse_odom,
)
from stillmap.io.parts.repeats import RepeatFilter
from stillmap.io.text_lines import Line, Progress, read_lines, share_progress
from stillmap.prepare.options import ReadOptions
from stillmap.prepare.time_window import TimeWindow

BYTE_ORDER_MARK = b"\xef\xbb\xbf"
CUT_LINE = "cut last line"
DAMAGED_STREAM = "damaged gzip stream"
LONG_LINE = "over-long line"
_COMMENT = (b"#", b"//")
_MAX_UNKNOWN_LINES = 5_000_000  # in a row; one in ten lines of a log is a scan or a pose
_MAX_UNKNOWN_KINDS = 50  # counted one by one; a text that is no log has thousands


class LaserLog:
    """All scans of one kind of line (`FLASER`), in log order."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.line = array("q")
        self.stamp_ns = array("q")
        self.count = array("q")  # readings per scan
        self.host_is_number = array("b")
        self.ranges = array("f")  # readings of all scans, one after the other
        self.config = array("q")  # index into configs
        self.configs: dict[ScanConfig, int] = {}
        self.poses = array("d")  # laser x y theta, robot x y theta of each scan
        self.has_poses = False

    def add(self, line: int, scan: ScanLine) -> None:
        self.line.append(line)
        self.stamp_ns.append(scan.stamp_ns)
        self.count.append(len(scan.ranges))
        self.host_is_number.append(scan.host_is_number)
        self.ranges.extend(scan.ranges)
        self.config.append(self.configs.setdefault(scan.config, len(self.configs)))
        if scan.poses is not None:
            self.has_poses = True
            self.poses.extend(scan.poses)

    def typical_count(self) -> int:
        """The most frequent number of readings per scan, the larger of equally frequent ones."""
        return max(Counter(self.count).items(), key=lambda item: (item[1], item[0]))[0]

    def stack_readings(self, scans: NDArray[np.intp]) -> NDArray[np.float32]:
        """(len(scans), n) float32 readings of scans with the same number of readings."""
        count = np.asarray(self.count)
        start = np.concatenate([[0], np.cumsum(count)[:-1]])
        n = int(count[scans[0]])
        flat = np.frombuffer(self.ranges, np.float32)
        if len(scans) * n == len(flat):
            return flat.reshape(-1, n)
        return np.asarray(flat[start[scans][:, None] + np.arange(n)])


class CarmenLog:
    """The records of a CARMEN log, or of the parts of one.

    Attributes:
        repeats: recognises measurements that earlier parts hold already; None: there is one part.
    """

    def __init__(self, window: TimeWindow) -> None:
        self._window = window
        self.lasers: dict[str, LaserLog] = {}
        self.odom_stamp_ns = array("q")
        self.odom_poses = array("d")
        self.params: dict[str, str] = {}
        self.records: Counter[str] = Counter()
        self.ignored: Counter[str] = Counter()
        self.skipped = SkippedRecords()  # lines of unknown kind
        self.skipped_scans: dict[str, SkippedRecords] = {}  # by kind of line
        self.skipped_odometry = SkippedRecords()
        self.n_lines = self.n_repeated = 0
        self.repeats: RepeatFilter | None = None
        self._stamp_fields: dict[bytes, int] = {}

    def add(self, line: Line) -> None:
        """Add a line; one that cannot be used is counted."""
        self.n_lines = line.number
        if line.damaged:
            self.skipped.add(DAMAGED_STREAM, line.number)
            return
        if line.too_long:
            self.skipped.add(LONG_LINE, line.number)
        elif line.text.lstrip().startswith(_COMMENT):
            self.ignored["comments"] += 1
        elif fields := line.text.split():
            self._add_record(line, fields[0], fields[1:])

    def _add_record(self, line: Line, name: bytes, fields: list[bytes]) -> None:
        if name == b"PARAM":
            self.records["PARAM"] += 1
            if len(fields) >= 2:
                self.params[_text(fields[0])] = _text(fields[1])
            return
        if name == b"ODOM":
            skipped = self.skipped_odometry
        elif name in SCAN_PARSERS:
            skipped = self.skipped_scans.setdefault(_text(name), SkippedRecords())
        else:
            self._ignore(line, name)
            return
        try:
            stamp_fields = self._add_measurement(line, name, fields)
        except BadRecord as bad:
            skipped.add(bad.reason if line.ended else CUT_LINE, line.number)
        else:
            self.records[_text(name)] += 1
            self._stamp_fields[name] = stamp_fields

    def _add_measurement(self, line: Line, name: bytes, fields: list[bytes]) -> int:
        """Add a scan or pose; returns the number of its stamp fields."""
        record = parse_odom(fields) if name == b"ODOM" else SCAN_PARSERS[name](fields)
        # a line without an end may have lost fields, or digits of its stamp, unnoticed
        if not line.ended and record.stamp_fields < self._stamp_fields.get(name, 1):
            raise BadRecord(CUT_LINE)
        if self.repeats is not None and _is_repeated(self.repeats, name, record):
            self.n_repeated += 1
            return record.stamp_fields
        if isinstance(record, ScanLine):
            if not self._window.select(record.stamp_ns):
                return record.stamp_fields
            kind = _text(name)
            self.lasers.setdefault(kind, LaserLog(kind)).add(line.number, record)
        else:
            self.odom_stamp_ns.append(record.stamp_ns)
            self.odom_poses.extend(record.pose)
        return record.stamp_fields

    def _ignore(self, line: Line, name: bytes) -> None:
        if not line.ended and any(kind.startswith(name) for kind in (*SCAN_PARSERS, b"ODOM")):
            self.skipped.add(CUT_LINE, line.number)
            return
        kind = _text(name)
        known = kind in self.ignored or len(self.ignored) < _MAX_UNKNOWN_KINDS
        self.ignored[kind if known else "others"] += 1


def read_log(
    path: Path, progress: Progress | None = None, window: TimeWindow | None = None
) -> CarmenLog:
    """Read a CARMEN log, plain or gzip; see `read_logs`."""
    return read_logs([path], progress, window)


def read_logs(
    paths: Sequence[Path], progress: Progress | None = None, window: TimeWindow | None = None
) -> CarmenLog:
    """Read the parts of a CARMEN log, plain or gzip. Lines are counted through all parts.

    Args:
        paths: the files, in order of time.
        progress: called with the share of the files that is read, 0 to 1.
        window: selects the scans; None: all.

    Raises:
        InputError: a file cannot be read, has millions of lines in a row without a record, or no
            scan in the window.
    """
    window = window or TimeWindow(ReadOptions())
    log = CarmenLog(window)
    if len(paths) > 1:
        log.repeats = RepeatFilter()
    for number, path in enumerate(paths):
        if log.repeats is not None:
            log.repeats.begin_part()
        _add_file(log, path, share_progress(progress, number, len(paths)))
    window.require_scans(str(paths[0]))
    return log


def _add_file(log: CarmenLog, path: Path, progress: Progress | None) -> None:
    first, known = log.n_lines, log.records.total()
    for line in read_lines(path, progress):
        if line.number == 1:
            line = line._replace(text=line.text.removeprefix(BYTE_ORDER_MARK))
        log.add(line._replace(number=first + line.number))
        if line.number % _MAX_UNKNOWN_LINES == 0:
            before, known = known, log.records.total()
            if known == before:
                what = f"has {_MAX_UNKNOWN_LINES} lines in a row that are no records"
                raise InputError(what, where=f"{path}:{line.number}")


def _is_repeated(repeats: RepeatFilter, name: bytes, record: ScanLine | OdometryLine) -> bool:
    """True if an earlier part has the measurement; the time of logging may be another."""
    values = record.ranges if isinstance(record, ScanLine) else record.pose
    stamp = str(record.stamp_ns).encode()
    return repeats.is_repeated(record.stamp_ns, name, stamp, array("d", values).tobytes())


def _text(field: bytes) -> str:
    return field[:100].decode("ascii", "replace")
