"""Where faces lie on the pages of a texture."""

import numpy as np
import pytest
from made_up_rooms import all_round, furnished, looking, rectangle, sharpest
from scipy import ndimage

from stillmap import _core
from stillmap.core import camera
from stillmap.core.square_box import component_labels
from stillmap.mesh import texture
from stillmap.mesh.texture import build_layout
from stillmap.mesh.triangle_mesh import concatenate_meshes

pytest.importorskip("xatlas")


@pytest.fixture(scope="module")
def room():
    mesh, views = furnished(), all_round()
    return mesh, views, sharpest(mesh, views)


def in_picture(mesh, views, view_of_face, faces):
    out = np.empty((len(faces), 3, 2))
    for i, f in enumerate(faces):
        view = views[view_of_face[f]]
        out[i] = camera.project(view.camera, view.to_camera(mesh.vertices[mesh.faces[f]]))[0]
    return out


def charts_of(layout):
    """(F,) number of each face's chart: faces that share vertices."""
    pairs = layout.faces[:, [0, 1, 1, 2]].reshape(-1, 2).astype(np.intp)
    chart = component_labels(pairs, len(layout.vertex))[layout.faces[:, 0]]
    return np.where(layout.page >= 0, chart, -1)


def test_texels_are_pixels(room, monkeypatch):
    monkeypatch.setattr(texture, "_MIN_TEXEL", 1e-5)
    mesh, views, view = room
    layout = build_layout(mesh, view, views)
    painted = np.flatnonzero(view >= 0)
    assert len(painted) > 400
    np.testing.assert_array_equal(layout.view, view)
    np.testing.assert_array_equal(layout.page >= 0, view >= 0)
    np.testing.assert_array_equal(layout.vertex[layout.faces], mesh.faces)
    assert (layout.scale[np.unique(view[painted])] == 1.0).all()
    apart = layout.uv[layout.faces[painted]] - in_picture(mesh, views, view, painted)
    # centres of texels, at halves, on centres of pixels, at whole numbers
    apart -= 0.5
    np.testing.assert_allclose(apart, np.rint(apart), atol=1e-6)
    # the faces of a chart are moved alike
    chart = charts_of(layout)[painted]
    assert len(np.unique(chart)) >= 8
    for number in np.unique(chart):
        assert np.ptp(np.rint(apart[chart == number]), axis=(0, 1)).max() == 0


def chart_of_texel(layout, page):
    w, h = layout.sizes[page]
    mine = np.flatnonzero(layout.page == page)
    texel, of, _ = _core.rasterise_texels(layout.uv[layout.faces[mine]], int(w), int(h))
    out = np.full(w * h, -1)
    out[texel] = charts_of(layout)[mine[of]]
    return out.reshape(h, w)


@pytest.mark.parametrize("gutter", [2, 4])
def test_charts_keep_apart(room, gutter, monkeypatch):
    mesh, views, view = room
    monkeypatch.setattr(texture, "GUTTER", gutter)
    monkeypatch.setattr(texture, "_MIN_TEXEL", 0.01)
    layout = build_layout(mesh, view, views, 512)
    charts = set()
    for page in range(len(layout.sizes)):
        chart = chart_of_texel(layout, page)
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
