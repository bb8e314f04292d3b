"""Arrays that grow by appending, in unlinked temporary files where they are large.

The files are written, not mapped, while they grow, so that a full disk is an OSError and no crash.
"""

import os
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core import arrays

Array = NDArray[Any]

_WRITTEN_AT_ONCE = 1 << 20  # bytes at most in memory, once there is a file
_SMALL_PARTS = 256  # appended rows that become one array


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
        # in memory, as bytes: arrays of structures take long to join; the first ones are large
        self._parts: list[NDArray[np.uint8]] = []
        self._large, self._bytes, self._length = 0, 0, 0
        self._file: IO[bytes] | None = None
        self._is_closed = False

    def __len__(self) -> int:
        return self._length

    def append(self, rows: Array) -> None:
        """Append a copy of rows (n, *row).

        Raises:
            OSError: the disk is full.
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
            self._parts[self._large :] = [np.concatenate(self._parts[self._large :])]
            self._large = len(self._parts)
        limit = arrays.MAX_BYTES_IN_MEMORY
        if self._bytes > (limit if self._file is None else min(limit, _WRITTEN_AT_ONCE)):
            self._write()

    def _write(self) -> None:
        """Write the rows that are in memory."""
        if self._file is None:
            self._file = arrays.open_unlinked(self._folder)
        for part in self._parts:
            left = part.data
            while len(left):  # past the buffer, which could not be emptied on a full disk
                left = left[os.write(self._file.fileno(), left) :]
        self._parts, self._large, self._bytes = [], 0, 0

    def close(self) -> None:
        """Close the file, if there is one; arrays that were mapped stay as they are."""
        self._parts, self._bytes, self._is_closed = [], 0, True
        if self._file is not None:
            self._file.close()

    def view(self) -> Array:
        """The array (N, *row) so far, read-only where it is memory-mapped; more may be appended.

        Raises:
            OSError: the disk is full.
        """
        self._require_open()
        shape = (self._length, *self._row)
        if self._file is not None:
            self._write()
            return arrays.map_file(self._file, shape, self._dtype, writable=False)
        joined = np.concatenate([np.empty(0, np.uint8), *self._parts])
        return joined.view(self._dtype).reshape(shape)

    def _require_open(self) -> None:
        if self._is_closed:
            raise ValueError("array: expected a builder that is not closed")

    def finish(self) -> Array:
        """The array (N, *row), read-only where it is memory-mapped. Ends appending.

        Raises:
            OSError: the disk is full.
        """
        out = self.view()
        self.close()
        return out
