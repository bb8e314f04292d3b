"""Sums, E-step and likelihoods of kernel against twin on random beams."""

import numpy as np
import pytest
import reference
from surfel_maps import assert_same_bits

from stillmap import _core

STEP = 2.0**-24  # of the fixed-point sums of the kernel


def all_cells(*grids):
    """(K, D) every cell of the bounding boxes of the grids, and one layer more."""
    boxes = [(first, alpha.shape[::-1]) for first, alpha, _ in (grid.dense() for grid in grids)]
    low = np.min([first for first, _ in boxes], axis=0) - 1
    high = np.max([first + shape for first, shape in boxes], axis=0) + 1
    axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def sums(grid, cells):
    return grid.alpha_beta(np.ascontiguousarray(cells, np.int64))


def test_sums(beams):
    core, plain = beams.grid(_core), beams.grid(reference)
    cells = all_cells(core, plain)
    expected = sums(plain, cells)
    assert expected.sum() > 100
    # each beam in a cell is rounded once or twice, by half a step
    assert np.abs(sums(core, cells) - expected).max() <= len(beams.hit) * STEP


def test_updating_e_equals_adding_with_the_new_e(beams):
    other = beams.with_(e=np.ones(len(beams.hit), np.float32))
    points, hit, offset, T = beams.arguments
    grids = []
    for kernels in (_core, reference):
        grid = beams.grid(kernels)
        kernels.add_end_points(grid, points, hit, beams.e, offset, T, remove=True)
        kernels.add_end_points(grid, points, hit, other.e, offset, T)
        grids.append(grid)
    cells = all_cells(*grids)
    assert (sums(grids[0], cells) == sums(other.grid(_core), cells)).all()
    np.testing.assert_allclose(sums(grids[1], cells), sums(other.grid(reference), cells), atol=1e-9)


def test_dense(beams):
    for kernels in (_core, reference):
        grid = beams.grid(kernels)
        first, alpha, beta = grid.dense()
        assert first.dtype == np.int64
        assert alpha.shape == beta.shape
        index = np.stack(np.meshgrid(*map(np.arange, alpha.shape), indexing="ij"), axis=-1)
        cells = first + index.reshape(-1, alpha.ndim)[:, ::-1]  # [row = y, column = x]
        expected = sums(grid, cells)
        assert (alpha.ravel() == expected[:, 0]).all()
        assert (beta.ravel() == expected[:, 1]).all()
        assert alpha.sum() + beta.sum() == pytest.approx(sums(grid, all_cells(grid)).sum())


def test_counts_without_moments(beams):
    with_moments = beams.grid(_core)
    kind = type(with_moments)
    for threads in (1, 2):
        grid = kind(beams.resolution, moments=False)
        _core.add_beams(grid, *beams.weighted, threads)
        for one, other in zip(grid.dense(), with_moments.dense(), strict=True):
            np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="moments"):
        kind(beams.resolution, 0.5, moments=False)


@pytest.mark.parametrize("prior", [0.05, 0.5, 0.9, 0.0, 1.0])
def test_e_step(beams, prior):
    core, plain = beams.grid(_core), beams.grid(reference)
    # half of the beams are in the map, half may end in unobserved cells
    moved = beams.T_map_sensor.copy()
    moved[::2, 0, -1] += 1.5
    looks = beams.with_(T_map_sensor=moved)
    e = _core.e_step(core, *looks.arguments, prior)
    expected = reference.e_step(plain, *looks.arguments, prior)
    assert e.dtype == expected.dtype == np.float32
    assert (np.isnan(e) == np.isnan(beams.points).any(axis=1)).all()
    np.testing.assert_allclose(e, expected, rtol=0, atol=1e-6)
    if 0 < prior < 1:
        unknown = (expected == np.float32(prior)) & beams.hit
        assert unknown.any()
        assert len(np.unique(expected[beams.hit])) > 30


@pytest.mark.parametrize("prior", [0.05, 0.5, 0.9])
def test_log_likelihood(beams, prior):
    core, plain = beams.grid(_core), beams.grid(reference)
    e = np.random.default_rng(1).uniform(0, 1, len(beams.hit)).astype(np.float32)
    e[::7], e[1::7] = 0, 1
    looks = beams.with_(e=e).weighted
    terms = _core.log_likelihood(core, *looks, prior)
    expected = reference.log_likelihood(plain, *looks, prior)
    assert terms.shape == (len(beams.T_map_sensor), 4)
    assert (np.abs(expected).sum(axis=0) > 1).all()
    assert not expected[:2].any()  # empty scans
    np.testing.assert_allclose(terms[:, 2:], expected[:, 2:], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(terms[:, :2], expected[:, :2], rtol=1e-6, atol=1e-5)


def test_log_likelihood_of_another_map(beams):
    # a map of the other half of the beams: unknown cells, cells with m = 0 and with m = 1
    points = beams.points.copy()
    points[len(points) // 2 :] = np.nan
    seen = beams.with_(points=points, e=np.round(beams.e))
    core, plain = seen.grid(_core), seen.grid(reference)
    terms = _core.log_likelihood(core, *beams.weighted, 0.8)
    expected = reference.log_likelihood(plain, *beams.weighted, 0.8)
    assert expected[:, 0].min() < -27  # ln of the floor 1e-12
    # where 1 - m comes from a very short chord, ln(1 - m) depends on the rounding of the kernel
    np.testing.assert_allclose(terms, expected, rtol=1e-4, atol=1e-3)


def test_any_number_of_threads_gives_the_same_bits(beams):
    def results(threads):
        grid = beams.grid(_core, threads)
        e = _core.e_step(grid, *beams.arguments, 0.8, threads=threads)
        terms = _core.log_likelihood(grid, *beams.weighted, 0.8, threads=threads)
        return *grid.dense(), e, terms

    assert_same_bits(results, 2, 3, 64)


def test_any_order_of_scans_gives_the_same_bits(beams):
    whole, piecewise = beams.grid(_core), beams.empty_grid(_core)
    for t in range(len(beams.T_map_sensor) - 1, -1, -1):
        a, b = beams.offset[t : t + 2]
        scan = beams.points[a:b], beams.hit[a:b], beams.e[a:b]
        _core.add_beams(piecewise, *scan, np.array([0, b - a]), beams.T_map_sensor[t : t + 1])
    for a, b in zip(whole.dense(), piecewise.dense(), strict=True):
        assert (a == b).all()
    if beams.dimension == 2:  # the moments too
        probes = beams.points, beams.e, beams.T_map_sensor[-1], 0.3, 2, 0.01, 0.1
        costs = [_core.registration_cost(grid, *probes) for grid in (whole, piecewise)]
        assert costs[0] == costs[1]


def test_five_rounds_of_em(beams):
    ours = reference.em_fixed_poses(*beams.arguments, 0.8, beams.resolution, 5, _core)
    plain = reference.em_fixed_poses(*beams.arguments, 0.8, beams.resolution, 5)
    for a, b in zip(ours, plain, strict=True):
        np.testing.assert_allclose(a.e, b.e, atol=2e-5)
        assert a.bound == pytest.approx(b.bound, abs=1e-2)


@pytest.mark.parametrize("dimension", [2, 3])
def test_no_beams_and_no_scans(dimension):
    nothing = np.zeros((0, dimension), np.float32), np.zeros(0, bool)
    no_e = np.zeros(0, np.float32)
    for scans in (0, 3):
        offset = np.zeros(scans + 1, np.int64)
        T = np.tile(np.eye(dimension + 1), (scans, 1, 1))
        for kernels in (_core, reference):
            grid = getattr(kernels, f"OccupancyGrid{dimension}D")(0.1)
            kernels.add_beams(grid, *nothing, no_e, offset, T, 2)
            assert kernels.e_step(grid, *nothing, offset, T, 0.5, 2).shape == (0,)
            terms = kernels.log_likelihood(grid, *nothing, no_e, offset, T, 0.5, 2)
            assert terms.tolist() == [[0.0] * 4] * scans


@pytest.mark.parametrize("dimension", [2, 3])
def test_cells_far_apart_stay_apart(dimension):
    # one end point at 2^22 cells: no collision with cells at distances of powers of two
    far = 2**22 + 2**21 + 5
    points = np.zeros((1, dimension), np.float32)
    T = np.eye(dimension + 1)[None].copy()
    T[0, :dimension, dimension] = 0.5
    T[0, 0, dimension] += far
    grid = getattr(_core, f"OccupancyGrid{dimension}D")(1.0)
    one = np.ones(1, np.float32)
    _core.add_beams(grid, points, np.array([True]), one, np.array([0, 1]), T)
    cells = np.zeros((24, dimension), np.int64)
    cells[:, 0] = far
    cells[1:, 0] -= 2 ** np.arange(1, 24)
    expected = np.zeros((24, 2))
    expected[0, 0] = 1
    assert (grid.alpha_beta(cells) == expected).all()
