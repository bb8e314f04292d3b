"""Arrays that may be larger than memory: in memory while small, else in a file without a name.

Such a file has no entry in any folder: it is gone when the last array on it is, even if the
process is killed. What is written to it is written, not mapped, so that a full disk is an error
and no crash.

Arrays in `.npy` files, as they lie on the disk.

Arrays as `.npy` files, whatever their size.

Plain arrays of points (N, D), and of whole numbers for them.
"""

import mmap
import os
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core.errors import InputError
from stillmap.core.files import require_regular


def write_npz(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays by their names. Equal ones give equal bytes: the archive's dates are fixed."""
    # most cells of most maps are alike: a tenth of the size, and quicker than writing them all;
    # beyond level 1 it takes three times as long for a few percent
    with path.open("wb") as whole:
        archive = zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        try:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, array, allow_pickle=False)
        except BaseException:
            # closing an archive fails while an array is half open, and would hide why
            archive.fp = None
            raise
        archive.close()


MAX_BYTES_IN_MEMORY = 32 << 20  # bytes of one array that are kept in memory

BLOCK = 1 << 20  # rows that are looked at together

ITEMS_PER_RELEASE = (
    500  # items, as large as a planar scan, that are looked at before they are let go
)

_Item = TypeVar("_Item")

_BUFFER = 1 << 20  # bytes that are written to a file together: parts may be as small as one scan


class ArrayBuilder:
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
        if self._bytes > (
            MAX_BYTES_IN_MEMORY if self._file is None else min(MAX_BYTES_IN_MEMORY, _BUFFER)
        ):
            self._write()

    def _write(self) -> None:
        if self._file is None:
            self._file = _nameless(self._folder)
        for part in self._parts:
            self._file.write(part.reshape(-1).view(np.uint8).data)
        self._parts, self._bytes = [], 0

    def finish(self) -> NDArray[Any]:
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
    if size <= MAX_BYTES_IN_MEMORY:
        return np.empty(shape, dtype)
    with _nameless(folder) as file:
        # all of it now: a hole that no longer fits on the disk would kill the process
        os.posix_fallocate(file.fileno(), 0, size)
        return _mapped(file, shape, dtype, writable=True)


def release_pages(array: NDArray[Any]) -> None:
    """What of a mapped array lies in memory may go; it is read again where it is used again."""
    base: object = array
    while isinstance(base, np.ndarray | memoryview):
        if isinstance(base, np.memmap) and base.mode == "c":
            return  # changes that are in memory alone would be lost
        base = base.base if isinstance(base, np.ndarray) else base.obj
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)


def iter_blocks(*arrays: NDArray[Any], rows: int | None = None) -> Iterator[slice]:
    """Slices of so many rows (BLOCK), of arrays of one length; what was looked at is let go."""
    rows = rows or BLOCK
    for first in range(0, len(arrays[0]), rows):
        yield slice(first, min(first + rows, len(arrays[0])))
        for array in arrays:
            release_pages(array)


def split_by_block(numbers: NDArray[np.intp], rows: int) -> Iterator[slice]:
    """Slices of rising numbers (n,) of rows, so many at most, of which all are of one BLOCK.

    Few rows from all over a file bring nearly all of it into memory.
    """
    cuts = np.flatnonzero(np.diff(numbers // BLOCK)) + 1
    for first, stop in pairwise([0, *cuts.tolist(), len(numbers)]):
        for at in range(first, stop, rows):
            yield slice(at, min(at + rows, stop))


def take_rows(array: NDArray[Any], numbers: NDArray[np.intp]) -> NDArray[Any]:
    """(n, *row) some rows, by rising numbers (n,); what was looked at is let go on the way."""
    out = np.empty((len(numbers), *array.shape[1:]), array.dtype)
    for part in split_by_block(numbers, BLOCK):
        out[part] = array[numbers[part]]
        release_pages(array)
    return out


def release_periodically(
    items: Iterable[_Item], release: Callable[[], None], rows: float = 0.0
) -> Iterator[_Item]:
    """The same items; on the way what was looked at for them is let go now and then.

    `rows` says how many rows of the arrays an item takes, about: of large ones fewer are looked at.
    """
    together = max(min(ITEMS_PER_RELEASE, int(BLOCK / max(rows, 1.0))), 1)
    for n, item in enumerate(items):
        if n % together == 0:
            release()
        yield item
    release()


def copy(array: NDArray[Any], folder: Path | None = None) -> NDArray[Any]:
    """A copy to write to, in a file where it is large."""
    out = empty(array.shape, array.dtype, folder)
    for block in iter_blocks(array, out):
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


def open_npy(path: Path) -> NDArray[Any]:
    """The array of a file, read-only and not in memory until it is used.

    Raises:
        InputError: it is missing, damaged, or holds Python objects.
    """
    require_regular(path)
    try:
        with warnings.catch_warnings():
            # of headers that Python 2 wrote, or that are damaged
            warnings.simplefilter("ignore")
            # np.load would also open archives and pickles that bear the name
            loaded: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", where=str(path)) from error
    except Exception as error:  # whatever NumPy's parser makes of damaged bytes
        raise InputError(f"is damaged: {error}", where=str(path)) from error
    return loaded


def write_npy(path: Path, array: NDArray[Any]) -> None:
    """What np.save writes; of an array in a file no more than a part is in memory at a time."""
    header = np.lib.format.header_data_from_array_1_0(np.empty((0, *array.shape[1:]), array.dtype))
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {**header, "shape": array.shape})
        for block in iter_blocks(array):
            file.write(np.ascontiguousarray(array[block]).reshape(-1).view(np.uint8).data)


def finite_rows(points: NDArray[Any]) -> NDArray[np.bool_]:
    """(N,) whether every coordinate of points (N, D) is finite.

    Column by column: `all` over rows of two or three takes ten times as long.
    """
    out = np.asarray(np.isfinite(points[:, 0]))
    for column in points.T[1:]:
        out &= np.isfinite(column)
    return out


def first_index_per_group(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each group occurs first, by rising groups: `np.unique(..., return_index=True)[1]`.

    Args:
        group: (N,) not negative; below 2^62 / N.
    """
    bits = max(len(group) - 1, 1).bit_length()
    key = np.sort((group << bits) | np.arange(len(group)))  # faster than any sort of indices
    return key[np.diff(key >> bits, prepend=-1) > 0] & ((1 << bits) - 1)
