"""Colours of points on textured meshes."""

import numpy as np
import pytest

from stillmap.mesh.texture.atlas import GRAY, TexturedMesh
from stillmap.mesh.texture.baking import TextureSampler, avoid_gray

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


def test_the_side_that_was_seen_counts_though_the_other_one_is_nearer():
    """A thin wall, painted green to one side and red to the other."""
    red, green = (np.full((8, 8, 3), colour, np.uint8) for colour in ((200, 0, 0), (0, 200, 0)))
    up, down = square(red, z=0.02), square(green)
    whole = TexturedMesh(
        np.concatenate([up.vertices, down.vertices]),
        np.concatenate([up.faces, down.faces[:, ::-1] + np.int32(4)]),
        np.concatenate([up.uv, down.uv]),
        np.array([0, 0, 1, 1], np.int32),
        (red, green),
        np.zeros(4, np.int32),
    )
    points = np.array([[0.5, 0.3, 0.0], [0.5, 0.3, 0.02]])
    painted = TextureSampler(whole, 0.05)
    assert painted.colors(points, from_above(points))[0].tolist() == [[200, 0, 0]] * 2
    below = from_above(points) * [1.0, 1.0, -1.0]
    assert painted.colors(points, below)[0].tolist() == [[0, 200, 0]] * 2


def test_grey_faces_give_no_colour_and_grey_texels_one_beside_grey():
    grey = np.full((8, 8, 3), GRAY, np.uint8)
    points = np.array([[0.5, 0.3, 0.0]])
    colours, has = TextureSampler(square(grey), 0.05).colors(points, from_above(points))
    assert has.all()
    assert colours.tolist() == [[128, 128, 127]]
    assert (
        not TextureSampler(square(grey, view=-1), 0.05).colors(points, from_above(points))[1].any()
    )
    unread = square(grey)
    unread.view[:] = -1  # its picture turned out to be damaged
    assert not TextureSampler(unread, 0.05).colors(points, from_above(points))[1].any()
    some = np.array([[128, 128, 128], [128, 128, 127], [0, 128, 128]], np.uint8)
    assert avoid_gray(some).tolist() == [[128, 128, 127], [128, 128, 127], [0, 128, 128]]


def test_nothing_is_not_painted():
    none = np.zeros((0, 3))
    empty = TexturedMesh(
        none,
        np.zeros((0, 3), np.int32),
        np.zeros((0, 2)),
        np.zeros(0, np.int32),
        (),
        np.zeros(0, np.int32),
    )
    points = np.zeros((4, 3))
    assert not TextureSampler(empty, 0.1).colors(points, points + 1.0)[1].any()
