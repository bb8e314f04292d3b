"""Arrays that grow by rows in `.npy` files, which can be read at any time."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.arrays import open_unlinked

Array = NDArray[Any]


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
        self._file = open_unlinked(scratch) if path is None else path.open("w+b", buffering=0)
        self._write_header()
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
        left = rows.reshape(-1).view(np.uint8).data
        while len(left):
            count = os.pwrite(self._file.fileno(), left, at)
            at, left = at + count, left[count:]
        self._length += len(rows)

    def truncate(self, length: int) -> None:
        """Keep the first rows alone."""
        self._length = length
        with suppress(OSError):
            os.ftruncate(self._file.fileno(), self._begin + length * self._row_bytes)

    def row(self, at: int) -> Any:
        """Row `at`, copied."""
        data = os.pread(self._file.fileno(), self._row_bytes, self._begin + at * self._row_bytes)
        return np.frombuffer(data, self.dtype).reshape(self._row)[()]

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
        self._write_header()

    def close(self) -> None:
        """Close the file; views stay as they are."""
        self._file.close()

    def _write_header(self) -> None:
        # NumPy leaves room in it for a longer array
        empty = np.lib.format.header_data_from_array_1_0(np.empty((0, *self._row), self.dtype))
        header = {**empty, "shape": (self._length, *self._row)}
        np.lib.format.write_array_header_1_0(self._file, header)
        self._file.flush()
