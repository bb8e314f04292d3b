"""Large, mostly empty rectangles of cells, of which only the tiles that hold something are stored.

A robot that drives a kilometre sees a strip, but the box around it is most of a square kilometre.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import DTypeLike, NDArray

from stillmap.core import arrays
from stillmap.core.array_types import Index

TILE = 256  # cells, edge of a tile
# of a layer: a map has ten of them, and buildings leave most of the box around them empty
MAX_DENSE_BYTES = 8 << 20
_BYTES_IN_MEMORY = 4 << 20  # of the tiles of a layer that as a whole is too large for memory
TILES_PER_RELEASE = 16  # that are used between two releases of pages
_TILES_PER_FILE = 256  # that share a memory-mapped file: 64 MB of float32

Block = tuple[slice, slice]  # rows and columns


class TiledArray(NDArrayOperatorsMixin):
    """An (H, W) array that stores only tiles which differ from a fill value.

    To NumPy it is an array like any other: operators, functions and indexing make the whole array.
    What has to run on large maps goes by `tiles`, `crop` or `iter_rows` instead. Where the whole
    array exceeds `MAX_DENSE_BYTES`, tiles are memory-mapped, and `release` frees their
    pages.

    Args:
        shape: rows and columns.
        dtype: of the elements.
        fill: value of all elements that are not set.
        scratch: folder of the temporary files; None: the system's.
    """

    def __init__(
        self, shape: tuple[int, int], dtype: DTypeLike, fill: float, scratch: Path | None = None
    ) -> None:
        self.shape, self.dtype, self.fill = shape, np.dtype(dtype), fill
        self.ndim, self.size = 2, shape[0] * shape[1]
        self._scratch = scratch
        self._tiles: dict[tuple[int, int], NDArray[Any]] = {}
        self._files: list[NDArray[Any]] = []  # memory-mapped, of several tiles each
        self._free = 0  # tiles of the last one

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        whole = self.crop((slice(0, self.shape[0]), slice(0, self.shape[1])))
        return whole if dtype is None else whole.astype(dtype, copy=bool(copy))

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        made = (np.asarray(item) if isinstance(item, TiledArray) else item for item in inputs)
        return getattr(function, method)(*made, **options)

    def __getitem__(self, key: Any) -> Any:
        return np.asarray(self)[key]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)

    def tiles(self) -> Iterator[tuple[Block, NDArray[Any]]]:
        """The stored tiles, which may be changed, by rows: where they lie, and their elements."""
        for k, (i, j) in enumerate(sorted(self._tiles)):
            yield self._block(i, j), self._tiles[i, j]
            if k % TILES_PER_RELEASE == 0:
                self.release()
        self.release()

    def numbers(self) -> set[tuple[int, int]]:
        """Rows and columns of the stored tiles."""
        return set(self._tiles)

    def set_tile(self, i: int, j: int, values: NDArray[Any]) -> None:
        """Store a tile: row and column of the tile, and its elements."""
        self._add(i, j)[...] = values

    def crop(self, block: Block) -> NDArray[Any]:
        """A dense copy of the elements of a block."""
        rows, columns = block
        out = np.full((rows.stop - rows.start, columns.stop - columns.start), self.fill, self.dtype)
        for i in range(rows.start // TILE, -(-rows.stop // TILE)):
            for j in range(columns.start // TILE, -(-columns.stop // TILE)):
                tile = self._tiles.get((i, j))
                if tile is None:
                    continue
                low, left = i * TILE, j * TILE
                r = slice(max(rows.start - low, 0), min(rows.stop - low, len(tile)))
                c = slice(max(columns.start - left, 0), min(columns.stop - left, tile.shape[1]))
                out[
                    low + r.start - rows.start : low + r.stop - rows.start,
                    left + c.start - columns.start : left + c.stop - columns.start,
                ] = tile[r, c]
        return out

    def iter_rows(self) -> Iterator[NDArray[Any]]:
        """All elements as dense strips (n, W) of a few rows."""
        for first in range(0, self.shape[0], TILE):
            rows = slice(first, min(first + TILE, self.shape[0]))
            yield self.crop((rows, slice(0, self.shape[1])))
            self.release()

    def take(self, row: Index, column: Index) -> NDArray[Any]:
        """(n,) elements at rows and columns (n,)."""
        out = np.full(len(row), self.fill, self.dtype)
        for k, ((i, j), some) in enumerate(_by_tile(row, column)):
            if k % TILES_PER_RELEASE == 0:
                self.release()
            if (i, j) in self._tiles:
                out[some] = self._tiles[i, j][row[some] - i * TILE, column[some] - j * TILE]
        return out

    def put(self, row: Index, column: Index, values: NDArray[Any]) -> None:
        """Set the elements at rows and columns (n,) to values (n,)."""
        for k, ((i, j), some) in enumerate(_by_tile(row, column)):
            if k % TILES_PER_RELEASE == 0:
                self.release()
            self._add(i, j)[row[some] - i * TILE, column[some] - j * TILE] = values[some]

    def astype(self, dtype: DTypeLike, copy: bool = False) -> "TiledArray":  # noqa: ARG002
        """The array with elements of a type, itself where they have it."""
        if self.dtype == dtype:
            return self
        fill = np.asarray(self.fill, self.dtype).astype(dtype).item()
        out = TiledArray(self.shape, dtype, fill, self._scratch)
        for (rows, columns), tile in self.tiles():
            out.set_tile(rows.start // TILE, columns.start // TILE, tile.astype(dtype))
        return out

    def release(self) -> None:
        """Release the resident pages of memory-mapped tiles."""
        for file in self._files:
            arrays.release_pages(file)

    def _block(self, i: int, j: int) -> Block:
        height, width = self.shape
        return (
            slice(i * TILE, min((i + 1) * TILE, height)),
            slice(j * TILE, min((j + 1) * TILE, width)),
        )

    def _add(self, i: int, j: int) -> NDArray[Any]:
        """The tile, added where it is missing."""
        tile = self._tiles.get((i, j))
        if tile is None:
            rows, columns = self._block(i, j)
            height, width = rows.stop - rows.start, columns.stop - columns.start
            tile = self._tiles[i, j] = self._new_tile()[:height, :width]
            tile[...] = self.fill
        return tile

    def _new_tile(self) -> NDArray[Any]:
        """A (TILE, TILE) array, of a file where there are many already."""
        itemsize = self.dtype.itemsize
        small = self.size * itemsize <= MAX_DENSE_BYTES
        if small or len(self._tiles) * TILE**2 * itemsize < _BYTES_IN_MEMORY:
            return np.empty((TILE, TILE), self.dtype)
        if not self._free:
            if self._files:
                arrays.release_pages(self._files[-1])
            shape = (_TILES_PER_FILE, TILE, TILE)
            self._files.append(arrays.empty(shape, self.dtype, self._scratch))
            self._free = _TILES_PER_FILE
        self._free -= 1
        tile: NDArray[Any] = self._files[-1][self._free]
        return tile


Layer = NDArray[Any] | TiledArray
_Element = TypeVar("_Element", bound=np.generic)


def compact(layer: TiledArray) -> Any:
    """A plain array where the whole is small, else the layer itself."""
    if layer.size * layer.dtype.itemsize <= MAX_DENSE_BYTES:
        return np.asarray(layer)
    return layer


def tiles_of(layer: Layer) -> Iterator[tuple[Block, NDArray[Any]]]:
    """The parts of a layer that may differ from its fill value, and where they lie."""
    if isinstance(layer, TiledArray):
        yield from layer.tiles()
    elif layer.size:
        yield (slice(0, layer.shape[0]), slice(0, layer.shape[1])), layer


def rows_of(layer: Layer) -> Iterator[NDArray[Any]]:
    """All elements as dense strips of rows."""
    if isinstance(layer, TiledArray):
        yield from layer.iter_rows()
    elif layer.size:
        yield layer


def crop(layer: Layer, block: Block) -> NDArray[Any]:
    """The elements of a block of any layer, not always a copy."""
    return layer.crop(block) if isinstance(layer, TiledArray) else layer[block]


def cut(layer: Layer, block: Block, scratch: Path | None) -> Any:
    """A copy of the elements of a block, as a layer of its own."""
    if not isinstance(layer, TiledArray):
        return np.array(layer[block])
    rows, columns = block
    shape = rows.stop - rows.start, columns.stop - columns.start
    out = TiledArray(shape, layer.dtype, layer.fill, scratch)
    for i, j in tile_numbers(np.empty(shape, np.bool_)):
        r, c = out._block(i, j)
        r = slice(rows.start + r.start, rows.start + r.stop)
        part = layer.crop((r, slice(columns.start + c.start, columns.start + c.stop)))
        if not np.array_equal(part, np.full_like(part, layer.fill), equal_nan=True):
            out.set_tile(i, j, part)
    return compact(out)


def tile_numbers(layer: Layer) -> set[tuple[int, int]]:
    """Rows and columns of the tiles of a layer that may differ from its fill value."""
    if isinstance(layer, TiledArray):
        return layer.numbers()
    height, width = layer.shape
    return {(i, j) for i in range(-(-height // TILE)) for j in range(-(-width // TILE))}


def release(layer: Layer) -> None:
    """Release the resident pages of memory-mapped tiles."""
    if isinstance(layer, TiledArray):
        layer.release()


def tiles_around(
    lowest: NDArray[np.int64], edge: int, shape: tuple[int, int]
) -> list[tuple[int, int]]:
    """Rows and columns of the tiles that squares of cells overlap.

    Args:
        lowest: (B, 2) column and row of the lowest cell of each square.
        edge: cells.
        shape: of the array; squares may lie outside.
    """
    last_cell = np.array(shape[::-1]) - 1
    first, last = np.maximum(lowest, 0), np.minimum(lowest + edge - 1, last_cell)
    overlap = (first <= last).all(axis=1)
    first, last = first[overlap] // TILE, last[overlap] // TILE
    tiles: set[tuple[int, int]] = set()
    for offset in itertools.product(range(-(-edge // TILE) + 1), repeat=2):
        tile = np.unique(np.minimum(first + np.array(offset), last)[:, ::-1], axis=0)
        tiles.update((int(i), int(j)) for i, j in tile)
    return sorted(tiles)


def _by_tile(row: Index, column: Index) -> Iterator[tuple[tuple[int, int], Index]]:
    """Indices into rows and columns (n,) of the elements of each tile."""
    if not len(row):
        return
    i, j = row // TILE, column // TILE
    order = np.lexsort((j, i))
    starts = np.flatnonzero((np.diff(i[order]) != 0) | (np.diff(j[order]) != 0)) + 1
    for some in np.split(order, starts):
        yield (int(i[some[0]]), int(j[some[0]])), some
