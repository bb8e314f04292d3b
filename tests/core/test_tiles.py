"""Arrays of which only the tiles that hold something are stored."""

import numpy as np
import pytest

from stillmap.core import tiles
from stillmap.core.tiles import TILE, TiledArray

SHAPE = (2 * TILE + 30, 3 * TILE + 7)


@pytest.fixture
def pair(tmp_path):
    """A tiled array and the plain one."""
    rng = np.random.default_rng(0)
    whole = np.full(SHAPE, np.nan, np.float32)
    tiled = TiledArray(SHAPE, np.float32, np.nan, tmp_path)
    row, column = rng.integers(0, SHAPE[0], 500), rng.integers(0, TILE, 500)
    value = rng.random(500).astype(np.float32)
    _, once = np.unique(row * SHAPE[1] + column, return_index=True)
    row, column = row[once], column[once]
    tiled.put(row, column, value[: len(row)])
    whole[row, column] = value[: len(row)]
    last = rng.random((30, 7)).astype(np.float32)
    tiled.set_tile(2, 3, last)
    whole[2 * TILE :, 3 * TILE :] = last
    return tiled, whole


def test_numpy_takes_it_for_an_array(pair):
    tiled, whole = pair
    np.testing.assert_array_equal(tiled, whole)
    np.testing.assert_array_equal(np.isnan(tiled), np.isnan(whole))
    np.testing.assert_array_equal(tiled > 0.5, whole > 0.5)
    np.testing.assert_array_equal(1 - tiled, 1 - whole)
    np.testing.assert_array_equal(tiled[::-1, 5], whole[::-1, 5])
    assert (tiled.shape, tiled.size, len(tiled)) == (whole.shape, whole.size, len(whole))
    assert tiled.tobytes() == whole.tobytes()


def test_only_tiles_with_values_are_stored(pair):
    tiled, whole = pair
    assert tiled.numbers() == {(0, 0), (1, 0), (2, 0), (2, 3)}
    stored = np.full_like(whole, np.nan)
    for block, tile in tiled.tiles():
        stored[block] = tile
    np.testing.assert_array_equal(stored, whole)


def test_parts(pair):
    tiled, whole = pair
    np.testing.assert_array_equal(np.concatenate(list(tiled.iter_rows())), whole)
    rng = np.random.default_rng(1)
    for _ in range(30):
        (r0, r1), (c0, c1) = (np.sort(rng.integers(0, n + 1, 2)) for n in SHAPE)
        block = slice(int(r0), int(r1)), slice(int(c0), int(c1))
        np.testing.assert_array_equal(tiled.crop(block), whole[block])
        np.testing.assert_array_equal(tiles.crop(whole, block), whole[block])
    row, column = rng.integers(0, SHAPE[0], 99), rng.integers(0, SHAPE[1], 99)
    np.testing.assert_array_equal(tiled.take(row, column), whole[row, column])


def test_functions_of_every_element(pair):
    tiled, whole = pair
    assert tiled.astype(np.float32) is tiled
    exact = tiled.astype(np.float64)
    assert exact.dtype == np.float64
    np.testing.assert_array_equal(exact, whole)


def test_large_ones_lie_in_files(monkeypatch, tmp_path):
    monkeypatch.setattr(tiles, "MAX_DENSE_BYTES", 3 * 4 * TILE**2)
    tiled = TiledArray((9 * TILE, TILE), np.float32, 0.0, tmp_path)
    for i in range(9):
        tiled.set_tile(i, 0, np.full((TILE, TILE), i + 1.0))
        tiled.release()
    assert [float(tile[0, 0]) for _, tile in tiled.tiles()] == list(range(1, 10))
    assert tiles.compact(tiled) is tiled
    small = TiledArray((5, 5), np.float32, 0.0)
    assert isinstance(tiles.compact(small), np.ndarray)
    assert not list(tmp_path.glob("stillmap-*"))  # unnamed


def test_tiles_around_squares():
    lowest = np.array([[0, 0], [TILE - 10, 0], [-20, 5], [3 * TILE, 3], [0, 2 * TILE + 20]])
    found = tiles.tiles_around(lowest, 32, SHAPE)
    assert found == [(0, 0), (0, 1), (0, 3), (2, 0)]
    assert tiles.tiles_around(np.zeros((0, 2), np.int64), 32, SHAPE) == []
