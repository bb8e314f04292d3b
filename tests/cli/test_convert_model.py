"""`stillmap convert DIR -o model.obj`: export of the model as OBJ."""

import json
import os

import numpy as np
import pytest

from stillmap.mesh.texture import TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.results.gltf import write_glb

trimesh = pytest.importorskip("trimesh")

PNG = 0


def model():
    """An upright square 2 m ahead, 5 km away from the map's origin: half on a page, half grey."""
    corners = np.array([[2.0, 0, 0], [2, 0, 1], [2, 1, 1], [2, 1, 0]])
    vertices = corners[[0, 1, 2, 0, 2, 3]] + [5000.0, 0, 0]
    faces = np.arange(6, dtype=np.int32).reshape(2, 3)
    uv = np.array([[0.25, 0.75], [0.25, 0.25], [0.75, 0.25], [0, 0], [0, 0], [0, 0]])
    page = np.random.default_rng(0).integers(0, 255, (32, 48, 3)).astype(np.uint8)
    of_face = np.array([0, -1], np.int32)
    return TexturedMesh(vertices, faces, uv, of_face, (page,), of_face)


@pytest.fixture
def out(tmp_path):
    """As much of a result as is needed."""
    folder = tmp_path / "out"
    folder.mkdir()
    options = {"mesh": {"texture_quality": 0}}
    record = {"input": {"path": str(tmp_path / "gone")}, "options": options}
    (folder / "run.json").write_text(json.dumps(record))
    write_glb(folder / "mesh.glb", model(), PNG)
    return folder


def test_model_with_textures(out, call, tmp_path):
    done = call("convert", out, "-o", tmp_path / "a.obj")
    assert done.returncode == 0, done.stderr
    assert "2 faces and 1 page of texture" in done.stderr
    assert sorted(os.listdir(tmp_path)) == ["a.mtl", "a.obj", "a_page0.png", "out"]
    scene = trimesh.load_scene(tmp_path / "a.obj", process=False)
    by_name = {part.visual.material.name: part for part in scene.geometry.values()}
    assert set(by_name) == {"page0", "grey"}
    wanted, page = model(), by_name["page0"]
    x, y, z = wanted.vertices[:3].T
    np.testing.assert_allclose(page.vertices, np.stack([x, z, -y], axis=1), atol=1e-6)
    u, v = wanted.uv[:3].T
    np.testing.assert_allclose(page.visual.uv, np.stack([u, 1 - v], axis=1), atol=1e-6)
    image = np.asarray(page.visual.material.image.convert("RGB"))
    np.testing.assert_array_equal(image, wanted.pages[0])
    assert by_name["grey"].visual.material.diffuse[:3].tolist() == [128, 128, 128]


def test_model_without_images(out, call, tmp_path):
    write_glb(out / "mesh.glb", Mesh(model().vertices, model().faces))
    assert call("convert", out, "-o", tmp_path / "a.obj", "--quiet").returncode == 0
    assert sorted(os.listdir(tmp_path)) == ["a.mtl", "a.obj", "out"]
    assert "vt " not in (tmp_path / "a.obj").read_text()


@pytest.mark.parametrize("there", ["a.obj", "a.mtl", "a_page0.png"])
def test_overwrite_flag(out, call, tmp_path, there):
    (tmp_path / there).write_text("mine")
    done = call("convert", out, "-o", tmp_path / "a.obj")
    assert done.returncode == 2
    assert f"{there}: is there already" in done.stderr
    assert sorted(os.listdir(tmp_path)) == sorted([there, "out"])
    assert call("convert", out, "-o", tmp_path / "a.obj", "--overwrite").returncode == 0
    assert (tmp_path / there).read_bytes() != b"mine"


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda _: None, "holds no model"),
        (lambda data: data[:-40], "no complete .glb"),
        (lambda data: data.replace(b'"bufferView":0', b'"bufferView":9'), "is damaged"),
        (lambda data: data.replace(b"\x89PNG", b"\x89PNK"), "is damaged"),
    ],
)
def test_damaged_and_missing_models(out, call, tmp_path, damage, said):
    data = damage((out / "mesh.glb").read_bytes())
    (out / "mesh.glb").unlink()
    if data is not None:
        (out / "mesh.glb").write_bytes(data)
    done = call("convert", out, "-o", tmp_path / "a.obj")
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert os.listdir(tmp_path) == ["out"]


def test_full_disk_leaves_nothing(out, call, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    done = call("convert", out, "-o", tmp_path / "a.obj")
    assert done.returncode == 2
    assert "No space left" in done.stderr
    assert os.listdir(tmp_path) == ["out"]


def test_only_is_refused(out, call, tmp_path):
    done = call("convert", out, "-o", tmp_path / "a.obj", "--only", "static")
    assert done.returncode == 2
    assert "--only is for clouds" in done.stderr
