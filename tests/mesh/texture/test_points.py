"""Colours of points on textured meshes."""

import numpy as np
import pytest

from stillmap.mesh.texture import TexturedMesh, TextureSampler

ABOVE = np.array([0.5, 0.5, 9.0])


def square(page: np.ndarray, view: int = 0, z: float = 0.0) -> TexturedMesh:
    """One by one metre, seen from above, a page over all of it; x to the right, y down."""
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    where = np.full(2, 0 if view >= 0 else -1, np.int32)
    return TexturedMesh(
        np.column_stack([xy, np.full(4, z)]),
        faces,
        xy,
        where,
        (page,),
        np.full(2, view, np.int32),
    )


def from_above(points: np.ndarray) -> np.ndarray:
    return np.broadcast_to(ABOVE, points.shape)


@pytest.fixture(scope="module")
def gradient() -> np.ndarray:
    """Red grows to the right, green downwards."""
    page = np.zeros((100, 200, 3), np.uint8)
    page[..., 0], page[..., 1] = np.arange(200), 2 * np.arange(100)[:, None]
    return page


def test_points_have_the_colour_beneath_them(gradient):
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(0.02, 0.98, (500, 2)), rng.uniform(-0.04, 0.04, 500)])
    colours, has = TextureSampler(square(gradient), 0.05).colors(points, from_above(points))
    assert has.all()
    np.testing.assert_allclose(colours[:, 0], 200.0 * points[:, 0] - 0.5, atol=0.51)
    np.testing.assert_allclose(colours[:, 1], 2.0 * (100.0 * points[:, 1] - 0.5), atol=0.51)


def test_what_is_too_far_off_or_seen_from_behind_has_none(gradient):
    points = np.array([[0.5, 0.5, 0.049], [0.5, 0.5, 0.051], [1.04, 0.5, 0.0], [1.06, 0.5, 0.0]])
    painted = TextureSampler(square(gradient), 0.05)
    _, has = painted.colors(points, from_above(points))
    assert has.tolist() == [True, False, True, False]
    _, has = painted.colors(points, from_above(points) * [1.0, 1.0, -1.0])
    assert not has.any()
