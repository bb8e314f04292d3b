"""PLY, LAS and LAZ clouds, damaged and hostile ones too."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from peak_memory import READ, run_measured

from stillmap.core.errors import InputError
from stillmap.core.source import Skipped
from stillmap.io import read
from stillmap.io.point_cloud import las

VERTICES = "element vertex 2\nproperty float x\nproperty float y\nproperty double z\n"
ROWS = np.array([(1, 2, 3), (4, 5, 6)], [("x", "<f4"), ("y", "<f4"), ("z", "<f8")])


def ply(path, header, body=b"", kind="binary_little_endian"):
    path.write_bytes(f"ply\nformat {kind} 1.0\n{header}end_header\n".encode() + body)
    return path


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply(tmp_path, kind):
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    before, after = np.array([7, 8], f"{order}i2"), np.array([1], f"{order}i4")
    header = (
        f"comment made by hand\nelement camera 2\nproperty short a\n{VERTICES}"
        "element face 1\nproperty list uchar int vertex_indices\n"
    )
    rows = ROWS.astype([(name, f"{order}{t[1:]}") for name, t in ROWS.dtype.descr])
    body = before.tobytes() + rows.tobytes() + b"\x01" + after.tobytes()
    if kind == "ascii":
        body = b"7\n8\n1 2 3\n4 5 6\n1 1\n"
    found = read(ply(tmp_path / "a.ply", header, body, kind))
    np.testing.assert_array_equal(found.points, [[1, 2, 3], [4, 5, 6]])
    assert found.T_recorded_base is None
    assert "beams start at the origin" in found.source.warnings[0]


def test_a_folder_of_ply_shares_its_zero(tmp_path):
    for i in range(3):
        rows = ROWS.copy()
        rows["z"] += 1e6 + i
        ply(tmp_path / f"{i}.ply", VERTICES, rows.tobytes() if i != 1 else b"")
    found = read(tmp_path)
    assert found.n_scans == 2
    assert found.source.skipped == {"is truncated": Skipped(1, [2])}
    assert found.source.skipped_unit == "file"
    np.testing.assert_allclose(found.points[2:] - found.points[:2], [[0, 0, 2]] * 2)


@pytest.mark.parametrize(
    "content",
    [
        b"ply\n",
        b"ply\nformat binary_little_endian 1.0\nend_header\n",
        b"ply\nelement vertex 2\nproperty float x\nend_header\n",
        b"ply\nformat nonsense 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        b"ply\nformat ascii 1.0\nproperty float x\nelement vertex 1\nend_header\n1\n",
        b"ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n1\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\nend_header\n1\n",
        f"ply\nformat ascii 1.0\n{VERTICES}end_header\n1 2 3\n4 5\n".encode(),
        f"ply\nformat ascii 1.0\n{VERTICES}end_header\n".encode(),
        f"ply\nformat binary_little_endian 1.0\n{VERTICES}end_header\n".encode() + bytes(31),
        b"ply\nformat binary_little_endian 1.0\nelement a 99999999999999\nproperty int a\n"
        + f"{VERTICES}end_header\n".encode() + bytes(32),
        b"ply\nformat binary_little_endian 1.0\nelement a 1\nproperty list int int a\n"
        + f"{VERTICES}end_header\n".encode() + bytes(40),
    ],
)  # fmt: skip
def test_ply_that_lies(tmp_path, content):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.ply: "):
        read(tmp_path / "a.ply")


@pytest.fixture(params=["las", "laz"])
def survey(request, space, tmp_path):
    """A file that was written well, its ending."""
    pytest.importorskip("laspy")
    path = tmp_path / f"a.{request.param}"
    las.write(replace(space, T_recorded_base=None), path, space.T_recorded_base)
    return path


@pytest.mark.parametrize(
    ("at", "form", "value"),
    [
        (96, "<I", 2**31),  # where points begin
        (100, "<I", 2**32 - 1),  # how many records come before
        (105, "<H", 65535),  # bytes of a point
        (107, "<I", 2**32 - 1),  # points
        (104, "<B", 200),  # format of points
    ],
)
def test_las_that_lies(survey, at, form, value):
    content = bytearray(survey.read_bytes())
    struct.pack_into(form, content, at, value)
    survey.write_bytes(content)
    with pytest.raises(InputError, match=r"is (damaged|truncated)"):
        read(survey)


@pytest.mark.parametrize("kept", [4, 100, 226, 227, 400, -20])
def test_las_that_is_cut(survey, kept):
    survey.write_bytes(survey.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"is (damaged|truncated|no LAS)"):
        read(survey)


def test_chunks_that_are_not_there_do_not_end_the_process(survey):
    content = bytearray(survey.read_bytes())
    if survey.suffix == ".las":
        pytest.skip("has no chunks")
    (start,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, start)
    struct.pack_into("<I", content, table + 4, 2**32 - 1)
    survey.write_bytes(content)
    with pytest.raises(InputError, match="table of chunks"):
        read(survey)


def test_layers_that_are_not_there_take_no_memory(tmp_path):
    laspy = pytest.importorskip("laspy")
    path = tmp_path / "a.laz"
    header = laspy.LasHeader(point_format=6, version="1.4")
    with laspy.open(path, "w", header=header) as writer:
        writer.write_points(laspy.ScaleAwarePointRecord.zeros(30, header=header))
    content = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", content, 96)
    # after the first point and the count of points: bytes of the second layer
    struct.pack_into("<I", content, start + 8 + 30 + 4 + 4, 2**32 - 1)
    path.write_bytes(content)
    said, peak = run_measured(READ, path)
    assert said == [f"{path}: is damaged: the sizes of its layers"]
    assert peak < 500


PACKED = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA binary_compressed\n\x08\0\0\0\x18"


@pytest.mark.parametrize(
    ("name", "start", "library"),
    [
        *(("a.las", b"LASF", "laspy"), ("a.e57", b"ASTM-E57", "pye57")),
        ("a.pcd", PACKED, "lzf"),
    ],
)
def test_missing_libraries_are_named(tmp_path, monkeypatch, name, start, library):
    (tmp_path / name).write_bytes(start + bytes(300))

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr("stillmap.core.errors.import_module", missing)
    for path in (tmp_path / name, tmp_path):
        with pytest.raises(InputError, match=rf"needs {library} .*pip install .*\[io\]"):
            read(path)
