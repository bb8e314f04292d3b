"""The content of a CARMEN log, gathered compactly line by line."""

from array import array
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.carmen.messages import SCAN_PARSERS, BadRecord, ScanConfig, ScanLine, parse_odom
from stillmap.io.text_lines import Line, Progress, read_lines

CUT_LINE = "cut last line"
DAMAGED_STREAM = "damaged gzip stream"
LONG_LINE = "over-long line"
_COMMENT = (b"#", b"//")
_MOST_OTHER = 5_000_000  # lines: a log has a scan or a pose among ten
_KINDS_NAMED = 50  # unknown kinds counted one by one; a text that is no log has thousands


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
        if scan.laser_pose is not None and scan.robot_pose is not None:
            self.has_poses = True
            self.poses.extend(scan.laser_pose + scan.robot_pose)

    def typical_count(self) -> int:
        """The number of readings that most scans have; the larger of two as frequent."""
        return max(Counter(self.count).items(), key=lambda item: (item[1], item[0]))[0]

    def stack_readings(self, scans: NDArray[np.intp]) -> NDArray[np.float32]:
        """(len(scans), n) float32 readings; all these scans have the same number of them."""
        count = np.asarray(self.count)
        start = np.concatenate([[0], np.cumsum(count)[:-1]])
        n = int(count[scans[0]])
        flat = np.frombuffer(self.ranges, np.float32)
        if len(scans) * n == len(flat):
            return flat.reshape(-1, n)
        return np.asarray(flat[start[scans][:, None] + np.arange(n)])


class CarmenLog:
    """Everything of a CARMEN log that matters here."""

    def __init__(self) -> None:
        self.lasers: dict[str, LaserLog] = {}
        self.odom_stamp_ns = array("q")
        self.odom_poses = array("d")
        self.params: dict[str, str] = {}
        self.records: Counter[str] = Counter()
        self.ignored: Counter[str] = Counter()
        self.skipped = SkippedRecords()  # lines of which it cannot be told what they were
        self.skipped_scans: dict[str, SkippedRecords] = {}  # by kind of line
        self.skipped_odometry = SkippedRecords()
        self.n_lines = 0
        self._stamp_fields: dict[bytes, int] = {}

    def add(self, line: Line) -> None:
        """Take in one line; what cannot be used is counted."""
        self.n_lines = line.number
        if line.damaged:
            self.skipped.add(DAMAGED_STREAM, line.number)
            return
        text = line.text.removeprefix(b"\xef\xbb\xbf") if line.number == 1 else line.text
        if line.too_long:
            self.skipped.add(LONG_LINE, line.number)
        elif text.lstrip().startswith(_COMMENT):
            self.ignored["comments"] += 1
        elif fields := text.split():
            self._add_record(line, fields[0], fields[1:])

    def _add_record(self, line: Line, name: bytes, fields: list[bytes]) -> None:
        if name == b"PARAM":
            self.records["PARAM"] += 1
            if len(fields) >= 2:
                self.params[_text(fields[0])] = _text(fields[1])
            return
        if name != b"ODOM" and name not in SCAN_PARSERS:
            self._ignore(line, name)
            return
        if name == b"ODOM":
            skipped = self.skipped_odometry
        else:
            skipped = self.skipped_scans.setdefault(_text(name), SkippedRecords())
        try:
            stamp_fields = self._add_measured(line, name, fields)
        except BadRecord as bad:
            skipped.add(bad.reason if line.ended else CUT_LINE, line.number)
        else:
            self.records[_text(name)] += 1
            self._stamp_fields[name] = stamp_fields

    def _add_measured(self, line: Line, name: bytes, fields: list[bytes]) -> int:
        if name == b"ODOM":
            odom = parse_odom(fields)
            self._require_whole(line, name, odom.stamp_fields)
            self.odom_stamp_ns.append(odom.stamp_ns)
            self.odom_poses.extend(odom.pose)
            return odom.stamp_fields
        scan = SCAN_PARSERS[name](fields)
        self._require_whole(line, name, scan.stamp_fields)
        kind = _text(name)
        self.lasers.setdefault(kind, LaserLog(kind)).add(line.number, scan)
        return scan.stamp_fields

    def _require_whole(self, line: Line, name: bytes, stamp_fields: int) -> None:
        # a line without an end may have lost fields, or digits of its stamp, unseen
        if not line.ended and stamp_fields < self._stamp_fields.get(name, 1):
            raise BadRecord(CUT_LINE)

    def _ignore(self, line: Line, name: bytes) -> None:
        if not line.ended and any(kind.startswith(name) for kind in (*SCAN_PARSERS, b"ODOM")):
            self.skipped.add(CUT_LINE, line.number)
            return
        kind = _text(name)
        known = kind in self.ignored or len(self.ignored) < _KINDS_NAMED
        self.ignored[kind if known else "others"] += 1


def read_log(path: Path, progress: Progress | None = None) -> CarmenLog:
    """The content of a CARMEN log, plain or gzip.

    Raises:
        InputError: the file cannot be opened or read, or goes on and on without a record.
    """
    log = CarmenLog()
    known = 0
    for line in read_lines(path, progress):
        log.add(line)
        if line.number % _MOST_OTHER == 0:
            before, known = known, log.records.total()
            if known == before:
                what = f"has {_MOST_OTHER} lines in a row that are no records"
                raise InputError(what, where=f"{path}:{line.number}")
    return log


def param_number(params: dict[str, str], name: str) -> float | None:
    """The PARAM of this name as a finite number; None where there is none."""
    try:
        value = float(params[name])
    except (KeyError, ValueError):
        return None
    return value if abs(value) < 1e6 else None


def _text(field: bytes) -> str:
    return field[:100].decode("ascii", "replace")
