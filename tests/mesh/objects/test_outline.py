"""How far within an outline points lie."""

import numpy as np

from stillmap.mesh.objects.texturing import outline_depth


def grid(size: float, step: float) -> np.ndarray:
    at = np.arange(0.0, size + 1e-9, step)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def test_within_a_square_it_is_the_distance_to_its_edge():
    points = grid(1.0, 0.05)
    expected = np.minimum(points, 1.0 - points).min(axis=1)
    found = outline_depth(points, 0.12)
    np.testing.assert_allclose(found, expected, atol=0.05)
    assert found[expected == 0.0].max() <= 0.02
    assert found[expected > 0.3].min() > 0.25


def test_what_is_enclosed_is_inside_and_gaps_between_pieces_are_not():
    ring = grid(1.0, 0.05)
    ring = ring[np.abs(ring - 0.5).max(axis=1) > 0.4]
    inner = np.abs(ring - 0.5).max(axis=1) < 0.46
    assert outline_depth(ring, 0.12)[inner].min() > 0.03  # the hole is a part of it
    two = np.concatenate([grid(0.2, 0.05), grid(0.2, 0.05) + np.array([0.6, 0.0])])
    assert outline_depth(two, 0.12).max() < 0.13


def test_few_points_are_their_own_edge_wherever_they_are():
    assert outline_depth(np.zeros((0, 2)), 0.1).shape == (0,)
    assert outline_depth(np.array([[3.0, 4.0]]), 0.1).max() < 0.02
    line = np.stack([np.linspace(0.0, 1.0, 50), np.zeros(50)], axis=1)
    assert outline_depth(line, 0.1).max() < 0.02
    far = np.array([[0.0, 0.0], [1e6, 1e6]])  # no more cells for that
    assert outline_depth(far, 0.1).max() == 0.0
