"""Pictures on a mesh: the right colours at the right places."""

import numpy as np
import pytest
from made_up_rooms import all_round, camera, colour, furnished, photograph
from made_up_rooms import sharpest as best_of
from marks import slow_params

from stillmap import _core
from stillmap.mesh import texture
from stillmap.mesh.texture import (
    bake_texture,
    fill_gutters,
)

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
