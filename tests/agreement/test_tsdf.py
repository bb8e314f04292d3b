"""TSDF integration: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference
from surfel_maps import assert_same_bits

from stillmap import _core

VOXEL, REACH = 0.1, {"truncation_front": 0.3, "truncation_back": 0.2}


def seen(seed, n=60, m=80, size=0.6):
    """Triangles of any shape on all sides of the sensor."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-2.0, 2.0, (n, 3))
    points = middle + rng.normal(0.0, 0.05, (n, 3))
    near = np.argsort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)
    faces = np.array([near[i, [0, *rng.choice(np.arange(1, 7), 2, False)]] for i in range(n)])
    faces = np.concatenate([faces, faces[:, [1, 0, 2]]])[:m].astype(np.int32)
    origin = np.array([0.3, -0.2, 0.1]) + rng.normal(0.0, size / 60, (n, 3))
    standoff = rng.uniform(0.4, 1.0, n) * np.linalg.norm(points - origin, axis=1)
    weight = rng.choice([0.0, 0.6, 1.0], m).astype(np.float32)
    return points, origin, standoff, faces, weight


def box(distances):
    blocks = distances.blocks() * distances.block_edge
    low, high = blocks.min(axis=0), blocks.max(axis=0) + distances.block_edge
    return [int(v) for v in low], [int(v) for v in (high - low)[::-1]]


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_agreement(seed):
    both = [kernels.TsdfVolume(VOXEL, **REACH) for kernels in (_core, reference)]
    for one in both:
        one.integrate(*seen(seed))
        one.integrate(*seen(seed + 50))
    where = box(both[0])
    (metres, weight), (plain_metres, plain_weight) = (one.dense(*where) for one in both)
    # a voxel may lie on a border but for rounding
    differs = (weight > 0) != (plain_weight > 0)
    assert differs.sum() <= 2
    known = (weight > 0) & (plain_weight > 0)
    assert known.sum() > 1000
    close = np.isclose(weight, plain_weight, rtol=1e-5, atol=1e-6)
    assert (~close[known]).sum() <= 2
    same = known & close
    np.testing.assert_allclose(metres[same], plain_metres[same], atol=2e-6)
    assert np.isnan(metres[weight == 0]).all()
    assert {tuple(b) for b in both[1].blocks()} <= {tuple(b) for b in both[0].blocks()}


def test_bits_do_not_depend_on_threads():
    rng = np.random.default_rng(5)
    number = np.arange(200 * 150, dtype=np.int32).reshape(200, 150)
    y, z = np.meshgrid(np.linspace(-2, 2, 150), np.linspace(-1, 1, 200))
    points = np.stack([4.0 + rng.normal(0, 0.02, y.shape), y, z], axis=-1).reshape(-1, 3)
    a, b, c = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, c + 1, c], 1)])
    rest = (np.zeros_like(points), np.full(len(points), 4.0), faces.astype(np.int32))
    weight = rng.random(len(faces)).astype(np.float32)

    def volume(threads):
        distances = _core.TsdfVolume(0.07, truncation_front=0.2, truncation_back=0.2)
        distances.integrate(points, *rest, weight, threads=threads)
        return distances.blocks(), *distances.dense(*box(distances))

    assert_same_bits(volume, 2, 3, 7)
    assert np.isfinite(volume(1)[1]).sum() > 9_000


def wall(distance=2.0, half=1.0):
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    points = np.column_stack([np.full(4, distance), corners])
    faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    return points, np.zeros((4, 3)), np.full(4, distance), faces, np.ones(2, np.float32)


def test_distances_from_a_wall_are_exact():
    distances = _core.TsdfVolume(VOXEL, **REACH)
    distances.integrate(*wall())
    metres, weight = distances.dense([0, 0, 0], [8, 8, 30])
    x = (np.arange(30) + 0.5) * VOXEL
    inside = metres[2, 3]
    known = (x > 1.7 - 1e-9) & (x < 2.2 - 1e-9)
    np.testing.assert_array_equal(np.isfinite(inside), known)
    np.testing.assert_allclose(inside[known], 2.0 - x[known], atol=1e-6)
    behind = np.clip(1.0 + (2.0 - x) / 0.2, 0.0, 1.0)
    np.testing.assert_allclose(weight[2, 3][known], behind[known], atol=1e-6)


@pytest.mark.parametrize("standoff", [1e-3, 1e-9, 1e-300])
def test_extent_at_grazing_angles(standoff):
    points, origin, _, faces, weight = wall(20.0, 0.1)
    both = [
        k.TsdfVolume(0.03, truncation_front=0.18, truncation_back=0.15) for k in (_core, reference)
    ]
    for one in both:
        one.integrate(points, origin, np.full(4, standoff), faces, weight)
        x = one.blocks()[:, 0] * one.block_edge * 0.03
        assert 20.0 - 18.3 < x.min() < 20.0 - 15.0
        assert 20.0 + 14.7 < x.max() < 20.0 + 15.0
    (metres, weights), (plain, plain_weights) = (d.dense([600, -4, -4], [8, 8, 60]) for d in both)
    assert (weights > 0.0).sum() > 2000
    np.testing.assert_allclose(weights, plain_weights, rtol=1e-5)
    off = 1e-6 * standoff + 1e-38  # float32
    np.testing.assert_allclose(metres, plain, rtol=1e-4, atol=off)
