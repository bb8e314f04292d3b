"""Tables of points in files: text lines or binary records, columns by name, the clock of times.

Counts in a header are checked against the size of the file before memory is allocated.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.core.timestamps import MAX_BEAM_TIME, MAX_STAMP_NS
from stillmap.io.text_lines import read_lines

_BLOCK = 1 << 18  # points read at once
_MAX_RECORD = 1 << 16  # bytes of one point

_TIME_NAMES = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
_UNITS = (1, 10**3, 10**6, 10**9)  # per second: s, ms, us, ns
_SINCE_1970 = (6e8, 5e9)  # s: the years 1989 to 2128
# the limits differ by less than 1000: at most one unit fits
_SCAN_DURATION = (0.005, 2.0)  # s
_PERIOD_SHARE = (0.05, 1.5)  # duration of a scan over the time between stamps
_SAME_CLOCK_NS = 10 * 10**9

Columns = Sequence[NDArray[Any]]  # values (k,) of each column


@dataclass(frozen=True)
class Field:
    """A column: name, type with byte order, and count of values per point."""

    name: str
    dtype: np.dtype[Any]
    count: int = 1

    @property
    def size(self) -> int:
        return self.dtype.itemsize * self.count


@dataclass(frozen=True)
class TableLayout:
    """Position and columns of the points in a file.

    Attributes:
        path: the file.
        fields: the columns in order.
        rows: point count of the header; negative: text up to the end of the file.
        header: bytes of the header.
        start: byte offset of the first point.
        lines: line count before the first point, of text.
        text: points are text, one line each.
        compressed: columns follow each other, in one compressed block.
        ordered: points are found by their number: none can be taken out.
    """

    path: Path
    fields: tuple[Field, ...]
    rows: int
    header: int = 0
    start: int = 0
    lines: int = 0
    text: bool = False
    compressed: bool = False
    ordered: bool = False

    @property
    def record(self) -> int:
        """Bytes of one point.

        Raises:
            InputError: none or implausibly many.
        """
        size = sum(field.size for field in self.fields)
        if not 0 < size <= _MAX_RECORD:
            raise InputError(f"is damaged: a point of {size} bytes", where=str(self.path))
        return size

    def find_column(self, name: str) -> tuple[Field, int, int]:
        """The first column of a name, its byte offset and its value index within a point.

        Raises:
            InputError: there is no such column.
        """
        byte = value = 0
        for field in self.fields:
            if field.name == name:
                return field, byte, value
            byte, value = byte + field.size, value + field.count
        raise InputError(f"has no column '{name}'", where=str(self.path))


def read_columns(layout: TableLayout, names: Sequence[str]) -> Iterator[Columns]:
    """Yield values (k,) of the named columns, block by block; text as float64.

    Raises:
        InputError: a column is missing, or the file is truncated or damaged.
    """
    blocks = _read_text(layout, names) if layout.text else _read_records(layout, names)
    return require_all(blocks, layout.rows, layout.path)


def require_all(blocks: Iterable[Columns], rows: int, path: Path) -> Iterator[Columns]:
    """Yield the blocks of a table of `rows` points; negative: any number.

    Raises:
        InputError: there are fewer.
    """
    count = 0
    for block in blocks:
        count += len(block[0])
        yield block
    if count < rows:
        raise truncated_error(path)


def gather_points(
    blocks: Iterable[Columns],
    convert: Callable[[NDArray[Any]], NDArray[Any]],
    scratch: Path | None = None,
) -> tuple[Float32, list[NDArray[Any]]]:
    """Points (n, 3) of blocks of x, y, z and further columns, and those columns.

    Args:
        blocks: of a table.
        convert: of points (k, 3) as they are in the file.
        scratch: folder for memory-mapped buffers; None: the system's temporary folder.
    """
    points, further = ArrayBuilder(np.float32, (3,), scratch), []
    for block in blocks:
        points.append(convert(np.stack(block[:3], axis=1)))
        further.append(block[3:])
    return points.finish(), [np.concatenate(parts) for parts in zip(*further, strict=True)]


def open_table(path: Path) -> InputFile:
    """Open a file that is not empty.

    Raises:
        InputError: it is, or cannot be opened.
    """
    file = InputFile(path)
    if not file.size:
        file.close()
        raise InputError("is empty", where=str(path))
    return file


def truncated_error(path: Path) -> InputError:
    """The error for a file with fewer points than its header states."""
    return InputError("is truncated: points are missing", where=str(path))


def split_header(
    path: Path, head: bytes, is_end: Callable[[list[str]], bool]
) -> tuple[list[list[str]], int]:
    """The words of each line of a header up to its last, and the byte offset of its end.

    Raises:
        InputError: `head`, the first bytes of the file, holds no last line.
    """
    lines: list[list[str]] = []
    start = 0
    while not (lines and is_end(lines[-1])):
        end = head.find(b"\n", start)
        if end < 0:
            raise InputError("is truncated: its header does not end", where=str(path))
        lines.append(head[start:end].decode("ascii", "replace").split())
        start = end + 1
    return lines, start


def record_dtype(columns: Mapping[str, tuple[DTypeLike, int]], size: int) -> np.dtype[Any]:
    """The type of records of `size` bytes, with (type, byte offset) of columns by name."""
    kinds, offsets = zip(*columns.values(), strict=True)
    return np.dtype(
        {"names": list(columns), "formats": kinds, "offsets": offsets, "itemsize": size}
    )


def _read_records(layout: TableLayout, names: Sequence[str]) -> Iterator[Columns]:
    columns = [layout.find_column(name) for name in names]
    by_name = {str(i): (field.dtype, byte) for i, (field, byte, _) in enumerate(columns)}
    size, rows = layout.record, layout.rows
    dtype = record_dtype(by_name, size)
    with InputFile(layout.path) as file:
        if file.size < layout.start + rows * size:
            raise truncated_error(layout.path)
        file.seek(layout.start)
        for first in range(0, rows, _BLOCK):
            records = np.frombuffer(file.read(min(_BLOCK, rows - first) * size), dtype)
            yield [records[name] for name in by_name]


def _read_text(layout: TableLayout, names: Sequence[str]) -> Iterator[Columns]:
    numbers = [layout.find_column(name)[2] for name in names]
    lines = iter_text_lines(layout.path, layout.lines)
    lines = lines if layout.rows < 0 else islice(lines, layout.rows)
    while len(block := parse_numbers(lines, _BLOCK, numbers, layout.path)):
        yield list(block.T)


def iter_text_lines(path: Path, skip: int = 0) -> Iterator[bytes]:
    """Yield lines that are not empty, of a text or gzip file, without the first `skip` ones.

    Raises:
        InputError: a line is too long, or the gzip stream is damaged or too large.
    """
    for line in read_lines(path):
        if line.damage:
            raise InputError(f"is damaged: {line.damage}", where=f"{path}:{line.number}")
        if line.number > skip and not is_blank(line.text):
            yield line.text


def is_blank(line: bytes) -> bool:
    """True if a line of a table is skipped: it has nothing but whitespace of Latin-1."""
    return line.decode("latin1").isspace()  # as np.loadtxt does


def parse_numbers(
    lines: Iterator[bytes], rows: int, use: Sequence[int] | None, path: Path
) -> Float:
    """Parse up to `rows` lines into (k, columns) float64.

    Raises:
        InputError: a line holds something other than numbers, or too few.
    """
    taken = list(islice(lines, rows))
    if not taken:
        return np.empty((0, 0 if use is None else len(use)))
    try:
        return np.loadtxt(taken, np.float64, comments=None, usecols=use, ndmin=2, encoding="latin1")
    except (ValueError, OverflowError) as error:
        what = f"is damaged: {str(error).partition(';')[0]}"
        raise InputError(what, where=str(path)) from error


class Clock(NamedTuple):
    """Unit and epoch of a time column.

    Attributes:
        per_second: units per second.
        absolute: times count from 1970; else from the scan's stamp.
    """

    per_second: int
    absolute: bool


def find_time_column(names: Iterable[str]) -> str | None:
    """The name of the time column; None: there is none."""
    return next((name for name in names if name.lower() in _TIME_NAMES), None)


def detect_clock(values: NDArray[Any], period: float | None) -> Clock | None:
    """The one unit that gives a scan a plausible duration; None: none or several.

    Args:
        values: (n,) as recorded; not finite: unknown.
        period: seconds between stamps; None: unknown.
    """
    values = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if not len(values):
        return None
    first, last = float(values.min()), float(values.max())
    for unit in _UNITS:
        # absolute times differ by little within a scan
        if _SINCE_1970[0] < first / unit < _SINCE_1970[1] and last - first < 0.01 * first:
            return Clock(unit, True)
    limits = [_SCAN_DURATION]
    if period is not None and period > 0:
        limits.append((_PERIOD_SHARE[0] * period, _PERIOD_SHARE[1] * period))
    fitting = {
        unit for unit in _UNITS for low, high in limits if low <= (last - first) / unit <= high
    }
    return Clock(fitting.pop(), False) if len(fitting) == 1 else None


def convert_times(
    values: NDArray[Any], usable: Bool, clock: Clock, stamp_ns: int | None
) -> tuple[int | None, Float]:
    """The stamp of a scan, and seconds (n,) from it to each point, NaN where unknown.

    Args:
        values: (n,) as recorded.
        usable: (n,) mask of valid points.
        clock: unit and epoch.
        stamp_ns: stamp of the scan; None: the first absolute time.
    """
    if not clock.absolute:
        return stamp_ns, _drop_outliers(values.astype(np.float64) / clock.per_second)
    unit = 10**9 // clock.per_second  # ns
    known = usable & np.isfinite(values) & (values > 0) & (values < MAX_STAMP_NS / unit)
    after = np.full(len(values), np.nan)
    if not known.any():
        return stamp_ns, after
    kept = values[known]
    if kept.dtype.kind == "f":
        ns = np.round(kept * float(unit)).astype(np.int64)
    else:  # integers stay exact
        ns = kept.astype(np.int64) * unit
    middle = np.partition(ns, len(ns) // 2)[len(ns) // 2]
    first = int(ns[np.abs(ns - middle) < int(MAX_BEAM_TIME * 1e9)].min())
    if stamp_ns is None:
        stamp_ns = first
    same_clock = abs(stamp_ns - first) < _SAME_CLOCK_NS
    after[known] = (ns - (stamp_ns if same_clock else first)) / 1e9
    return stamp_ns, _drop_outliers(after)


def _drop_outliers(seconds: Float) -> Float:
    return np.where(np.abs(seconds) <= MAX_BEAM_TIME, seconds, np.nan)
