"""Point tables of PCD and PLY files: text lines or binary records.

Counts in a header are checked against the size of the file before memory is allocated.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile
from stillmap.io.text_lines import read_lines

_BLOCK = 1 << 18  # points read at once
_MAX_RECORD = 1 << 16  # bytes of one point
_MAX_COLUMNS = 1 << 12  # of text


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
        header: bytes of the header.
        rows: point count of the header.
        start: byte offset of the first point.
        lines: line count before the first point, of text.
        text: points are text, one line each.
    """

    path: Path
    fields: tuple[Field, ...]
    header: int
    rows: int
    start: int
    lines: int
    text: bool

    @property
    def record(self) -> int:
        """Bytes of one point."""
        return sum(field.size for field in self.fields)

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


def read_columns(layout: TableLayout, wanted: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
    """Yield values (k,) of the wanted columns, block by block; text as float64.

    Raises:
        InputError: a column is missing, or the file is truncated or damaged.
    """
    return _read_text(layout, wanted) if layout.text else _read_records(layout, wanted)


def check_record_size(layout: TableLayout) -> None:
    """Refuse records of zero or implausible size.

    Raises:
        InputError: the size of a point is invalid.
    """
    if not 0 < layout.record <= _MAX_RECORD:
        what = f"is damaged: a point of {layout.record} bytes"
        raise InputError(what, where=str(layout.path))


def truncated_error(path: Path, found: int, expected: int) -> InputError:
    """The error for a file with fewer points than its header states."""
    return InputError(f"is truncated: {found} of {expected} points are there", where=str(path))


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


def _read_records(layout: TableLayout, wanted: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
    check_record_size(layout)
    columns = [layout.find_column(name) for name in wanted]
    by_name = {str(i): (field.dtype, byte) for i, (field, byte, _) in enumerate(columns)}
    dtype = record_dtype(by_name, layout.record)
    with InputFile(layout.path) as file:
        available = (file.size - layout.start) // layout.record
        if available < layout.rows:
            raise truncated_error(layout.path, max(available, 0), layout.rows)
        file.seek(layout.start)
        for first in range(0, layout.rows, _BLOCK):
            n = min(_BLOCK, layout.rows - first)
            rows = np.frombuffer(file.read(n * layout.record), np.uint8)
            if len(rows) < n * layout.record:
                raise truncated_error(layout.path, first + len(rows) // layout.record, layout.rows)
            yield [rows.view(dtype)[name] for name in by_name]


def _read_text(layout: TableLayout, wanted: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
    numbers = [layout.find_column(name)[2] for name in wanted]
    if max(numbers) >= _MAX_COLUMNS:
        raise InputError("is damaged: too many columns", where=str(layout.path))
    lines = iter_text_lines(layout.path, layout.lines)
    for first in range(0, layout.rows, _BLOCK):
        n = min(_BLOCK, layout.rows - first)
        block = parse_numbers(lines, n, numbers, layout.path)
        if len(block):
            yield list(block.T)
        if len(block) < n:
            raise truncated_error(layout.path, first + len(block), layout.rows)


def iter_text_lines(path: Path, skip: int = 0, limit: int | None = None) -> Iterator[bytes]:
    """Yield lines that are not empty, of a text or gzip file.

    Args:
        path: the file.
        skip: count of lines to skip.
        limit: maximum size of the unpacked text in bytes.

    Raises:
        InputError: a line is too long, the gzip stream is damaged, or the text is too large.
    """
    size = 0
    for line in read_lines(path):
        size += len(line.text)
        if line.damaged:
            raise InputError("is a damaged gzip file", where=f"{path}:{line.number}")
        if line.too_long:
            raise InputError("is damaged: a line is too long", where=f"{path}:{line.number}")
        if limit is not None and size > limit:
            what = f"is too large: more than {limit >> 20} MiB when unpacked"
            raise InputError(what, where=str(path))
        if line.number > skip and not is_blank(line.text):
            yield line.text


def is_blank(line: bytes) -> bool:
    """True if a line of a table is skipped: it has nothing but whitespace of Latin-1."""
    return line.decode("latin1").isspace()  # as np.loadtxt does


def parse_numbers(
    lines: Iterator[bytes], rows: int, use: Sequence[int] | None, path: Path
) -> NDArray[np.float64]:
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
