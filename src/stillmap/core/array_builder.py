"""Arrays that grow row by row, beyond memory in a file."""

import os
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core import arrays

Array = NDArray[Any]

_WRITTEN_AT_ONCE = 1 << 20  # bytes at most in memory, once there is a file


class ArrayBuilder:
    """Builds an array by appending rows.

    Args:
        dtype: of the elements.
        row: shape of one row, () for numbers.
        folder: of the temporary file; None: the system's.
    """

    def __init__(
        self, dtype: DTypeLike, row: tuple[int, ...] = (), folder: Path | None = None
    ) -> None:
        self._dtype, self._row, self._folder = np.dtype(dtype), row, folder
        self._buffer, self._length = bytearray(), 0  # of the rows in memory; of all
        self._file: GrowingArray | None = None

    def __len__(self) -> int:
        return self._length

    def append(self, rows: Array) -> None:
        """Append a copy of rows (n, *row).

        Raises:
            OSError: the disk is full.
            ValueError: the rows have another shape.
        """
        rows = np.asarray(rows, self._dtype, order="C")
        if rows.shape[1:] != self._row:
            raise ValueError(f"rows: expected (n, *{self._row}), got {rows.shape}")
        self._length += len(rows)
        self._buffer += rows.reshape(-1).view(np.uint8).data
        limit = arrays.MAX_BYTES_IN_MEMORY
        if len(self._buffer) > (limit if self._file is None else min(limit, _WRITTEN_AT_ONCE)):
            self._write()

    def _write(self) -> None:
        """Write the rows that are in memory."""
        if self._file is None:
            self._file = GrowingArray(self._dtype, self._row, scratch=self._folder)
        length = self._length - len(self._file)
        self._file.append(np.ndarray((length, *self._row), self._dtype, self._buffer))
        self._buffer = bytearray()

    def close(self) -> None:
        """Close the file, if there is one; arrays that were mapped stay as they are."""
        self._buffer = bytearray()
        if self._file is not None:
            self._file.close()

    def view(self) -> Array:
        """The array (N, *row) so far, read-only where it is memory-mapped; more may be appended.

        Raises:
            OSError: the disk is full.
        """
        if self._file is None:
            return np.ndarray((self._length, *self._row), self._dtype, self._buffer[:])
        self._write()
        return self._file.view()

    def finish(self) -> Array:
        """The array (N, *row), read-only where it is memory-mapped. Ends appending.

        Raises:
            OSError: the disk is full.
        """
        out = self.view()
        self.close()
        return out


def _write_at(file: IO[bytes], at: int, content: Any) -> None:
    """Write bytes past the buffer of a file, which could not be emptied on a full disk.

    Raises:
        OSError: the disk is full.
    """
    left = memoryview(content)
    while len(left):
        count = os.pwrite(file.fileno(), left, at)
        at, left = at + count, left[count:]


class GrowingArray:
    """An array in a file that is written, not mapped, while it grows: a full disk is an OSError.

    Args:
        dtype: of the elements.
        row: shape of one row, () for numbers.
        path: the file; None: one without a name, which vanishes with this object.
        scratch: folder of such a file; None: the system's.

    Attributes:
        dtype: of the elements.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(
        self,
        dtype: DTypeLike,
        row: tuple[int, ...] = (),
        path: Path | None = None,
        scratch: Path | None = None,
    ) -> None:
        self.dtype, self._row, self._length = np.dtype(dtype), row, 0
        self._file = (
            arrays.open_unlinked(scratch) if path is None else path.open("w+b", buffering=0)
        )
        arrays.write_header(self._file, (0, *row), self.dtype)
        self._file.flush()
        self._begin = self._file.tell()
        self._row_bytes = self.dtype.itemsize * int(np.prod(row, dtype=np.int64))

    def __len__(self) -> int:
        return self._length

    def append(self, rows: Array) -> None:
        """Append rows (n, *row).

        Raises:
            OSError: the disk is full; a part of them may be in the file until `truncate`.
        """
        rows = np.ascontiguousarray(rows, self.dtype).reshape(-1, *self._row)
        at = self._begin + self._length * self._row_bytes
        _write_at(self._file, at, rows.reshape(-1).view(np.uint8).data)
        self._length += len(rows)

    def truncate(self, length: int) -> None:
        """Keep the first rows alone."""
        self._length = length
        with suppress(OSError):
            os.ftruncate(self._file.fileno(), self._begin + length * self._row_bytes)

    def view(self) -> Array:
        """The array (N, *row) so far, memory-mapped and read-only; more may be appended."""
        shape = (self._length, *self._row)
        if not self._length:
            return np.empty(shape, self.dtype)
        return np.memmap(self._file, self.dtype, "r", self._begin, shape).view(np.ndarray)

    def write_length(self) -> None:
        """Enter the number of rows into the header of the file.

        Raises:
            OSError: the disk is full.
        """
        self._file.seek(0)
        arrays.write_header(self._file, (self._length, *self._row), self.dtype)
        self._file.flush()

    def close(self) -> None:
        """Close the file; views stay as they are."""
        self._file.close()
