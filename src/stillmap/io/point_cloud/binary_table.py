"""Tables of points as PCD and PLY files lay them down: text, or records of bytes.

The counts in a header are never believed beyond what the file holds.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.io.text_lines import read_lines

_BLOCK = 1 << 18  # points read together
_LARGEST_RECORD = 1 << 16  # bytes of one point
_MOST_COLUMNS = 1 << 12  # of text


@dataclass(frozen=True)
class Field:
    """A column: its name, the type of its values with their byte order, how many there are."""

    name: str
    dtype: np.dtype[Any]
    count: int = 1

    @property
    def size(self) -> int:
        return self.dtype.itemsize * self.count


@dataclass(frozen=True)
class TableLayout:
    """Where a file's points lie.

    Attributes:
        path: the file.
        fields: the columns in order.
        rows: points that the header promises.
        start: byte at which they begin.
        lines: of the header and what else comes before, where they are text.
        text: they are text, one line each.
    """

    path: Path
    fields: tuple[Field, ...]
    rows: int
    start: int
    lines: int
    text: bool

    @property
    def record(self) -> int:
        """Bytes of one point."""
        return sum(field.size for field in self.fields)

    def find_column(self, name: str) -> tuple[Field, int, int]:
        """The first column of this name, the byte and the number of the value it begins with.

        Raises:
            InputError: there is none.
        """
        byte = value = 0
        for field in self.fields:
            if field.name == name:
                return field, byte, value
            byte, value = byte + field.size, value + field.count
        raise InputError(f"has no column '{name}'", where=str(self.path))


def read_columns(layout: TableLayout, wanted: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
    """Values (k,) of the wanted columns, a block of points at a time; text comes as float64.

    Raises:
        InputError: a column is missing, the file is shorter than it says, or damaged.
    """
    return _from_text(layout, wanted) if layout.text else _from_records(layout, wanted)


def check_record_size(layout: TableLayout) -> None:
    """Refuse points of impossible size.

    Raises:
        InputError: see there.
    """
    if not 0 < layout.record <= _LARGEST_RECORD:
        what = f"is damaged: a point of {layout.record} bytes"
        raise InputError(what, where=str(layout.path))


def truncated_error(path: Path, found: int, promised: int) -> InputError:
    """The error for a file with fewer points than its header says."""
    return InputError(f"is cut short: {found} of {promised} points are there", where=str(path))


def _from_records(layout: TableLayout, wanted: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
    check_record_size(layout)
    places = [layout.find_column(name) for name in wanted]
    held = (layout.path.stat().st_size - layout.start) // layout.record
    if held < layout.rows:
        raise truncated_error(layout.path, max(held, 0), layout.rows)
    names = [str(i) for i in range(len(places))]
    dtype = np.dtype(
        {
            "names": names,
            "formats": [field.dtype for field, _, _ in places],
            "offsets": [byte for _, byte, _ in places],
            "itemsize": layout.record,
        }
    )
    with layout.path.open("rb") as file:
        file.seek(layout.start)
        for first in range(0, layout.rows, _BLOCK):
            n = min(_BLOCK, layout.rows - first)
            rows = np.frombuffer(file.read(n * layout.record), np.uint8)
            if len(rows) < n * layout.record:
                raise truncated_error(layout.path, first + len(rows) // layout.record, layout.rows)
            yield [rows.view(dtype)[name] for name in names]


def _from_text(layout: TableLayout, wanted: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
    numbers = [layout.find_column(name)[2] for name in wanted]
    if max(numbers) >= _MOST_COLUMNS:
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
    """Lines that are not empty, after the first `skip`; unpacked where the file is gzip.

    Args:
        path: the file.
        skip: lines that are passed over.
        limit: bytes that may come out of it.

    Raises:
        InputError: a line is too long, a gzip stream is damaged, or there is more than `limit`.
    """
    size = 0
    for line in read_lines(path):
        size += len(line.text)
        if line.damaged:
            raise InputError("is a damaged gzip file", where=f"{path}:{line.number}")
        if line.too_long:
            raise InputError("is damaged: a line without end", where=f"{path}:{line.number}")
        if limit is not None and size > limit:
            what = f"is too large: more than {limit >> 20} MiB when unpacked"
            raise InputError(what, where=str(path))
        # as NumPy will see it: more than ASCII's spaces are spaces to it
        if line.number > skip and not line.text.decode("latin1").isspace():
            yield line.text


def parse_numbers(
    lines: Iterator[bytes], rows: int, use: Sequence[int] | None, path: Path
) -> NDArray[np.float64]:
    """(k, columns) numbers of up to `rows` lines.

    Raises:
        InputError: a line holds something else, or too few.
    """
    taken = list(islice(lines, rows))
    if not taken:
        return np.empty((0, 0 if use is None else len(use)))
    try:
        return np.loadtxt(taken, np.float64, comments=None, usecols=use, ndmin=2, encoding="latin1")
    except (ValueError, OverflowError) as error:
        what = f"is damaged: {str(error).partition(';')[0]}"
        raise InputError(what, where=str(path)) from error
