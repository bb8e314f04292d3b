"""Models as files: whole or not at all, the same bytes every time."""

import json
import os
import struct
import subprocess
import sys

import numpy as np
import pytest

from stillmap.core.errors import InputError
from stillmap.mesh.texture import TexturedMesh
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.results.gltf import write_glb

pytest.importorskip("trimesh")


def textured():
    """A square: one half on a page, the other one grey."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [0, 0, 0], [1, 0, 1]])
    faces = np.array([[0, 1, 2], [4, 5, 3]], np.int32)
    uv = np.array([[0.25, 0.75], [0.75, 0.75], [0.75, 0.25], [0, 0], [0, 0], [0, 0]])
    page = np.random.default_rng(0).integers(0, 255, (32, 48, 3)).astype(np.uint8)
    of_face = np.array([0, -1], np.int32)
    return TexturedMesh(vertices, faces, uv, of_face, (page,), of_face)


def tree_of(path):
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + size])


def test_what_stands_in_the_file(tmp_path):
    write_glb(tmp_path / "a.glb", textured())
    tree = tree_of(tmp_path / "a.glb")
    assert tree["asset"] == {"version": "2.0", "generator": "stillmap"}
    assert [mesh["name"] for mesh in tree["meshes"]] == ["page0", "grey"]
    page, grey = tree["materials"]
    assert page["extensions"] == {"KHR_materials_unlit": {}}
    assert "extensions" not in grey
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    # 128 of sRGB
    assert grey["pbrMetallicRoughness"]["baseColorFactor"][0] == pytest.approx(0.216, abs=2e-3)
    assert tree["samplers"][0]["wrapS"] == tree["samplers"][0]["wrapT"] == 33071
    assert tree["images"] == [
        {"bufferView": tree["images"][0]["bufferView"], "mimeType": "image/jpeg"}
    ]
    low = [
        tree["accessors"][m["primitives"][0]["attributes"]["POSITION"]]["min"]
        for m in tree["meshes"]
    ]
    assert low == [[0, 0, 0], [0, 0, 0]]
    # nothing depends on where or by whom it was made
    assert str(tmp_path) not in json.dumps(tree)


def test_y_is_up(tmp_path):
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 2, 3], [0, 2, 0]]), np.array([[0, 1, 2]], np.int32))
    write_glb(tmp_path / "a.glb", mesh)
    tree = tree_of(tmp_path / "a.glb")
    assert tree["accessors"][1]["max"] == [1, 3, 0]
    assert tree["accessors"][1]["min"] == [0, 0, -2]
    assert "extensionsUsed" not in tree


MAKE = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_meshes import textured, write_glb
write_glb(Path(sys.argv[2]) / "a.glb", textured())
"""


@pytest.mark.slow
def test_the_same_bytes_every_time(tmp_path):
    made = []
    for seed in ("1", "2"):
        folder = tmp_path / seed
        folder.mkdir()
        here = os.path.dirname(os.path.abspath(__file__))
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        words = [sys.executable, "-c", MAKE, here, str(folder)]
        subprocess.run(words, check=True, env=environment, timeout=120)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        made.append({str(path.relative_to(folder)): path.read_bytes() for path in files})
    assert set(made[0]) == {"a.glb"}
    assert made[0] == made[1]


def test_whole_or_not_at_all(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="cannot be written"):
        write_glb(tmp_path / "missing" / "a.glb", textured())
    with pytest.raises(ValueError, match="without faces"):
        write_glb(tmp_path / "a.glb", Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)))
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(InputError, match="cannot be written"):
        write_glb(tmp_path / "a.glb", textured())
    assert not list(tmp_path.iterdir())
