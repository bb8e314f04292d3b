"""Models, opened by other programs."""

from functools import partial

import numpy as np
import pytest
from made_up_rooms import all_round, furnished, looking, photograph, rectangle, sharpest
from opening_models import shown, validated

from stillmap.mesh.texture import bake_texture
from stillmap.mesh.triangle_mesh import concatenate_meshes
from stillmap.results.gltf import write_glb

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("xatlas")

# red and green above, blue and yellow below
CORNERS = np.array([[[230, 30, 40], [20, 200, 60]], [[40, 50, 220], [240, 220, 30]]], np.uint8)


@pytest.fixture(scope="module")
def room():
    mesh, views = furnished(), all_round()
    read = partial(photograph, mesh, finer=1)
    return bake_texture(mesh, sharpest(mesh, views), views, read, 512)


@pytest.fixture(scope="module")
def poster():
    """A wall 3 m ahead with a poster of four colours; no picture shows the floor, and a low wall
    to the left."""
    wall = rectangle([-2.0, 3.0, -1.4], [4, 0, 0], [0, 0, 2.9], 4)
    floor = rectangle([-2.0, 0.5, -1.4], [4, 0, 0], [0, 2.5, 0], 2)
    low = rectangle([-2.0, 0.5, -1.4], [0, 2.5, 0], [0, 0, 1.4], 2)
    mesh = concatenate_meshes([wall, floor, low])
    view = np.zeros(len(mesh), np.int32)
    view[len(wall) :] = -1
    picture = CORNERS.repeat(150, axis=0).repeat(200, axis=1)
    return bake_texture(mesh, view, [looking([0, 0, 0], [0, 1, 0])], lambda _: picture)


@pytest.fixture(scope="module")
def written(room, poster, tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    paths = {name: folder / f"{name}.glb" for name in ("room", "png", "plain", "poster", "far")}
    write_glb(paths["room"], room)
    write_glb(paths["png"], room, 0)
    write_glb(paths["plain"], furnished())
    write_glb(paths["poster"], poster)
    far = rectangle([4e5, 5e6, 100.0], [4, 0, 0], [0, 0, 3])
    write_glb(paths["far"], far)
    return paths


def test_validator_reports_no_issue(written, room):
    reports = validated(*written.values())
    for name, report in zip(written, reports, strict=True):
        issues = report["issues"]
        codes = {issue["code"] for issue in issues["messages"]}
        assert issues["numErrors"] == issues["numWarnings"] == issues["numHints"] == 0, (
            name,
            codes,
        )
        # pages are cut to what they hold
        assert codes <= {"IMAGE_NPOT_DIMENSIONS"}, name
    assert reports[0]["info"]["totalTriangleCount"] == len(room)
    assert reports[0]["info"]["extensionsUsed"] == ["KHR_materials_unlit"]
    assert len(room.pages) > 1


def test_trimesh_reads_it_back(written, room):
    scene = trimesh.load(written["room"])
    parts = {name: part for name, part in scene.geometry.items() if name != "grey"}
    assert len(parts) == len(room.pages)
    assert sum(len(part.faces) for part in scene.geometry.values()) == len(room)
    for number, page in enumerate(room.pages):
        part, mine = parts[f"page{number}"], room.page == number
        picture = np.asarray(part.visual.material.baseColorTexture)
        assert picture.shape == page.shape
        assert np.abs(picture.astype(int) - page).mean() < 3.0
        found = part.vertices[part.faces][..., [0, 2, 1]] * [1, -1, 1]
        np.testing.assert_allclose(found, room.vertices[room.faces[mine]], atol=1e-6)
        uv = part.visual.uv[part.faces] * [1, -1] + [0, 1]
        np.testing.assert_allclose(uv, room.uv[room.faces[mine]], atol=1e-6)


def test_lossless_textures(written, room):
    scene = trimesh.load(written["png"])
    for number, page in enumerate(room.pages):
        picture = scene.geometry[f"page{number}"].visual.material.baseColorTexture
        np.testing.assert_array_equal(np.asarray(picture), page)


def test_large_coordinates_keep_their_millimetres(written):
    scene = trimesh.load(written["far"])
    found = np.sort(scene.to_mesh().vertices[:, [0, 2, 1]] * [1, -1, 1], axis=0)
    wall = rectangle([4e5, 5e6, 100.0], [4, 0, 0], [0, 0, 3]).vertices
    np.testing.assert_allclose(found, np.sort(wall, axis=0), atol=1e-6)


def test_browser_shows_photographed_colors(written, tmp_path):
    picture = shown(written["poster"], [0, 0, 0], [0, 0, -1], tmp_path)
    # 60 degrees in 400 rows, 3 m ahead: 115 pixels per metre
    for row, column in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        found = picture[200 + 80 * row, 300 + 80 * column].astype(int)
        expected = CORNERS[(row + 1) // 2, (column + 1) // 2]
        assert np.abs(found - expected).max() <= 6, (row, column, found)
    assert (picture[5, 5] == 255).all()  # beyond the wall


def test_browser_shades_grey_faces(written, tmp_path):
    picture = shown(written["poster"], [0, 0, 0], [0, 0, -1], tmp_path)
    # linear 0.216 under a light of 3 / pi from above, and half of that and half of 0.246 from aside
    for row, column, expected in ((390, 300, 126), (297, 23, 101)):
        assert np.abs(picture[row, column].astype(int) - expected).max() <= 3, (row, column)


def test_browser_shows_a_room(written, tmp_path):
    for name, shades in (("room", 1000), ("plain", 10)):
        # from within; y up, so that -z is ahead
        picture = shown(written[name], [1.0, 1.5, -1.0], [3.0, 0.8, -4.0], tmp_path)
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > shades
        assert np.mean((picture == 255).all(axis=2)) < 0.01  # no holes
