"""Pictures on a mesh: the right colours at the right places, and of points beside it."""

import numpy as np
import pytest
from made_up_rooms import all_round, camera, colour, furnished, photograph
from made_up_rooms import sharpest as best_of
from marks import slow_params

from stillmap import _core
from stillmap.mesh import texture
from stillmap.mesh.texture import TexturedMesh, TextureSampler, bake_texture, fill_gutters

pytest.importorskip("xatlas")
SMALL = np.array([[200.0, 0, 139.5], [0, 200, 104.5], [0, 0, 1]])
LENSES = {
    "pinhole": {},
    "barrel": {"model": "plumb_bob", "distortion": (-0.2, 0.04, 0.002, -0.001)},
    "fisheye": {"model": "equidistant", "distortion": (0.02, -0.01, 0.0, 0.0)},
}


def errors(textured):
    """Of every texel, how far the worst of three colours is from what its place is painted with."""
    worst = []
    for page, picture in enumerate(textured.pages):
        h, w = picture.shape[:2]
        mine = np.flatnonzero((textured.page == page) & (textured.view >= 0))
        corners = textured.uv[textured.faces[mine]] * np.array([w, h], float)
        texel, of, weight = _core.rasterise_texels(corners, w, h)
        a, b, c = np.moveaxis(textured.vertices[textured.faces[mine[of]]], 1, 0)
        places = a + weight[:, :1] * (b - a) + weight[:, 1:] * (c - a)
        found = picture.reshape(-1, 3)[texel].astype(float)
        worst.append(np.abs(found - colour(places)).max(axis=1))
    return np.concatenate(worst)


@pytest.mark.parametrize("kind", ["pinhole", "fisheye", *slow_params("barrel")])
def test_every_texel_has_the_colour_of_its_place(kind, monkeypatch):
    monkeypatch.setattr(texture, "_MIN_TEXEL", 1e-5)
    mesh, views = furnished(), all_round(camera(280, 210, SMALL, **LENSES[kind]))
    view = best_of(mesh, views)
    reads = []

    def read(one):
        reads.append(one.image)
        return photograph(mesh, one)

    textured = bake_texture(mesh, view, views, read, 1024)
    assert reads == sorted(set(view[view >= 0].tolist()))  # each once
    np.testing.assert_array_equal(textured.view, view)
    np.testing.assert_array_equal(textured.vertices[textured.faces], mesh.corners)
    assert 0.3 < np.mean(textured.page >= 0) < 1.0
    error = errors(textured)
    assert len(error) > 100_000
    assert np.median(error) < 1.0
    assert np.quantile(error, 0.99) < 4.0


def test_gutters_have_the_colours_beside_them():
    page = np.zeros((20, 30, 3), np.uint8)
    page[5:9, 4:9], page[12:15, 20:28] = (200, 10, 30), (20, 240, 90)
    painted = page.any(axis=2)
    fill_gutters(page, painted, 3)
    assert (page[2:12, 1:12] == (200, 10, 30)).all()
    assert (page[9:18, 17:30] == (20, 240, 90)).all()
    assert painted.sum() == 10 * 11 + 9 * 13


ABOVE = np.array([0.5, 0.5, 9.0])


def square(page: np.ndarray, view: int = 0, z: float = 0.0) -> TexturedMesh:
    """One by one metre, seen from above, a page over all of it; x to the right, y down."""
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    where = np.full(2, 0 if view >= 0 else -1, np.int32)
    return TexturedMesh(
        np.column_stack([xy, np.full(4, z)]), faces, xy, where, (page,), np.full(2, view, np.int32)
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
