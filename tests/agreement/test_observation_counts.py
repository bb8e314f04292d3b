"""Observation counts: kernel against twin, by hand, and invalid arguments."""

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from stillmap import _core

KERNELS = (_core, reference)


def empty(kernels, dimension, resolution, **options):
    kind = getattr(kernels, f"ObservationCounts{dimension}D")
    return kind(resolution, **{"radius": 2.3 * resolution, **options})


def counted(kernels, beams, time_bin, dynamic, threads=1, **options):
    counts = empty(kernels, beams.dimension, beams.resolution, **options)
    points, hit, offset, T = beams.arguments
    counts.add(points, hit, dynamic, offset, T, time_bin, threads)
    return counts


def box_of(beams):
    """A box around all beams, with some room."""
    first, shape = beams.grid(_core).bounding_box()
    return (first - 3).tolist(), tuple(n + 6 for n in shape)


def time_bins_of(beams, seed):
    """Time bins of one to five scans, with gaps, and dynamic returns."""
    rng = np.random.default_rng(seed)
    time_bin = np.cumsum(rng.choice([0, 0, 1, 7], len(beams.T_map_sensor))).astype(np.int64)
    return time_bin, rng.random(len(beams.points)) < 0.1


@pytest.mark.parametrize("n_stops", [None, 0, 5])
@pytest.mark.parametrize("end_margin", [None, 0.2, np.inf])
def test_agreement(beams, n_stops, end_margin):
    time_bin, dynamic = time_bins_of(beams, 1)
    options = {} if end_margin is None else {"end_margin": end_margin}
    if n_stops is not None:
        cells = np.array(list(beams.grid(reference).alpha), np.int64)
        some = cells[:: 1 + len(cells) // 5][:n_stops]
        options["stop_cells"] = np.ascontiguousarray(some)
    both = [counted(kernels, beams, time_bin, dynamic, **options) for kernels in KERNELS]
    for a, b in zip(*(one.dense(*box_of(beams)) for one in both), strict=True):
        assert a.dtype == np.uint16
        assert a.max() > 2
        # chords of length zero, and cells left at the limit of trust
        assert (a != b).mean() < 1e-3
        assert np.abs(a.astype(int) - b).max() <= 1


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]), st.integers(2, 9))
def test_threads_and_calls_give_the_same_counts(some_beams, seed, dimension, threads):
    beams = some_beams(seed, dimension)
    time_bin, dynamic = time_bins_of(beams, seed)
    box = box_of(beams)
    options = {"stop_cells": np.zeros((1, dimension), np.int64), "end_margin": 0.1}
    whole = counted(_core, beams, time_bin, dynamic, **options)
    others = [counted(_core, beams, time_bin, dynamic, threads, **options)]
    others.append(empty(_core, dimension, beams.resolution, **options))
    starts = np.flatnonzero(np.diff(time_bin, prepend=time_bin[0] - 1))
    for first, last in zip(starts, [*starts[1:], len(time_bin)], strict=True):
        part = slice(beams.offset[first], beams.offset[last])
        offset = beams.offset[first : last + 1] - beams.offset[first]
        T = beams.T_map_sensor[first:last]
        points, hit, moves = beams.points[part], beams.hit[part], dynamic[part]
        others[-1].add(points, hit, moves, offset, T, time_bin[first:last], threads)
    for other in others:
        for a, b in zip(whole.dense(*box), other.dense(*box), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("believed", [False, True])
def test_observed_where_the_sums_are_not_zero(beams, believed):
    grid, rest = beams.empty_grid(_core), beams.empty_grid(_core)
    time_bin, dynamic = time_bins_of(beams, 3)
    options = {}
    if believed:
        stops = np.ones((1, beams.dimension), np.int64)
        options = {"stop_cells": stops, "end_margin": 0.15}
        _core.add_no_return_beams(grid, rest, *beams.arguments, stops, 0.15)
        hits = np.where(beams.hit[:, None], beams.points, np.float32(np.nan)).astype(np.float32)
        grid.merge(beams.with_(points=hits).grid(_core))
    else:
        grid = beams.grid(_core)
    observed, _ = counted(_core, beams, time_bin, dynamic, **options).dense(*box_of(beams))
    _, alpha, beta = grid.dense(*box_of(beams))
    np.testing.assert_array_equal(observed > 0, alpha + beta > 0)


def row_of(kernels, scans, **options):
    """Observed and clear counts of eight cells of 1 m; scans: (range, hit, dynamic, time bin)."""
    counts = kernels.ObservationCounts2D(1.0, **{"radius": 1.0, **options})
    reach, hit, dynamic, time_bin = (np.array(column) for column in zip(*scans, strict=True))
    points = np.stack([reach, np.zeros(len(reach))], axis=1).astype(np.float32)
    T = np.tile(np.eye(3), (len(scans), 1, 1))
    T[:, :2, 2] = 0.5
    counts.add(points, hit, dynamic, np.arange(len(scans) + 1), T, time_bin)
    return [rows.ravel().tolist() for rows in counts.dense([0, 0], (1, 8))]


@pytest.mark.parametrize("kernels", KERNELS, ids=["core", "reference"])
def test_by_hand(kernels):
    wall, walker = (6.0, True, False), (4.0, True, True)
    # scans of one time bin count once
    scans = [(*wall, 3), (*wall, 3), (*wall, 5)]
    assert row_of(kernels, scans) == [[2] * 7 + [0]] * 2
    # dynamic return in cell 4: it and its neighbours are not clear
    assert row_of(kernels, [(*walker, 0)]) == [[1] * 5 + [0] * 3, [1, 1, 1, 0, 0, 0, 0, 0]]
    assert row_of(kernels, [(*walker, 0)], radius=2.5)[1] == [1, 1, 0, 0, 0, 0, 0, 0]
    assert row_of(kernels, [(*walker, 0)], radius=0.0)[1] == [1, 1, 1, 1, 0, 0, 0, 0]
    # a mover that leaves within the time bin counts
    both = [(*walker, 0), (*wall, 0), (*wall, 1)]
    assert row_of(kernels, both) == [[2] * 7 + [0], [2, 2, 2, 1, 1, 1, 2, 0]]
    # a beam without a return does not observe its end cell and is never dynamic
    assert row_of(kernels, [(4.0, False, True, 0)]) == [[1] * 4 + [0] * 4] * 2
    # a single one is not trusted with stop_cells
    stops = np.zeros((0, 2), np.int64)
    assert row_of(kernels, [(4.0, False, False, 0)], stop_cells=stops) == [[0] * 8] * 2


def test_counts_saturate():
    counts = _core.ObservationCounts2D(1.0, radius=0.4)
    n = 70_000
    points, T = np.tile(np.float32([[1.0, 0.0]]), (n, 1)), np.tile(np.eye(3), (n, 1, 1))
    T[:, :2, 2] = 0.5
    hit, none = np.ones(n, bool), np.zeros(n, bool)
    counts.add(points, hit, none, np.arange(n + 1), T, np.arange(n), 3)
    assert [rows.tolist() for rows in counts.dense([0, 0], [1, 2])] == [[[65535] * 2]] * 2
