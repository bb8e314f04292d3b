"""Tables of points in files: text lines or binary records, columns by name, the clock of times.

Counts in a header are checked against the size of the file before memory is allocated.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.errors import InputError, import_extra
from stillmap.core.input_files import InputFile
from stillmap.core.timestamps import MAX_BEAM_TIME, MAX_STAMP_NS
from stillmap.io.text_lines import read_lines

_BLOCK, _BLOCK_BYTES = 1 << 18, 64 << 20  # points and bytes read at once
_MAX_RECORD = 1 << 16  # bytes of one point
_MAX_UNPACKED = 1 << 30  # bytes
_MAX_EXPANSION = 100  # unpacked over packed bytes: LZF reaches a little less

_TIME_NAMES = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
_UNITS = (1, 10**3, 10**6, 10**9)  # per second: s, ms, us, ns
_SINCE_1970 = (6e8, 5e9)  # s: the years 1989 to 2128
# the limits differ by less than 1000: at most one unit fits
_SCAN_DURATION = (0.005, 2.0)  # s
_PERIOD_SHARE = (0.05, 1.5)  # duration of a scan over the time between stamps
_SAME_CLOCK_NS = 10 * 10**9

Columns = Sequence[NDArray[Any]]  # values (k,) of each column


Fields = list[tuple[str, str]]  # names and types of what is written


@dataclass(frozen=True)
class TableLayout:
    """Position and columns of the points in a file.

    Attributes:
        path: the file.
        dtype: of a point, with the columns by name; see `record_type`.
        rows: point count of the header; negative: text up to the end of the file.
        header: bytes of the header.
        start: byte offset of the first point.
        lines: line count before the first point, of text.
        text: points are text, one line each.
        compressed: columns follow each other, in one block compressed by LZF.
        ordered: points are found by their number: none can be taken out.
    """

    path: Path
    dtype: np.dtype[Any]
    rows: int
    header: int = 0
    start: int = 0
    lines: int = 0
    text: bool = False
    compressed: bool = False
    ordered: bool = False

    def count_values(self, name: str) -> int:
        """Number of values of a point before those of a column."""
        names = self.dtype.names or ()
        shapes = (self.dtype[before].shape for before in names[: names.index(name)])
        return sum(int(np.prod(shape)) for shape in shapes)


def record_type(columns: Sequence[tuple[str, DTypeLike, int]]) -> np.dtype[Any]:
    """The type of points with columns of a name, a type and a count of values each.

    The first of several columns keeps their name.

    Raises:
        ValueError: a point has no bytes, or implausibly many.
    """
    size = sum(np.dtype(kind).itemsize * count for _, kind, count in columns)
    if not 0 < size <= _MAX_RECORD:
        raise ValueError(f"a point of {size} bytes")
    first = {name: k for k, (name, *_) in reversed(list(enumerate(columns)))}
    return np.dtype(
        [
            (name if first[name] == k else f"{name} {k}", kind, (count,) if count > 1 else ())
            for k, (name, kind, count) in enumerate(columns)
        ]
    )


def read_columns(layout: TableLayout, names: Sequence[str]) -> Iterator[Columns]:
    """Yield values (k,) of the named columns, block by block; text as float64.

    Raises:
        InputError: a column is missing, or the file is truncated or damaged.
    """
    for name in names:
        if name not in (layout.dtype.names or ()):
            raise InputError(f"has no column '{name}'", where=str(layout.path))
    blocks = _read_text(layout, names)
    if not layout.text:
        blocks = ([_values(block[name]) for name in names] for block in iter_records(layout))
    return require_all(blocks, layout.rows, layout.path)


def _values(column: NDArray[Any]) -> NDArray[Any]:
    """The first value of each row."""
    return column if column.ndim == 1 else column[:, 0]


def _read_text(layout: TableLayout, names: Sequence[str]) -> Iterator[Columns]:
    numbers = list(map(layout.count_values, names))
    lines = iter_text_lines(layout.path, layout.lines)
    lines = lines if layout.rows < 0 else islice(lines, layout.rows)
    while len(block := parse_numbers(lines, _BLOCK, numbers, layout.path)):
        yield list(block.T)


def iter_records(layout: TableLayout) -> Iterator[NDArray[np.void]]:
    """Yield the points (k,) of a file that is no text, block by block.

    Raises:
        InputError: the file is truncated or damaged.
    """
    size, rows = layout.dtype.itemsize, layout.rows
    with InputFile(layout.path) as file:
        if layout.compressed:
            file.seek(layout.start)
            yield _unpack(file, layout)
            return
        if file.size < layout.start + rows * size:
            raise truncated_error(layout.path)
        file.seek(layout.start)
        step = max(1, min(_BLOCK, _BLOCK_BYTES // size))
        for first in range(0, rows, step):
            yield np.frombuffer(file.read(min(step, rows - first) * size), layout.dtype)


def _unpack(file: InputFile, layout: TableLayout) -> NDArray[np.void]:
    """The points of a compressed file.

    Raises:
        InputError: the compressed part is damaged or too large, or lzf is missing.
    """
    size, path = layout.rows * layout.dtype.itemsize, layout.path
    if size > _MAX_UNPACKED:
        what = f"is too large: more than {_MAX_UNPACKED >> 20} MiB when unpacked"
        raise InputError(what, where=str(path))
    packed_size, unpacked_size = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    packed, data = file.read(min(packed_size, file.size)), b""
    if len(packed) < packed_size or unpacked_size < size:
        raise truncated_error(path)
    if size and unpacked_size == size <= _MAX_EXPANSION * packed_size:
        with suppress(ValueError):
            data = import_extra("lzf", path).decompress(packed, size) or b""
    if len(data) != size:
        raise InputError("is damaged: its compressed part", where=str(path))
    records, at = np.empty(layout.rows, layout.dtype), 0
    for name in layout.dtype.names or ():
        column = records[name]
        values = np.frombuffer(data, column.dtype, column.size, at)
        records[name] = values.reshape(column.shape)
        at += column.nbytes
    return records


def erase_coordinates(points: NDArray[np.void], mask: Bool) -> None:
    """Make coordinates unknown where a mask of their shape says so: NaN, or 0 of integers."""
    for axis in "xyz":
        points[axis][mask] = unknown_value(points.dtype[axis])


def unknown_value(kind: np.dtype[Any]) -> float:
    """The value of a coordinate that is not known."""
    return np.nan if kind.base.kind == "f" else 0


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
