"""Copies of the points of PCD and PLY files without some of them."""

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.input_files import InputFile
from stillmap.io.filtered_copy import Mask, require_rows
from stillmap.io.point_cloud.binary_table import (
    Field,
    TableLayout,
    check_record_size,
    is_blank,
    truncated_error,
)

_BLOCK_BYTES = 8 << 20  # of points copied at once
_WORD = re.compile(rb"\S+")

EditLine = Callable[[bytes], bytes]


def write_table(
    layout: TableLayout, new: Path, mask: Mask, edit_header_line: EditLine, *, keep: bool
) -> None:
    """Copy a file without the points of a mask.

    Args:
        layout: of the file.
        new: its copy.
        mask: (n,) points to remove.
        edit_header_line: changes counts in a line of the header.
        keep: keep these points without coordinates: NaN, or 0 in columns of integers.

    Raises:
        InputError: the file has another number of points, or is damaged.
    """
    require_rows(mask, layout.rows, layout.path)
    with InputFile(layout.path) as source, new.open("wb") as target:
        write_header(source, target, layout, edit_header_line)
        copy = _copy_lines if layout.text else _copy_records
        copy(source, target, layout, mask, keep)
        shutil.copyfileobj(source, target)


def write_header(
    source: IO[bytes], target: IO[bytes], layout: TableLayout, edit_line: EditLine
) -> None:
    """Copy the header, each line through `edit_line`."""
    header = source.read(layout.header)
    target.write(b"".join(edit_line(line) for line in header.splitlines(keepends=True)))


def set_count(line: bytes, word: int, count: int) -> bytes:
    """A line of a header with its number at index `word` replaced; all else stays."""
    found = list(_WORD.finditer(line))[word]
    return line[: found.start()] + str(count).encode("ascii") + line[found.end() :]


def iter_coordinates(layout: TableLayout) -> Iterator[tuple[Field, int, int]]:
    """The columns x, y and z as `TableLayout.find_column` finds them."""
    return map(layout.find_column, "xyz")


def no_coordinate(field: Field) -> Any:
    """The value of a coordinate that is not known."""
    return np.nan if field.dtype.kind == "f" else 0


def _copy_records(
    source: IO[bytes], target: IO[bytes], layout: TableLayout, mask: Mask, keep: bool
) -> None:
    check_record_size(layout)
    shutil.copyfileobj(_Head(source, layout.start - layout.header), target)
    step = max(1, _BLOCK_BYTES // layout.record)
    for first in range(0, layout.rows, step):
        n = min(step, layout.rows - first)
        rows = np.frombuffer(source.read(n * layout.record), np.uint8)
        if len(rows) < n * layout.record:
            raise truncated_error(layout.path, first + len(rows) // layout.record, layout.rows)
        records = rows.reshape(n, layout.record).copy()
        removed = mask[first : first + n]
        if keep:
            _clear_coordinates(records, layout, removed)
            target.write(records.tobytes())
        else:
            target.write(records[~removed].tobytes())


def _clear_coordinates(records: NDArray[np.uint8], layout: TableLayout, removed: Mask) -> None:
    for field, byte, _ in iter_coordinates(layout):
        size = field.dtype.itemsize
        value = np.array(no_coordinate(field), field.dtype).tobytes()
        records[removed, byte : byte + size] = np.frombuffer(value, np.uint8)


def _copy_lines(
    source: IO[bytes], target: IO[bytes], layout: TableLayout, mask: Mask, keep: bool
) -> None:
    source.seek(0)
    header_lines = source.read(layout.header).count(b"\n")
    for _ in range(layout.lines - header_lines):
        target.write(source.readline())
    columns = {value: no_coordinate(field) for field, _, value in iter_coordinates(layout)}
    row = 0
    while row < layout.rows:
        line = source.readline()
        if not line:
            raise truncated_error(layout.path, row, layout.rows)
        if is_blank(line):
            target.write(line)
            continue
        if not mask[row]:
            target.write(line)
        elif keep:
            target.write(_replace_words(line, columns))
        row += 1


def _replace_words(line: bytes, values: dict[int, Any]) -> bytes:
    """A line with the words of some indices replaced; all else stays."""
    words, parts, at = list(_WORD.finditer(line)), [], 0
    for index in sorted(values):
        begin, end = words[index].span()
        parts += [line[at:begin], str(values[index]).encode("ascii")]
        at = end
    return b"".join([*parts, line[at:]])


class _Head:
    """The next `size` bytes of a file, as a file."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(min(size, self._left) if size >= 0 else self._left)
        self._left -= len(data)
        return data
