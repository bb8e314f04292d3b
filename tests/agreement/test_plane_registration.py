"""NDT map and point-to-plane registration: kernel against twin."""

import numpy as np
import pytest
import reference
from surfel_maps import assert_same_bits

from stillmap import _core
from stillmap.core import se3

PLANE = {"min_weight": 4.0, "max_flatness": 0.2, "min_extent": 0.02}
FIT = {**PLANE, "range_std": 0.03, "kernel_width": 3.0}
STEPS = {"information_scale": 0.5, "start_slack": 0.1, "max_iterations": 6, "tolerance": 1e-4}


def cloud(seed, n=1500):
    """Points on three walls of a corner, a few of them not finite; their weights; their times."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2.0, 3.0, (n, 3))
    wall = rng.integers(0, 3, n)
    points[np.arange(n), wall] = -2.0 + rng.normal(0.0, 0.02, n)
    points[::97] = np.nan
    weights = rng.choice([0.0, 0.3, 1.0], n, p=[0.1, 0.2, 0.7])
    times = rng.uniform(-0.05, 0.05, n)
    return points.astype(np.float32), weights.astype(np.float32), times.astype(np.float32)


def pose(seed, size):
    return se3.exp(np.random.default_rng(seed).normal(0.0, size, 6))


@pytest.fixture
def maps():
    both = _core.NdtMap3D(0.5, 3, 40.0), reference.NdtMap3D(0.5, 3, 40.0)
    for seed in range(3):
        points, weights, _ = cloud(seed)
        for one in both:
            one.add(points, weights, pose(seed, 0.05))
    return both


@pytest.mark.parametrize("level", [0, 1, 2])
def test_planes(maps, level):
    core, plain = maps
    places = np.random.default_rng(7).uniform(-2.5, 3.0, (300, 3))
    normals, offsets, variances, known = core.fit_planes(places, level, **PLANE)
    assert 30 < known.sum() < 300
    for k, place in enumerate(places):
        expected = plain.plane(place, level, **PLANE)
        assert bool(known[k]) == (expected is not None)
        if expected is not None:
            normal, offset, variance = expected
            flip = np.sign(normals[k] @ normal)
            assert normals[k] == pytest.approx(flip * normal, abs=1e-6)
            assert offsets[k] == pytest.approx(flip * offset, abs=1e-8)
            assert variances[k] == pytest.approx(variance, abs=1e-9)


def test_crop(maps):
    core, plain = maps
    before = len(core)
    for one in maps:
        one.crop(pose(3, 0.1), 2.5)
    assert 0 < len(core) == len(plain.cells[0]) < before
    places = np.random.default_rng(8).uniform(-2.5, 3.0, (200, 3))
    known = core.fit_planes(places, 0, **PLANE)[3]
    assert known.tolist() == [plain.plane(place, 0, **PLANE) is not None for place in places]


def test_register_sweep(maps):
    points, weights, times = cloud(9, 600)
    prior, twist = pose(10, 0.03), np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.4])
    information = np.diag([100.0] * 3 + [400.0] * 3 + [10.0] * 6)
    asked = points, weights, times, prior, twist, information
    core = _core.register_sweep(maps[0], *asked, **FIT, **STEPS, start_level=2, threads=2)
    plain = reference.register_sweep(maps[1], *asked, **FIT, **STEPS, start_level=2)
    for found, expected in zip(core[:3], plain, strict=False):
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert np.linalg.norm(core[0][:3, 3] - prior[:3, 3]) > 0.005


def test_any_number_of_threads_gives_the_same_bits(maps):
    asked = *cloud(9, 5000), pose(10, 0.03), np.zeros(6), np.eye(12)

    def found(threads):
        return _core.register_sweep(maps[0], *asked, **FIT, **STEPS, start_level=1, threads=threads)

    assert_same_bits(found, 2, 3, 8)


def test_transform_by_twist_and_voxel_downsample():
    points, weights, times = cloud(11)
    twist = np.array([3.0, -1.0, 0.5, 0.4, -2.0, 5.0])
    moved = _core.transform_by_twist(points, times, twist)
    assert np.array_equal(np.isnan(moved), np.isnan(points))
    plain = reference.transform_by_twist(points, times, twist)
    assert np.nan_to_num(moved) == pytest.approx(np.nan_to_num(plain), abs=1e-5)
    for edge in (0.1, 0.7):
        kept = _core.voxel_downsample(points, weights, edge)
        assert kept.tolist() == reference.voxel_downsample(points, weights, edge).tolist()
