"""Which end points are of moving things, where they lie, and which belong together."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.core import chunks, se2
from stillmap.tracking import clustering
from stillmap.tracking.association import MAX_GAP, assign_tracks
from stillmap.tracking.clustering import extract_dynamic_points
from stillmap.tracking.fast_movers import find_fast_movers

MIN_P_DYNAMIC = 0.7


def recording(ranges, hit=None, stamps=None):
    """(T, N) ranges at bearings of 0.1 rad; the laser is 0.2 m ahead."""
    ranges = np.asarray(ranges, float)
    T, N = ranges.shape
    bearing = 0.1 * np.arange(N)
    points = ranges[..., None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    made = of_one_sensor(
        np.arange(T) * 10**9 if stamps is None else np.asarray(stamps, np.int64),
        np.arange(T + 1) * N,
        points.reshape(-1, 2).astype(np.float32),
        np.ones(T * N, bool) if hit is None else np.asarray(hit, bool).reshape(-1),
    )
    return dataclasses.replace(made, T_base_sensor=se2.matrix(0.2, 0.0, 0.0)[None])


def extracted(r, p_static):
    return extract_dynamic_points(r, np.tile(np.eye(3), (r.n_scans, 1, 1)), p_static, MIN_P_DYNAMIC)


def test_by_hand():
    r = recording([[2, 2, 2, 5, 5], [2, 2, 2, 2, 2]], [[1, 1, 1, 1, 0], [1, 1, 1, 1, 1]])
    p = np.array([[0.1, 0.2, 0.9, 0.1, 0.1], [0.9, 0.29, 0.31, np.nan, 0.0]], np.float32)
    poses = se2.matrix(np.array([0.0, 1.0]), np.array([0.0, 3.0]), np.array([0.0, np.pi / 2]))
    found = extract_dynamic_points(r, poses, p.reshape(-1), MIN_P_DYNAMIC)
    assert found.beam.tolist() == [0, 1, 3, 6, 9]
    assert found.scan.tolist() == [0, 0, 0, 1, 1]
    assert found.first.tolist() == [0, 3, 5]
    np.testing.assert_allclose(found.sensor, [[0.2, 0.0], [1.0, 3.2]], atol=1e-9)
    np.testing.assert_allclose(found.range, [2, 2, 5, 2, 2], rtol=1e-6)
    np.testing.assert_allclose(found.xy[0], [2.2, 0.0], atol=1e-6)
    ahead = 0.2 + 2 * np.cos(0.1), 2 * np.sin(0.1)
    np.testing.assert_allclose(found.xy[3], [1.0 - ahead[1], 3.0 + ahead[0]], atol=1e-6)
    # 3 m behind one another, in another scan, 0.6 m beside one another
    assert found.cluster.tolist() == [0, 0, 1, 2, 3]


@pytest.mark.parametrize("block", [1, 2, 3, 7])
def test_pieces_of_any_size_make_no_difference(monkeypatch, block):
    rng = np.random.default_rng(5)
    r = recording(rng.choice([2.0, 2.1, 5.0], (6, 5)), rng.random((6, 5)) < 0.9)
    p = rng.choice([0.1, 0.9], 30).astype(np.float32)
    whole = extracted(r, p)
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", block)
    pieces = extracted(r, p)
    for name in ("scan", "beam", "xy", "range", "cluster", "first"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))


def test_time_never_goes_back():
    r = recording([[2.0]] * 4, stamps=[5 * 10**9, 7 * 10**9, 6 * 10**9, 9 * 10**9])
    found = extracted(r, np.zeros(4, np.float32))
    assert found.seconds.tolist() == [0.0, 2.0, 2.0, 4.0]


@pytest.mark.parametrize("n", [0, 3])
def test_nothing_that_moves(n):
    found = extracted(recording(np.full((n, 4), 2.0)), np.ones(4 * n, np.float32))
    assert len(found.beam) == len(found.cluster) == len(found.xy) == 0
    assert found.first.tolist() == [0] * (n + 1)


def test_of_a_scan_the_largest_clusters_are_followed(monkeypatch):
    monkeypatch.setattr(clustering, "_MAX_CLUSTERS", 2)
    r = recording([[2, 2, 5, 8, 8, 8], [2, 2, 2, 5, 5, 5], [2, 5, 2, 5, 2, 5]])
    found = extracted(r, np.zeros(18, np.float32))
    # of 2 + 1 + 1 + 1 + 1 beams, of 3 + 1 + 1 + 1, and of six equal ones the first
    assert found.beam.tolist() == [0, 1, 2, 6, 7, 8, 9, 12, 13]
    assert found.cluster.tolist() == [0, 0, 1, 2, 2, 2, 3, 4, 5]
    assert found.first.tolist() == [0, 3, 7, 9]


def test_scans_of_noise_take_little_memory():
    """Pairs of all their clusters would take gigabytes."""
    rng = np.random.default_rng(3)
    r = recording(10.0 ** rng.uniform(-1.0, 2.0, (3, 20_000)), stamps=[0, 10**8, 2 * 10**8])
    tracemalloc.start()
    try:
        points = extracted(r, np.zeros(60_000, np.float32))
        find_fast_movers(points, assign_tracks(points, MAX_GAP))
        assert tracemalloc.get_traced_memory()[1] < 500e6
    finally:
        tracemalloc.stop()
