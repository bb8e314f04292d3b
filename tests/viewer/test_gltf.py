"""Checks of glTF files before they are shown."""

import struct

import pytest
from made_up_models import glb_of

from stillmap.core.errors import InputError
from stillmap.results.gltf import read_glb


def refusal(path, data, most=1 << 20):
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_glb(path, most)
    assert caught.value.where == str(path)
    return caught.value.what


def test_self_contained_model_is_read_unchanged(tmp_path, glb):
    (tmp_path / "a.glb").write_bytes(glb)
    assert read_glb(tmp_path / "a.glb", len(glb)) == glb


@pytest.mark.parametrize(
    "document",
    [
        {"images": [{"uri": "https://example.org/a.png"}]},
        {"buffers": [{"uri": "//example.org/a.bin"}]},
        {"extensions": {"any": [{"deep": {"uri": "a.bin"}}]}},
        {"images": [{"uri": 3}]},
    ],
)
def test_reference_to_another_file_is_refused(tmp_path, document):
    assert "another file" in refusal(tmp_path / "a.glb", glb_of(document))


def test_compressed_model_is_refused(tmp_path):
    data = glb_of({"extensionsUsed": ["KHR_draco_mesh_compression"]})
    assert "draco" in refusal(tmp_path / "a.glb", data)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"glTF",
        glb_of({}, magic=b"GLTF"),
        glb_of({}, version=1),
        glb_of({}) + b"more",
        glb_of([]),
        struct.pack("<4sIII4s", b"glTF", 2, 20, 1 << 31, b"JSON"),
        struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"\xff\xff\xff\xff",
    ],
)
def test_damaged_model_is_refused(tmp_path, data):
    assert "no complete .glb" in refusal(tmp_path / "a.glb", data)
