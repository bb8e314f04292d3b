"""Memory-mapped buffers, `.npy` files."""

import os
from pathlib import Path

import numpy as np
import pytest

from stillmap.core import arrays
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.source import Source
from stillmap.io import builder
from stillmap.io.builder import RecordingBuilder


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture(params=[0, 1 << 20], ids=["in files", "in memory"])
def limit(request, monkeypatch):
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", request.param)
    return request.param


def test_a_column_is_what_was_added(limit, tmp_path, rng):
    column, parts = ArrayBuilder(np.float32, (3,), tmp_path), []
    for n in (5, 0, 1, 70):
        parts.append(rng.normal(size=(n, 3)).astype(np.float32))
        column.append(parts[-1])
        parts[-1] = parts[-1].copy()
    got = column.finish()
    np.testing.assert_array_equal(got, np.concatenate(parts))
    assert got.dtype == np.float32
    assert got.flags.writeable == (limit > 0)
    arrays.release_pages(got)
    np.testing.assert_array_equal(got, np.concatenate(parts))
    assert list(tmp_path.iterdir()) == []  # a file without a name leaves nothing behind


@pytest.mark.parametrize("block", [4, 1 << 20])
def test_scans_are_put_in_order(limit, tmp_path, rng, monkeypatch, block):  # noqa: ARG001
    monkeypatch.setattr(builder, "_BLOCK", block)
    scans = [rng.normal(size=(n, 3)).astype(np.float32) for n in (4, 0, 9)]
    gathered = RecordingBuilder(3, tmp_path, beam_times=True)
    for stamp, points in zip((30, 10, 20), scans, strict=True):
        gathered.add_scan(stamp, points, beam_time=np.full(len(points), stamp / 100.0))
    found = gathered.build(np.eye(4)[None], source=Source())
    np.testing.assert_array_equal(found.stamp_ns, [10, 20, 30])
    np.testing.assert_array_equal(found.offset, [0, 0, 9, 13])
    np.testing.assert_array_equal(found.points, np.concatenate([scans[2], scans[0]]))
    np.testing.assert_allclose(found.beam_time, [0.2] * 9 + [0.3] * 4)


def resident() -> int:
    """Bytes of this process that lie in memory."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip("no /proc here")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_what_is_let_go_takes_no_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", 0)
    values = arrays.empty((64 << 20,), np.uint8, tmp_path)
    values[:] = 1
    held = resident()
    arrays.release_pages(values[100:].reshape(-1, 4))  # the whole file, whatever is made of it
    assert resident() < held - (48 << 20)
    assert (values == 1).all()


def test_changes_of_a_copy_on_write_stay(tmp_path):
    np.arange(1 << 16).tofile(tmp_path / "values")
    values = np.memmap(tmp_path / "values", np.int64, mode="c")
    values[:] = 7
    arrays.release_pages(values[100:].reshape(-1, 4))
    assert (values == 7).all()


@pytest.mark.parametrize("items", [0, 1, 7])
def test_items_in_turn_are_the_same(items, monkeypatch):
    monkeypatch.setattr(arrays, "ITEMS_PER_RELEASE", 3)
    got, let_go_after = [], []
    for item in arrays.release_periodically(range(items), lambda: let_go_after.append(len(got))):
        got.append(item)
    assert got == list(range(items))
    # at first for what was looked at before, and what is left at the end
    assert let_go_after == [*range(0, items, 3), items]


@pytest.mark.parametrize("rows", [1, 3, 1000])
def test_what_is_looked_at_together_lies_together(monkeypatch, rng, rows):
    monkeypatch.setattr(arrays, "BLOCK", 100)
    for n in (0, 1, 250):
        numbers = np.flatnonzero(rng.random(1000) < n / 1000)
        parts = [numbers[part] for part in arrays.split_by_block(numbers, rows)]
        assert np.concatenate([np.zeros(0, int), *parts]).tolist() == numbers.tolist()
        for part in parts:
            assert 0 < len(part) <= rows
            assert part[0] // 100 == part[-1] // 100


def test_some_rows_are_those_of_the_array(limit, monkeypatch, tmp_path, rng):
    monkeypatch.setattr(arrays, "BLOCK", 100)
    column = ArrayBuilder(np.float32, (2,), tmp_path)
    column.append(rng.normal(size=(1000, 2)))
    array = column.finish()
    assert array.flags.writeable == (limit > 0)
    for numbers in (np.zeros(0, np.intp), np.array([0, 99, 100, 999]), np.arange(1000)):
        np.testing.assert_array_equal(arrays.take_rows(array, numbers), array[numbers])


def test_different_cells_are_those_of_numpy(rng):
    for n in (0, 1, 300):
        cells = rng.integers(-(2**22), 2**22, (n, 2)) // rng.choice([1, 2**20], (n, 1))
        expected, of = np.unique(cells, axis=0, return_inverse=True)
        found = arrays.unique_cells(cells)
        np.testing.assert_array_equal(found[0], expected)
        np.testing.assert_array_equal(found[1], of.reshape(-1))
