"""Memory-mapped buffers for arrays larger than memory, `.npy` and `.npz` files, array helpers.

Large arrays lie in unlinked temporary files, which vanish with the process even if it is killed.
"""

import mmap
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray


def write_npz(path: Path, arrays: Mapping[str, "Writable"]) -> None:
    """Write named arrays. Equal arrays give equal files: dates in the archive are fixed."""
    # maps compress to a tenth; levels above 1 take three times as long for a few percent
    with path.open("wb") as whole:
        archive = zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        try:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    _write_array(file, array)
        except BaseException:
            archive.fp = None  # close() would fail on the half-written array and hide the error
            raise
        archive.close()


def _write_array(file: Any, array: "Writable") -> None:
    """Write a `.npy` file; an array that is stored in parts, part by part."""
    if isinstance(array, np.ndarray):
        np.lib.format.write_array(file, array, allow_pickle=False)
        return
    write_header(file, array.shape, array.dtype)
    for rows in array.iter_rows():
        file.write(rows.reshape(-1).view(np.uint8).data)


def write_header(file: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Write the header of a `.npy` file, in which NumPy leaves room for a longer array."""
    header = np.lib.format.header_data_from_array_1_0(np.empty((0,) * len(shape), dtype))
    np.lib.format.write_array_header_1_0(file, {**header, "shape": shape})


class RowSource(Protocol):
    """An array that yields its elements as strips of rows."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> np.dtype[Any]: ...

    def iter_rows(self) -> Iterator[NDArray[Any]]: ...


Writable = NDArray[Any] | RowSource

MAX_BYTES_IN_MEMORY = 32 << 20  # of one array; larger ones lie in a file
BLOCK = 1 << 20  # rows processed at once
_SAMPLE_SEED = 1
ITEMS_PER_RELEASE = 500  # items of the size of a 2D scan between two releases of pages

_Item = TypeVar("_Item")


def empty(shape: tuple[int, ...], dtype: DTypeLike, folder: Path | None = None) -> NDArray[Any]:
    """Allocate an uninitialized array, memory-mapped where it is large.

    Raises:
        OSError: the disk is full.
    """
    dtype = np.dtype(dtype)
    size = int(np.prod(shape, dtype=object)) * dtype.itemsize
    if size <= MAX_BYTES_IN_MEMORY:
        return np.empty(shape, dtype)
    with open_unlinked(folder) as file:
        # a hole that no longer fits on the disk would kill the process by SIGBUS
        os.posix_fallocate(file.fileno(), 0, size)
        return np.frombuffer(mmap.mmap(file.fileno(), size), dtype).reshape(shape)


def release_pages(array: NDArray[Any]) -> None:
    """Release the resident pages of a memory-mapped array; they are read again on access."""
    base: object = array
    while isinstance(base, np.ndarray | memoryview):
        if isinstance(base, np.memmap) and base.mode == "c":
            return  # copy-on-write: changes would be lost
        base = base.base if isinstance(base, np.ndarray) else base.obj
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)


def iter_blocks(*arrays: NDArray[Any], rows: int | None = None) -> Iterator[slice]:
    """Yield slices of `rows` rows (BLOCK) of arrays of equal length; release their pages."""
    rows = rows or BLOCK
    for first in range(0, len(arrays[0]), rows):
        yield slice(first, min(first + rows, len(arrays[0])))
        for array in arrays:
            release_pages(array)


def split_by_block(indices: NDArray[np.intp], rows: int) -> Iterator[slice]:
    """Yield slices of ascending row indices (n,), at most `rows` long, each within one BLOCK.

    Sparse rows from a whole file would map nearly all of it.
    """
    cuts = np.flatnonzero(np.diff(indices // BLOCK)) + 1
    for first, stop in pairwise([0, *cuts.tolist(), len(indices)]):
        for start in range(first, stop, rows):
            yield slice(start, min(start + rows, stop))


def take_rows(array: NDArray[Any], indices: NDArray[np.intp]) -> NDArray[Any]:
    """Copy rows (n, *row) at ascending indices (n,), releasing pages on the way."""
    out = np.empty((len(indices), *array.shape[1:]), array.dtype)
    for part in split_by_block(indices, BLOCK):
        out[part] = array.take(indices[part], axis=0)  # faster than an index where rows are short
        release_pages(array)
    return out


def release_periodically(
    items: Iterable[_Item], release: Callable[[], None], rows: float = 0.0
) -> Iterator[_Item]:
    """Yield the items, calling `release` every few items and at the end.

    `rows` is the mean count of array rows per item: large items are released more often.
    """
    step = max(min(ITEMS_PER_RELEASE, int(BLOCK / max(rows, 1.0))), 1)
    for n, item in enumerate(items):
        if n % step == 0:
            release()
        yield item
    release()


def copy(array: NDArray[Any], folder: Path | None = None) -> NDArray[Any]:
    """A writable copy, memory-mapped where it is large."""
    out = empty(array.shape, array.dtype, folder)
    for block in iter_blocks(array, out):
        out[block] = array[block]
    return out


def open_unlinked(folder: Path | None) -> IO[bytes]:
    """A new file without a name in a folder; in the system's for temporary files if it is gone.

    Raises:
        OSError: no file can be made there.
    """
    folder = folder if folder is not None and folder.is_dir() else Path(tempfile.gettempdir())
    try:
        flags = os.O_RDWR | os.O_TMPFILE | os.O_CLOEXEC
        return os.fdopen(os.open(folder, flags, 0o600), "w+b")
    except (AttributeError, OSError):  # the system, or the file system, has none such
        return cast(IO[bytes], tempfile.TemporaryFile(prefix="stillmap-", dir=folder))


def write_npy(path: Path, array: NDArray[Any]) -> None:
    """Write the same file as np.save, block by block.

    `np.save` and `ndarray.tofile` do not notice that a disk is full.
    """
    with path.open("wb") as file:
        write_header(file, array.shape, array.dtype)
        for part in iter_bytes(array):
            file.write(part)


def iter_bytes(array: NDArray[Any]) -> Iterator[memoryview]:
    """Yield the bytes of an array in C order, block by block."""
    for block in iter_blocks(array):
        yield np.ascontiguousarray(array[block]).reshape(-1).view(np.uint8).data


def finite_rows(points: NDArray[Any]) -> NDArray[np.bool_]:
    """(N,) mask of points (N, D) with finite coordinates.

    Column by column: `all(axis=1)` takes ten times as long.
    """
    out = np.asarray(np.isfinite(points[:, 0]))
    for column in points.T[1:]:
        out &= np.isfinite(column)
    return out


def squared_lengths(points: NDArray[Any]) -> NDArray[np.float64]:
    """(N,) squared lengths of points (N, D); column by column, as `finite_rows`."""
    out = np.zeros(len(points))
    for column in points.T:
        out += np.square(column, dtype=np.float64)
    return out


def sample_indices(count: int, max_count: int) -> NDArray[np.int64]:
    """Sorted indices (min(count, max_count),) below `count`: a stratified random sample.

    Regular steps would show only some rings of a lidar that fires them in turn. Deterministic.
    """
    if count <= max_count:
        return np.arange(count)
    at = np.arange(max_count) + np.random.default_rng(_SAMPLE_SEED).random(max_count)
    return np.minimum((at * (count / max_count)).astype(np.int64), count - 1)


def expand_ranges(
    first: NDArray[np.intp], count: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The range that each number is of, and the numbers themselves, of n ranges of integers.

    Args:
        first: (n,) their first numbers.
        count: (n,) how many follow each other.
    """
    of = np.repeat(np.arange(len(count)), count)
    return of, np.arange(len(of)) + np.repeat(first - np.cumsum(count) + count, count)


def unique_cells(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """`np.unique` of the rows of cells (n, D) and their inverse (n,); faster, as it sorts numbers.

    Returns:
        (m, D) different cells, by the first coordinate, then the next; (n,) which each one is.
    """
    if not len(cells):
        return cells, np.zeros(0, np.intp)
    low = cells.min(axis=0)
    shape = (cells.max(axis=0) - low + 1).tolist()
    flat, of = np.unique(np.ravel_multi_index(tuple((cells - low).T), shape), return_inverse=True)
    return np.stack(np.unravel_index(flat, shape), axis=1) + low, of.reshape(-1)
