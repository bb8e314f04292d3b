"""Cluster pooling and ground contact: kernel against twin, and by hand."""

import itertools

import numpy as np
import pytest
import reference
from marks import slow_params
from surfel_maps import fit_both, fit_surfels, order

from stillmap import _core

IDENTITY = np.eye(4)[None]


def scattered(seed, n=900, scans=6):
    """End points in clumps around zero, in scans that rotate."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-4, 4, (25, 3)) * [1, 1, 0.3]
    ends = middle[rng.integers(0, 25, n)] + rng.normal(0, 0.3, (n, 3))
    T = np.tile(np.eye(4), (scans, 1, 1))
    T[:, :3, 3] = rng.uniform(-1, 1, (scans, 3))
    offset = np.linspace(0, n, scans + 1).astype(np.int64)
    points = ends - np.repeat(T[:, :3, 3], np.diff(offset), axis=0)
    points[rng.random(n) < 0.02] = np.nan
    return points.astype(np.float32), rng.random(n) < 0.9, offset, T


@pytest.mark.parametrize("seed", [0, *slow_params(1, 2)])
@pytest.mark.parametrize(("column", "fewest"), [(1, 1), (2, 5), (3, 12)])
def test_agreement(seed, column, fewest):
    beams = scattered(seed)
    core, plain = fit_both("SurfelMap3D", 0.2, *beams)
    of_core, of_plain = order(core), order(plain)
    rng = np.random.default_rng(seed + 9)
    stands, values = rng.random(plain.size) < 0.8, rng.normal(0, 2, (plain.size, 2))
    shares = []
    for kernels, surface, of in ((_core, core, of_core), (reference, plain, of_plain)):
        mine = np.empty(plain.size, bool), np.empty((plain.size, 2), np.float32)
        mine[0][of], mine[1][of] = stands, values
        pooling = kernels.ClusterPooling3D(surface, *mine, column_cells=column, min_surfels=fewest)
        pooling.add(*beams)
        shares.append(pooling.means()[of])
    assert shares[0].dtype == np.float32
    np.testing.assert_allclose(shares[0], shares[1], atol=3e-6)
    known = np.isfinite(shares[1]).all(axis=1)
    assert not known[~stands].any()
    assert known.mean() > 0.3
    assert np.std(shares[1][known]) > 0.02  # clusters differ


def test_threads_and_chunks_change_nothing():
    points, hit, offset, T = scattered(4, 30000, 60)
    surface = fit_surfels(_core, "SurfelMap3D", 0.2, points, hit, offset, T)
    values = np.random.default_rng(1).random((surface.size, 1)).astype(np.float32)
    stands = np.ones(surface.size, bool)
    found = []
    for threads, cuts in ((1, (0, 60)), (3, (0, 60)), (2, (0, 7, 31, 60))):
        pooling = _core.ClusterPooling3D(surface, stands, values, column_cells=1, min_surfels=2)
        for a, b in itertools.pairwise(cuts):
            beams = slice(offset[a], offset[b])
            within = offset[a : b + 1] - offset[a]
            pooling.add(points[beams], hit[beams], within, T[a:b], threads)
        found.append(pooling.means())
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


@pytest.mark.parametrize("seed", [0, *slow_params(1, 2)])
@pytest.mark.parametrize(
    ("column", "least", "share"), [(2, 0.02, 0.0), (3, 0.0, 0.0), (2, 0.05, 0.5)]
)
def test_ground_contact_agreement(seed, column, least, share):
    rng = np.random.default_rng(seed + 40)
    xy = rng.uniform(-2.5, 2.5, (1600, 2))
    floor = np.column_stack([xy, rng.normal(0.1, 0.01, 1600) * np.sign(rng.normal(2, 1, 1600))])
    points, hit, offset, T = scattered(seed, 800)
    points = np.concatenate([points, floor.astype(np.float32)])[rng.permutation(2400)]
    beams = points, np.tile(hit, 3), 3 * offset, np.tile(np.eye(4), (len(T), 1, 1))
    core, plain = fit_both("SurfelMap3D", 0.2, *beams)
    of_core, of_plain = order(core), order(plain)
    low = rng.random(plain.size) < 0.5
    p, ground = rng.random(plain.size), rng.normal(0.0, 0.05, plain.size)
    any_height = rng.random(plain.size) < share
    found = []
    for kernels, surface, of in ((_core, core, of_core), (reference, plain, of_plain)):
        stands, at_any_height = (np.empty(plain.size, bool) for _ in range(2))
        mine = np.empty((2, plain.size), np.float32)
        stands[of], mine[0][of], mine[1][of] = ~low, np.where(low, 0.5 + p / 2, 0.6 * p), ground
        at_any_height[of] = any_height
        known = {"is_obstacle": stands, "p_static": mine[0], "ground_height": mine[1]}
        known |= {"at_any_height": at_any_height, "column_cells": column}
        known |= {"max_ground_height": 0.15, "min_end_height": least}
        ends = (*beams, surface.associate_beams(*beams))
        for threads in (1, 3):
            relabelled = kernels.relabel_ground_contact(surface, *ends, **known, threads=threads)
            found.append(relabelled)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_allclose(found[0], found[2], atol=1e-6)
    assert 5 <= np.isfinite(found[2]).sum() < 700
    assert np.nanmax(found[2]) < 0.5


def row_of(*x):
    """End points in the centres of cells of 1 m in a row."""
    return np.array([[v + 0.5, 0.5, 0.5] for v in x], np.float32)


def share_of(*scans, moving):
    """{x of the cell: mean of its cluster}."""
    points, offset = np.concatenate(scans), np.cumsum([0, *map(len, scans)])
    hit, T = np.ones(len(points), bool), np.repeat(IDENTITY, len(scans), axis=0)
    surface = fit_surfels(_core, "SurfelMap3D", 1.0, points, hit, offset, T)
    x = surface.surfels()[0][:, 0]
    is_moving = np.isin(x, moving).astype(np.float32)[:, None]
    stands = np.ones(len(x), bool)
    pooling = _core.ClusterPooling3D(surface, stands, is_moving, column_cells=1, min_surfels=1)
    pooling.add(points, hit, offset, T)
    return dict(zip(x.tolist(), pooling.means()[:, 0].tolist(), strict=True))


def test_clusters_are_apart_and_sweeps_have_equal_weights():
    share = share_of(row_of(0, 1, 2, 3, 5, 6), moving=[3])
    assert share == {0: 0.25, 1: 0.25, 2: 0.25, 3: 0.25, 5: 0.0, 6: 0.0}
    share = share_of(row_of(0, 1), row_of(0), row_of(0), row_of(0), moving=[1])
    assert share == {0: 0.125, 1: 0.5}
