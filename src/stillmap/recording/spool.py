"""Arrays that may be larger than memory: in memory while small, else in a file without a name.

Such a file has no entry in any folder: it is gone when the last array on it is, even if the
process is killed. What is written to it is written, not mapped, so that a full disk is an error
and no crash.
"""

import mmap
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

IN_MEMORY = 32 << 20  # bytes of one array that are kept in memory
BLOCK = 1 << 20  # rows that are looked at together
TOGETHER = 500  # items, as large as a planar scan, that are looked at before they are let go

_Item = TypeVar("_Item")

_BUFFER = 1 << 20  # bytes that are written to a file together: parts may be as small as one scan


class Column:
    """An array that grows at its end.

    Args:
        dtype: of its elements.
        row: shape of what stands at one index, () for numbers.
        folder: where the file goes; None: the system's temporary folder.
    """

    def __init__(
        self, dtype: DTypeLike, row: tuple[int, ...] = (), folder: Path | None = None
    ) -> None:
        self._dtype, self._row, self._folder = np.dtype(dtype), row, folder
        self._parts: list[NDArray[Any]] = []
        self._bytes = 0
        self._length = 0
        self._file: Any = None

    def __len__(self) -> int:
        return self._length

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows (n, *row); they are copied.

        Raises:
            OSError: the disk is full.
        """
        rows = np.array(rows, self._dtype, order="C", ndmin=1)
        if rows.shape[1:] != self._row:
            raise ValueError(f"rows: expected (n, *{self._row}), got {rows.shape}")
        self._length += len(rows)
        self._parts.append(rows)
        self._bytes += rows.nbytes
        if self._bytes > (IN_MEMORY if self._file is None else min(IN_MEMORY, _BUFFER)):
            self._write()

    def _write(self) -> None:
        if self._file is None:
            self._file = _nameless(self._folder)
        for part in self._parts:
            self._file.write(part.reshape(-1).view(np.uint8).data)
        self._parts, self._bytes = [], 0

    def finished(self) -> NDArray[Any]:
        """The whole array (N, *row), read-only where it lies in a file. Nothing can be added."""
        shape = (self._length, *self._row)
        if self._file is None:
            parts, self._parts = self._parts, []
            return np.concatenate(parts) if parts else np.empty(shape, self._dtype)
        self._write()
        self._file.flush()
        with self._file as file:
            return _mapped(file, shape, self._dtype, writable=False)


def empty(shape: tuple[int, ...], dtype: DTypeLike, folder: Path | None = None) -> NDArray[Any]:
    """A new array to write to, its content not defined; in a file where it is large.

    Raises:
        OSError: the disk is full.
    """
    dtype = np.dtype(dtype)
    size = int(np.prod(shape, dtype=object)) * dtype.itemsize
    if size <= IN_MEMORY:
        return np.empty(shape, dtype)
    with _nameless(folder) as file:
        # all of it now: a hole that no longer fits on the disk would kill the process
        os.posix_fallocate(file.fileno(), 0, size)
        return _mapped(file, shape, dtype, writable=True)


def let_go(array: NDArray[Any]) -> None:
    """What of a mapped array lies in memory may go; it is read again where it is used again."""
    base: object = array
    while isinstance(base, np.ndarray | memoryview):
        if isinstance(base, np.memmap) and base.mode == "c":
            return  # changes that are in memory alone would be lost
        base = base.base if isinstance(base, np.ndarray) else base.obj
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)


def blocks(*arrays: NDArray[Any], rows: int | None = None) -> Iterator[slice]:
    """Slices of so many rows (BLOCK), of arrays of one length; what was looked at is let go."""
    rows = rows or BLOCK
    for first in range(0, len(arrays[0]), rows):
        yield slice(first, min(first + rows, len(arrays[0])))
        for array in arrays:
            let_go(array)


def near(numbers: NDArray[np.intp], rows: int) -> Iterator[slice]:
    """Slices of rising numbers (n,) of rows, so many at most, of which all are of one BLOCK.

    Few rows from all over a file bring nearly all of it into memory.
    """
    cuts = np.flatnonzero(np.diff(numbers // BLOCK)) + 1
    for first, stop in pairwise([0, *cuts.tolist(), len(numbers)]):
        for at in range(first, stop, rows):
            yield slice(at, min(at + rows, stop))


def rows_of(array: NDArray[Any], numbers: NDArray[np.intp]) -> NDArray[Any]:
    """(n, *row) some rows, by rising numbers (n,); what was looked at is let go on the way."""
    out = np.empty((len(numbers), *array.shape[1:]), array.dtype)
    for part in near(numbers, BLOCK):
        out[part] = array[numbers[part]]
        let_go(array)
    return out


def in_turn(
    items: Iterable[_Item], let_go: Callable[[], None], rows: float = 0.0
) -> Iterator[_Item]:
    """The same items; on the way what was looked at for them is let go now and then.

    `rows` says how many rows of the arrays an item takes, about: of large ones fewer are looked at.
    """
    together = max(min(TOGETHER, int(BLOCK / max(rows, 1.0))), 1)
    for n, item in enumerate(items):
        if n % together == 0:
            let_go()
        yield item
    let_go()


def copied(array: NDArray[Any], folder: Path | None = None) -> NDArray[Any]:
    """A copy to write to, in a file where it is large."""
    out = empty(array.shape, array.dtype, folder)
    for block in blocks(array, out):
        out[block] = array[block]
    return out


def _nameless(folder: Path | None) -> Any:
    return tempfile.TemporaryFile(buffering=_BUFFER, prefix="stillmap-", dir=folder)


def _mapped(
    file: Any, shape: tuple[int, ...], dtype: np.dtype[Any], writable: bool
) -> NDArray[Any]:
    access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
    mapped: NDArray[Any] = np.frombuffer(mmap.mmap(file.fileno(), 0, access=access), dtype)
    return mapped.reshape(shape)
