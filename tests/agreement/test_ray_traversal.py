"""Ray traversal of kernel against twin."""

import numpy as np
import pytest
import reference

from stillmap import _core


def lengths_by_cell(cells, lengths):
    out = {}
    for cell, length in zip(cells.tolist(), lengths.tolist(), strict=True):
        out[tuple(cell)] = out.get(tuple(cell), 0.0) + length
    return {cell: length for cell, length in out.items() if length > 1e-9}


def assert_agree(start, end, resolution):
    start, end = np.array(start, float), np.array(end, float)
    cells, lengths = _core.traverse(start, end, resolution)
    expected = reference.traverse(start, end, resolution)
    # a connected walk from the first to the last cell, no longer than it must be
    assert (cells[0] == np.floor(start / resolution)).all()
    assert (cells[-1] == np.floor(end / resolution)).all()
    assert (np.abs(np.diff(cells, axis=0)).sum(axis=1) == 1).all()
    assert len(cells) == 1 + np.abs(cells[-1] - cells[0]).sum() == len(expected[0])
    assert (lengths >= 0).all()
    length = np.linalg.norm(end - start) / resolution
    assert lengths.sum() == pytest.approx(length, rel=1e-12, abs=1e-12)
    assert lengths_by_cell(cells, lengths) == pytest.approx(lengths_by_cell(*expected), abs=1e-8)


@pytest.mark.parametrize("dimension", [2, 3])
def test_segments(dimension):
    rng = np.random.default_rng(5)
    for _ in range(300):
        start, end = rng.normal(scale=2, size=(2, dimension))
        assert_agree(start, end, float(rng.uniform(0.05, 1)))
    # between quarters of cells every degenerate case: through corners, along borders, parallel to
    # axes, from and to borders, within one cell, of no length
    for _ in range(1500):
        start, end = rng.integers(-9, 10, size=(2, dimension)) / 4
        assert_agree(start, end, 1.0)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ([0.2, 0.3], [0.2, 0.3]),  # no length
        ([0.2, 0.3], [0.4, 0.9]),  # one cell
        ([-0.5, -0.5], [0.5, 0.5]),  # through the origin's corner
        ([3.0, 3.0], [-3.0, -3.0]),  # corner after corner, from one to one
        ([2.0, 1.5], [-2.0, 1.5]),  # axis-parallel, against the axis, border to border
        ([0.5, 2.0], [7.5, 2.0]),  # along a border
        ([0.5, -7.25], [0.5, 7.25]),
        ([1.0, 0.0], [1.0 - 1e-12, 0.0]),  # across one border, hardly
        ([0.5, 0.5], [9.5, 0.5 + 1e-13]),
        ([-1e-300, 0.5], [1e-300, 0.5]),
        ([-0.5, 0.5, 1.5], [-0.5, 0.5, 1.5]),
        ([0.5, 0.5, 0.5], [-2.5, -2.5, -2.5]),
        ([0.0, 0.0, 0.0], [3.0, 0.0, -3.0]),
        ([0.5, 0.5, 0.25], [0.5, 0.5, -6.0]),
    ],
)
def test_degenerate_segments(start, end):
    for resolution in (1.0, 0.25):
        assert_agree(start, end, resolution)
        assert_agree(end, start, resolution)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ([0.013, -0.007], [811.3, 533.9]),
        ([5000.3, -9000.7], [4100.1, -8999.9]),
        ([0.1, 0.2, 0.3], [-190.7, 222.2, 81.1]),
    ],
)
def test_long_segments_far_from_the_origin(start, end):
    assert_agree(start, end, 0.1)
