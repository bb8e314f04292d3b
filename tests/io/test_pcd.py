"""PCD: three encodings, viewpoints, times, and headers that lie."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stillmap.core.errors import InputError
from stillmap.core.source import Skipped
from stillmap.io import read

XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]


def header(dtype, n, data="binary", viewpoint="0 0 0 1 0 0 0", **changed):
    kinds = {"f": "F", "i": "I", "u": "U"}
    entries = {
        "VERSION": "0.7",
        "FIELDS": " ".join(dtype.names),
        "SIZE": " ".join(str(dtype[name].base.itemsize) for name in dtype.names),
        "TYPE": " ".join(kinds[dtype[name].base.kind] for name in dtype.names),
        "COUNT": " ".join(str(int(np.prod(dtype[name].shape))) for name in dtype.names),
        "WIDTH": n,
        "HEIGHT": 1,
        "VIEWPOINT": viewpoint,
        "POINTS": n,
        "DATA": data,
    } | changed
    lines = (f"{key} {value}\n" for key, value in entries.items() if value is not None)
    return ("# .PCD v0.7 - Point Cloud Data file format\n" + "".join(lines)).encode()


def made(points, fields=(), **columns):
    rows = np.zeros(len(points), [*XYZ, *fields])
    rows["x"], rows["y"], rows["z"] = np.asarray(points).T
    for name, values in columns.items():
        rows[name] = values
    return rows


def packed(rows):
    """The body of a compressed file: column by column."""
    lzf = pytest.importorskip("lzf")
    plain = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
    body = lzf.compress(plain, 2 * len(plain))
    return struct.pack("<II", len(body), len(plain)) + body


def write(path, rows, data="binary", **changed):
    body = {
        "binary": rows.tobytes,
        "binary_compressed": lambda: packed(rows),
        "ascii": lambda: "".join(
            " ".join(repr(float(v)) for value in row for v in np.atleast_1d(value)) + "\n"
            for row in rows.tolist()
        ).encode(),
    }[data]()
    path.write_bytes(header(rows.dtype, len(rows), data, **changed) + body)


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_encodings(tmp_path, data):
    rng = np.random.default_rng(3)
    fields = [("_", "u1", (3,)), ("intensity", "<f8"), ("ring", "<u2")]
    rows = made(np.round(rng.normal(0, 5, (300, 3)), 2), fields, ring=7)
    rows["x"][4] = np.nan
    write(tmp_path / "a.pcd", rows, data)
    found = read(tmp_path / "a.pcd")
    assert (found.n_scans, found.n_beams, found.hit.sum()) == (1, 300, 299)
    wanted = np.stack([rows["x"], rows["y"], rows["z"]], axis=1)
    np.testing.assert_array_equal(found.points[found.hit], wanted[np.arange(300) != 4])
    assert found.T_recorded_base is None


def test_columns_in_another_order_and_of_another_type(tmp_path):
    rows = np.zeros(2, [("z", "<f8"), ("rgb", "<u4"), ("x", "<f8"), ("y", "<i2")])
    rows["x"], rows["y"], rows["z"] = [1.5, 2.5], [3, 4], [5.5, 6.5]
    write(tmp_path / "a.pcd", rows, COUNT=None, POINTS=None, VIEWPOINT=None)
    np.testing.assert_array_equal(read(tmp_path / "a.pcd").points, [[1.5, 3, 5.5], [2.5, 4, 6.5]])


@pytest.mark.parametrize("names", [["9", "10", "100"], ["a.0", "b", "3.5"], ["1", "2", "007"]])
def test_names_that_are_no_times(tmp_path, names):
    for i, name in enumerate(names):
        write(tmp_path / f"{name}.pcd", made([[1.0 + i, 0, 0]]))
    found = read(tmp_path)
    assert found.stamp_ns.tolist() == [0, 10**9, 2 * 10**9]
    if names[0] == "9":
        assert found.points[:, 0].tolist() == [1, 2, 3]
    assert any("one second apart" in warning for warning in found.source.warnings)


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["1311868164.363181", "1311868164.4"], [1311868164363181000, 1311868164400000000]),
        (["cloud_0.5", "cloud_0.25"], [250_000_000, 500_000_000]),
        (["1305031102175304000"], [1305031102175304000]),
        (
            ["scan-1305031102175304", "scan-1305031102175305"],
            [1305031102175304000, 1305031102175305000],
        ),
        (["1305031102175"], [1305031102175000000]),
        (["-0000000000000000007", "0000000000000000007_1"], [-7, 7]),
    ],
)
def test_names_that_are_times(tmp_path, names, stamps):
    for name in names:
        write(tmp_path / f"{name}.pcd", made([[1.0, 0, 0]]))
    found = read(tmp_path)
    assert found.stamp_ns.tolist() == stamps
    assert found.source.warnings == []


def pose(i):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 0.3 * i).as_matrix()
    T[:3, 3] = 8.0 * i, 1.0, 0.0
    return T


def viewpoint(T):
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return " ".join(str(float(v)) for v in (*T[:3, 3], w, x, y, z))


@pytest.mark.parametrize("in_world", [False, True])
def test_viewpoints_are_poses_wherever_the_points_are(tmp_path, in_world):
    rng = np.random.default_rng(0)
    scans = [rng.uniform(-4, 4, (50, 3)).astype(np.float32) for _ in range(3)]
    for i, points in enumerate(scans):
        T = pose(i)
        placed = points @ T[:3, :3].T + T[:3, 3] if in_world else points
        write(tmp_path / f"{i}.pcd", made(placed), viewpoint=viewpoint(T))
    found = read(tmp_path)
    np.testing.assert_allclose(found.T_recorded_base, [pose(i) for i in range(3)], atol=1e-12)
    np.testing.assert_allclose(found.points, np.concatenate(scans), atol=1e-5)
    assert any("VIEWPOINT" in warning for warning in found.source.warnings) == in_world


@pytest.mark.parametrize("text", ["0 0 0 0 0 0 0", "1 2 3", "nan 0 0 1 0 0 0", "a b c d e f g"])
def test_a_viewpoint_that_is_none_costs_the_poses(tmp_path, text):
    write(tmp_path / "0.pcd", made([[1, 0, 0]]), viewpoint="1 0 0 1 0 0 0")
    write(tmp_path / "1.pcd", made([[1, 0, 0]]), viewpoint=text)
    found = read(tmp_path)
    assert found.n_scans == 2
    assert found.T_recorded_base is None


@pytest.mark.parametrize(
    ("kind", "name", "unit", "begin"),
    [
        ("<f4", "time", 1.0, 0.0),
        ("<f4", "time", 1.0, -0.1),
        ("<u4", "t", 1e9, 0.0),
        ("<u4", "offset_time", 1e6, 0.0),
        ("<f8", "timestamp", 1.0, 1.7e9),
        ("<u8", "timestamp", 1e9, 1.7e9),
        ("<f8", "timestamp", 1e9, 1.7e9),
        ("<f8", "time", 1e3, 0.0),
    ],
)
def test_times_of_points_in_any_unit(tmp_path, kind, name, unit, begin):
    seconds = np.linspace(0.0, 0.1, 11) + begin
    points = np.ones((11, 3))
    points[3] = np.nan  # whose time is not heeded
    rows = made(points, [(name, kind)])
    rows[name] = np.round(seconds * unit) if kind[1] == "u" else seconds * unit
    rows[name][3] = 0
    for i in range(2):
        later = rows.copy()
        if begin > 1e6:
            later[name] += np.array(i * unit).astype(kind)
        write(tmp_path / f"{1_700_000_000 + i}.0.pcd", later)
    found = read(tmp_path)
    kept = np.arange(22) % 11 != 3
    wanted = np.tile(seconds - (begin if begin > 0 else 0.0), 2)
    np.testing.assert_allclose(found.beam_time[kept], wanted[kept], atol=2e-6)
    assert found.stamp_ns.tolist() == [1_700_000_000 * 10**9, 1_700_000_001 * 10**9]


def test_absolute_times_are_stamps_where_names_are_not(tmp_path):
    for i in range(2):
        ns = 1_700_000_000_000_000_001 + i * 100_000_000 + np.arange(3, dtype="<u8") * 30_000_000
        write(tmp_path / f"{i}.pcd", made(np.ones((3, 3)), [("t", "<u8")], t=ns))
    found = read(tmp_path)
    assert found.stamp_ns.tolist() == [1_700_000_000_000_000_001, 1_700_000_000_100_000_001]
    np.testing.assert_allclose(found.beam_time, [0, 0.03, 0.06] * 2, atol=1e-7)


def test_times_that_lie_far_off_are_passed_over(tmp_path):
    ns = 1_700_000_000 * 10**9 + np.arange(9, dtype="<u8") * 10**7
    rows = made(np.ones((9, 3)), [("t", "<u8")], t=ns)
    write(tmp_path / "0.pcd", rows)
    rows["t"][[2, 5]] = 3, 2 * ns[5]
    write(tmp_path / "1.pcd", rows)
    found = read(tmp_path)
    assert found.stamp_ns.tolist() == [int(ns[0])] * 2
    wanted = np.tile(np.arange(9) * 0.01, 2)
    wanted[[11, 14]] = 0.0
    np.testing.assert_allclose(found.beam_time, wanted, atol=1e-6)


@pytest.mark.parametrize("spread", [0.0, 3.0, 3000.0 * 1.1])
def test_times_of_no_known_unit_are_not_used(tmp_path, spread):
    rows = made(np.ones((3, 3)), [("time", "<f4")], time=[0, spread / 2, spread])
    write(tmp_path / "a.pcd", rows)
    found = read(tmp_path / "a.pcd")
    unit_fits = 0.005 <= spread / 1e3 <= 2.0 or 0.005 <= spread / 1e6 <= 2.0
    assert (found.beam_time is None) == (not unit_fits)


GOOD = made([[1.0, 2, 3], [4, 5, 6]])
LIES = {
    "empty": b"",
    "nothing but a magic": b"# .PCD v0.7\n",
    "binary rubbish": b"# .PCD v0.7\n" + bytes(range(256)) * 10,
    "no fields": header(GOOD.dtype, 2, FIELDS=None) + GOOD.tobytes(),
    "no x": header(GOOD.dtype, 2, FIELDS="a y z") + GOOD.tobytes(),
    "cut": header(GOOD.dtype, 2) + GOOD.tobytes()[:-1],
    "too many points": header(GOOD.dtype, 10**18) + GOOD.tobytes(),
    "points of many digits": header(GOOD.dtype, 2, POINTS="9" * 5000) + GOOD.tobytes(),
    "points below zero": header(GOOD.dtype, 2, POINTS=-5, WIDTH=-5) + GOOD.tobytes(),
    "huge count": header(GOOD.dtype, 2, COUNT="1 1 1000000000000") + GOOD.tobytes(),
    "huge size": header(GOOD.dtype, 2, SIZE="4 4 4000000000") + GOOD.tobytes(),
    "unknown type": header(GOOD.dtype, 2, TYPE="F F X") + GOOD.tobytes(),
    "fewer sizes": header(GOOD.dtype, 2, SIZE="4 4") + GOOD.tobytes(),
    "unknown data": header(GOOD.dtype, 2, DATA="zip") + GOOD.tobytes(),
    "text cut": header(GOOD.dtype, 2, "ascii") + b"1 2 3\n",
    "text with a word": header(GOOD.dtype, 2, "ascii") + b"1 2 3\n4 five 6\n",
    "text without end": header(GOOD.dtype, 2, "ascii") + b"1" * (3 << 20),
    "huge count of text": header(GOOD.dtype, 2, "ascii", COUNT="1 999999 1") + b"1 2 3\n" * 2,
    "packed cut": header(GOOD.dtype, 2, "binary_compressed") + b"\x10\0\0\0\x18\0\0\0abc",
    "packed sizes cut": header(GOOD.dtype, 2, "binary_compressed") + b"\x10\0",
    "packed bomb": header(GOOD.dtype, 10**8, "binary_compressed")
    + struct.pack("<II", 8, 12 * 10**8 % 2**32) + bytes(8),
    "packed too large": header(GOOD.dtype, 2**40, "binary_compressed") + bytes(80),
    "packed of another size": header(GOOD.dtype, 2, "binary_compressed")
    + struct.pack("<II", 8, 2**32 - 1) + bytes(8),
    "packed rubbish": header(GOOD.dtype, 2, "binary_compressed")
    + struct.pack("<II", 8, 24) + b"\xff" * 8,
}  # fmt: skip


@pytest.mark.parametrize("what", LIES)
def test_headers_that_lie(tmp_path, what):
    if what == "packed rubbish":
        pytest.importorskip("lzf")
    write(tmp_path / "1.pcd", GOOD)
    (tmp_path / "2.pcd").write_bytes(LIES[what])
    with pytest.raises(InputError) as caught:
        read(tmp_path / "2.pcd")
    assert "2.pcd" in str(caught.value)
    found = read(tmp_path)
    assert found.n_scans == 1
    ((reason, damage),) = found.source.skipped.items()
    assert damage == Skipped(1, [2]), reason
    assert "2.pcd" in found.source.warnings[-1]


def test_a_scan_without_points_is_a_scan_in_a_folder(tmp_path):
    write(tmp_path / "1.pcd", GOOD)
    write(tmp_path / "2.pcd", GOOD[:0])
    np.testing.assert_array_equal(read(tmp_path).offset, [0, 2, 2])
    with pytest.raises(InputError, match="holds no points"):
        read(tmp_path / "2.pcd")
