"""Rasterisation of triangles: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference

from stillmap import _core


@pytest.mark.parametrize("seed", range(4))
def test_agreement(seed):
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-3.0, 33.0, (80, 1, 2))
    corners = middle + rng.normal(0.0, 1.0, (80, 3, 2)) * rng.choice([0.1, 1.0, 8.0], (80, 1, 1))
    corners[5] = corners[5, 0]  # degenerate
    found, expected = (
        _core.rasterise_texels(corners, 30, 25),
        reference.rasterise_texels(corners, 30, 25),
    )
    assert [a.dtype for a in found] == [a.dtype for a in expected]
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])
    np.testing.assert_allclose(found[2], expected[2], atol=1e-5)
    assert len(np.unique(found[1])) == 80
    assert len(found[0]) > 300


def test_by_hand():
    # a square of 2 by 3 texels, cut in two
    corners = np.array([[[1.0, 1], [3, 1], [3, 4]], [[1, 1], [3, 4], [1, 4]]])
    texel, face, weight = _core.rasterise_texels(corners, 10, 8)
    assert set(texel) == {11, 12, 21, 22, 31, 32}
    at = np.stack([texel % 10, texel // 10], axis=1) + 0.5
    w = np.column_stack([1.0 - weight.sum(axis=1), weight])
    np.testing.assert_allclose(np.einsum("ij,ijk->ik", w, corners[face]), at, atol=1e-6)


def test_triangle_without_texel_centre():
    corners = np.array([[[4.6, 2.6], [4.9, 2.6], [4.7, 2.9]], [[-9.0, -9], [-9, -8], [-8, -9]]])
    texel, face, weight = _core.rasterise_texels(corners, 10, 8)
    assert texel.tolist() == [24, 0]
    assert face.tolist() == [0, 1]
    np.testing.assert_allclose(weight, 1.0 / 3.0)
