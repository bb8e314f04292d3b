"""Arrays that grow by appending, in unlinked temporary files where they are large.

The files are written, not mapped, while they grow, so that a full disk is an OSError and no crash.
"""

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core import arrays

Array = NDArray[Any]

# bytes in memory of an array that grows while somebody waits: more take long to write
QUICKLY_WRITTEN = 1 << 17
_WRITTEN_AT_ONCE = 1 << 20  # bytes at most in memory, once there is a file
_SMALL_PARTS = 256  # appended rows that become one array


class ArrayBuilder:
    """Builds an array by appending rows.

    Args:
        dtype: of the elements.
        row: shape of one row, () for numbers.
        folder: of the temporary file; None: the system's.
        in_memory: bytes that are kept in memory before the file is begun; None: as many as of any
            array.
    """

    def __init__(
        self,
        dtype: DTypeLike,
        row: tuple[int, ...] = (),
        folder: Path | None = None,
        in_memory: int | None = None,
    ) -> None:
        self._dtype, self._row, self._folder = np.dtype(dtype), row, folder
        self._limit = arrays.MAX_BYTES_IN_MEMORY if in_memory is None else in_memory
        self._due = self._limit  # bytes in memory beyond which they are written
        # in memory, as bytes: arrays of structures take long to join; the first ones are large
        self._parts: list[NDArray[np.uint8]] = []
        self._large = 0
        self._bytes = 0
        self._length, self._written = 0, 0  # rows
        self._file: IO[bytes] | None = None
        self._is_closed = False

    def __len__(self) -> int:
        return self._length

    @property
    def memory_bytes(self) -> int:
        """Of the rows that are not in the file."""
        return self._bytes

    def append(self, rows: Array) -> None:
        """Append a copy of rows (n, *row).

        Raises:
            OSError: the disk is full; the rows are kept in memory, and written with later ones.
            ValueError: the rows have another shape, or the builder is closed.
        """
        self._require_open()
        rows = np.array(rows, self._dtype, order="C", ndmin=1)
        if rows.shape[1:] != self._row:
            raise ValueError(f"rows: expected (n, *{self._row}), got {rows.shape}")
        if not len(rows):
            return
        self._length += len(rows)
        self._parts.append(rows.reshape(-1).view(np.uint8))
        self._bytes += rows.nbytes
        if len(self._parts) - self._large >= _SMALL_PARTS:
            self._join_from(self._large)
        if self._bytes > self._due:
            self.write()

    def write(self) -> None:
        """Write the rows that are in memory, unless they are so few that no file was begun.

        Raises:
            OSError: the disk is full; nothing has changed.
        """
        if not self._parts or (self._file is None and self._bytes <= self._limit):
            return
        if self._bytes <= _WRITTEN_AT_ONCE:
            self._join_from(0)
        try:
            self._write_parts()
        except OSError:
            self._due = 2 * self._bytes  # not at once again
            if self._file is not None:
                with suppress(OSError):
                    os.ftruncate(self._file.fileno(), self._written * self._row_bytes)
            raise
        self._written = self._length
        self._parts, self._large, self._bytes = [], 0, 0
        self._due = min(self._limit, _WRITTEN_AT_ONCE)

    def _write_parts(self) -> None:
        if self._file is None:
            self._file = arrays.open_unlinked(self._folder)
        # past the buffer, which could not be emptied on a full disk; over what an earlier attempt
        # has left there
        at = self._written * self._row_bytes
        for part in self._parts:
            left = part.data
            while len(left):
                count = os.pwrite(self._file.fileno(), left, at)
                at, left = at + count, left[count:]

    def _join_from(self, first: int) -> None:
        """Make the parts from `first` on one: many small ones would take long to write."""
        if len(self._parts) - first > 1:
            self._parts[first:] = [np.concatenate(self._parts[first:])]
        self._large = len(self._parts)

    @property
    def _row_bytes(self) -> int:
        return self._dtype.itemsize * int(np.prod(self._row, dtype=np.int64))

    @property
    def written(self) -> int:
        """Number of rows in the file; those behind them are in memory."""
        return self._written

    def select_last(self, kept: NDArray[np.bool_]) -> None:
        """Drop some of the last rows; the others are in memory then. Not while a view of them that
        is memory-mapped is in use.

        Args:
            kept: (n,) of the last n rows, those that stay.
        """
        first = self._length - len(kept)
        if first < self._written:
            again = np.array(self.parts()[0][first:])
            self._parts.insert(0, again.reshape(-1).view(np.uint8))
            self._written = first
        self._join_from(0)
        if not self._parts:
            return
        rows = self._parts[0].reshape(-1, self._row_bytes)
        at = first - self._written
        self._parts = [np.concatenate([rows[:at], rows[at:][kept]]).reshape(-1)]
        self._length, self._bytes = first + int(kept.sum()), self._parts[0].nbytes

    def close(self) -> None:
        """Close the file, if there is one; arrays that were mapped stay as they are."""
        self._parts, self._bytes, self._is_closed = [], 0, True
        if self._file is not None:
            self._file.close()

    def parts(self) -> list[Array]:
        """The array so far as at least one part: what is in the file, mapped, and what is in
        memory; all read-only. Nothing is written, and more may be appended."""
        self._require_open()
        self._join_from(0)
        found = list[Array]()
        if self._file is not None and self._written:
            shape = (self._written, *self._row)
            found.append(arrays.map_file(self._file, shape, self._dtype, writable=False))
        for part in self._parts:
            part.flags.writeable = False
            found.append(part.view(self._dtype).reshape(-1, *self._row))
        return found or [np.empty((0, *self._row), self._dtype)]

    def files(self) -> list[IO[bytes] | None]:
        """The file that holds each of `parts` from its begin; None: it is in memory."""
        in_file: list[IO[bytes] | None] = [self._file] if self._written else []
        return in_file + [None] * len(self._parts) or [None]

    def row(self, at: int) -> Any:
        """Row `at`, copied: of the last ones without reading the file."""
        self._require_open()
        first = self._length
        for part in reversed(self._parts):
            first -= len(part) // self._row_bytes
            if at >= first:
                return part.view(self._dtype).reshape(-1, *self._row)[at - first].copy()
        return self.parts()[0][at].copy()

    def view(self) -> Array:
        """The array (N, *row) so far, read-only where it is memory-mapped; more may be appended.
        Where the disk is full, a copy in memory."""
        self._require_open()
        with suppress(OSError):
            self.write()
        parts = self.parts()
        return parts[0] if self._written == self._length > 0 else np.concatenate(parts)

    def _require_open(self) -> None:
        if self._is_closed:
            raise ValueError("array: expected a builder that is not closed")

    def finish(self) -> Array:
        """The array (N, *row), read-only where it is memory-mapped. Ends appending.

        Raises:
            OSError: the disk is full.
        """
        self.write()
        out = self.view()
        self.close()
        return out


def append_together(pairs: Iterable[tuple[ArrayBuilder, Array]]) -> None:
    """Append rows to several arrays, to all of them even if the disk is full.

    Raises:
        OSError: the disk is full; see `ArrayBuilder.append`.
    """
    failure = None
    for array, rows in pairs:
        try:
            array.append(rows)
        except OSError as error:
            failure = error
    if failure is not None:
        raise failure
