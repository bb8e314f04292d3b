"""Where faces lie on the pages of a texture."""

import numpy as np
import pytest
from made_up_rooms import all_round, furnished, looking, rectangle, sharpest
from scipy import ndimage

from stillmap import _core
from stillmap.core import camera
from stillmap.mesh.texture import atlas
from stillmap.mesh.texture.atlas import build_layout, find_charts
from stillmap.mesh.triangle_mesh import Mesh, concatenate_meshes

pytest.importorskip("xatlas")


@pytest.fixture(scope="module")
def room():
    mesh, views = furnished(), all_round()
    return mesh, views, sharpest(mesh, views)


def areas(corners):
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def in_picture(mesh, views, view_of_face, faces):
    out = np.empty((len(faces), 3, 2))
    for i, f in enumerate(faces):
        view = views[view_of_face[f]]
        out[i] = camera.project(view.camera, view.to_camera(mesh.vertices[mesh.faces[f]]))[0]
    return out


def test_texels_are_pixels(room, monkeypatch):
    monkeypatch.setattr(atlas, "_MIN_TEXEL", 1e-5)
    mesh, views, view = room
    layout = build_layout(mesh, view, views)
    painted = np.flatnonzero(view >= 0)
    assert len(painted) > 400
    np.testing.assert_array_equal(layout.view, view)
    np.testing.assert_array_equal(layout.page >= 0, view >= 0)
    np.testing.assert_array_equal(layout.vertex[layout.faces], mesh.faces)
    assert (layout.scale == 1.0).all()
    apart = layout.uv[layout.faces[painted]] - in_picture(mesh, views, view, painted)
    # centres of texels, at halves, on centres of pixels, at whole numbers
    apart -= 0.5
    np.testing.assert_allclose(apart, np.rint(apart), atol=1e-6)
    # the corners of a face are moved alike, and so are faces of a chart
    np.testing.assert_allclose(apart, apart[:, :1].repeat(3, axis=1), atol=1e-6)
    chart = find_charts(mesh, view)[painted]
    for number in np.unique(chart):
        assert np.ptp(np.rint(apart[chart == number]), axis=(0, 1)).max() == 0


def chart_of_texel(mesh, layout, page):
    w, h = layout.sizes[page]
    mine = np.flatnonzero(layout.page == page)
    texel, of, _ = _core.rasterise_texels(layout.uv[layout.faces[mine]], int(w), int(h))
    out = np.full(w * h, -1)
    out[texel] = find_charts(mesh, layout.view)[mine[of]]
    return out.reshape(h, w)


@pytest.mark.parametrize("gutter", [2, 4])
def test_charts_keep_apart(room, gutter, monkeypatch):
    mesh, views, view = room
    monkeypatch.setattr(atlas, "GUTTER", gutter)
    monkeypatch.setattr(atlas, "_MIN_TEXEL", 0.01)
    layout = build_layout(mesh, view, views, 512)
    charts = set()
    for page in range(len(layout.sizes)):
        chart = chart_of_texel(mesh, layout, page)
        charts.update(np.unique(chart).tolist())
        # no chart within the gutters of another, nor beyond the page
        size = 2 * gutter + 1
        most = ndimage.maximum_filter(chart, size)
        least = ndimage.minimum_filter(np.where(chart < 0, 1 << 30, chart), size)
        near = (most >= 0) & (least < 1 << 30)
        np.testing.assert_array_equal(most[near], least[near])
        rim = np.ones_like(chart, bool)
        rim[gutter - 1 : 1 - gutter, gutter - 1 : 1 - gutter] = False
        assert (chart[rim] < 0).all()
    assert len(charts) > 8


def test_pages_are_as_many_as_needed_and_no_more_than_allowed(room, monkeypatch):
    mesh, views, view = room
    painted = view >= 0
    before = None
    for pages in (20, 3, 1):
        monkeypatch.setattr(atlas, "_MAX_PAGES", pages)
        monkeypatch.setattr(atlas, "_MIN_TEXEL", 1e-5)
        layout = build_layout(mesh, view, views, 256)
        assert 1 <= len(layout.sizes) <= pages
        assert (layout.sizes <= 256).all()
        uv = layout.uv[layout.faces[painted]]
        assert (uv >= 0).all()
        assert (uv <= layout.sizes[layout.page[painted], None]).all()
        scale = layout.scale[painted].max()
        assert before is None or scale < before
        before = scale
    monkeypatch.setattr(atlas, "_MAX_PAGES", 8)
    assert len(build_layout(mesh, view, views).sizes) == 1


def test_texels_are_no_finer_than_asked_for(room, monkeypatch):
    monkeypatch.setattr(atlas, "_MIN_TEXEL", 0.02)
    mesh, views, view = room
    layout = build_layout(mesh, view, views)
    painted = view >= 0
    assert (layout.scale[painted] < 1.0).all()
    chart = find_charts(mesh, view)
    texels = np.bincount(chart[painted], areas(layout.uv[layout.faces[painted]]))
    metres = np.bincount(chart[painted], mesh.areas()[painted])
    np.testing.assert_allclose(np.sqrt(metres / texels), 0.02, rtol=1e-6)


def test_faces_that_their_picture_does_not_show_are_grey():
    wall = rectangle([-1.0, 3.0, -1.0], [2, 0, 0], [0, 0, 2], 2)
    behind = rectangle([-1.0, -3.0, -1.0], [2, 0, 0], [0, 0, 2], 2)
    edge_on = rectangle([0.0, 1.0, 0.0], [0, 1, 0], [0, 2, 0], 1)
    mesh = concatenate_meshes([wall, behind, edge_on])
    view = looking([0, 0, 0], [0, 1, 0])
    layout = build_layout(mesh, np.zeros(len(mesh), np.int32), [view])
    assert (layout.page[: len(wall)] == 0).all()
    assert (layout.page[len(wall) :] == -1).all()
    assert (layout.view[len(wall) :] == -1).all()
    np.testing.assert_array_equal(layout.vertex[layout.faces], mesh.faces)


def test_pictures_from_one_place_and_charts_that_touch_stay_apart():
    # alternating as on a chessboard: charts of one picture meet in corners, and where pictures
    # from the same place meet, their pixels are the same
    wall = rectangle([-1.0, 3.0, -1.0], [2, 0, 0], [0, 0, 2], 6)
    square = np.tile(np.arange(36), 2)
    view = ((square // 6 + square % 6) % 2).astype(np.int32)
    views = [looking([0, 0, 0], [0, 1, 0], i) for i in range(2)]
    layout = build_layout(wall, view, views)
    assert len(np.unique(find_charts(wall, view))) == 36
    assert (layout.page == 0).all()
    assert len(layout.vertex) == 36 * 4
    chart = chart_of_texel(wall, layout, 0)
    covered = np.bincount(chart[chart >= 0], minlength=36)
    np.testing.assert_allclose(covered, (300 / 9) ** 2, rtol=0.1)


def test_no_faces_and_no_pictures():
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    layout = build_layout(nothing, np.zeros(0, np.int32), [])
    assert len(layout.faces) == len(layout.sizes) == 0
    wall = rectangle([-1.0, 3.0, -1.0], [2, 0, 0], [0, 0, 2])
    layout = build_layout(wall, np.full(2, -1, np.int32), [])
    np.testing.assert_array_equal(layout.vertex[layout.faces], wall.faces)
    assert len(layout.sizes) == 0


def test_it_is_the_same_every_time(room):
    mesh, views, view = room
    one, two = (build_layout(mesh, view, views) for _ in range(2))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(one, two, strict=True))
