"""`stillmap filter` of point clouds: points go, every other byte stays."""

import struct

import numpy as np
import pytest
from flat import files_of
from labelled import N, check_same_but, cloud, label, run

from stillmap.io import read


def pcd_bytes(rows, kind, height=1, extra=b""):
    """x, a byte of padding, a ring, y, z, intensity, in an encoding."""
    dtype = np.dtype(
        {
            "names": ["x", "_", "ring", "y", "z", "i"],
            "formats": ["<f4", "u1", "<u2", "<f4", "<f4", "<f4"],
            "offsets": [0, 4, 5, 7, 11, 15],
            "itemsize": 19,
        }
    )
    table = np.zeros(len(rows), dtype)
    for name, column in zip("xyzi", rows.T, strict=True):
        table[name] = column
    table["ring"] = np.arange(len(rows)) % 16
    head = (
        "# .PCD v0.7 - made by hand\r\nVERSION 0.7\nFIELDS x _ ring y z i\nSIZE 4 1 2 4 4 4\n"
        f"TYPE F U U F F F\nCOUNT 1 1 1 1 1 1\nWIDTH   {len(rows) // height} \n"
        f"HEIGHT {height}\nVIEWPOINT 1 2 0 1 0 0 0\nPOINTS {len(rows)}\nDATA {kind}\n"
    )
    if kind == "ascii":
        lines = ("  ".join(str(value) for value in row.tolist()) + " \n" for row in table)
        return head.encode() + "\n".join(lines).encode() + extra
    if kind == "binary":
        return head.encode() + table.tobytes() + extra
    lzf = pytest.importorskip("lzf")
    data = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in dtype.names)
    packed = lzf.compress(data, 2 * len(data) + 64) if data else b""
    return head.encode() + struct.pack("<II", len(packed), len(data)) + packed + extra


KINDS = ("ascii", "binary", "binary_compressed")


@pytest.mark.parametrize("kind", KINDS)
def test_pcd_folder(call, tmp_path, kind):
    """Equal to a file written without the points; scans are not in the order of their stamps."""
    (tmp_path / "pcd/more").mkdir(parents=True)
    (tmp_path / "pcd/more/notes.txt").write_text("kept")
    names = ("cloud_2.5", "cloud_1.5", "cloud_10.25", "cloud_3.5")
    scans = {name: cloud() for name in names}
    for name, rows in scans.items():
        (tmp_path / f"pcd/{name}.pcd").write_bytes(pcd_bytes(rows, kind, extra=b"tail"))
    (tmp_path / "pcd/cloud_3.5.pcd").write_bytes(b"VERSION 0.7\n")
    recording, blank = label(tmp_path / "pcd", tmp_path / "out")
    assert run(call, tmp_path / "out", tmp_path / "clean")["scans_left_out"] == 1
    after = files_of(tmp_path / "clean")
    assert after.pop("more/notes.txt") == b"kept"
    for scan, name in enumerate(("cloud_1.5", "cloud_2.5", "cloud_10.25")):
        kept = ~blank[recording.beams_of(scan)]
        written = after.pop(f"{name}.pcd")
        rings = np.arange(N)[kept] % 16
        expected = pcd_bytes(scans[name][kept], kind, extra=b"tail")
        if kind == "ascii":  # the ring is the third word
            words = [line.split() for line in written.splitlines()[11:-1] if line.strip()]
            assert [int(one[2]) for one in words] == rings.tolist()
            expected = [one.split() for one in expected.splitlines() if one.strip()]
            written = [one.split() for one in written.splitlines() if one.strip()]
            assert written[:11] == expected[:11]
            assert [one[3:] for one in written] == [one[3:] for one in expected]
        elif kind == "binary":
            table = np.frombuffer(written[-4 - 19 * len(rings) : -4], "V19").copy()
            np.testing.assert_array_equal(table.view("u1").reshape(-1, 19)[:, 5], rings)
            table.view("u1").reshape(-1, 19)[:, 5] = np.arange(len(rings)) % 16
            assert written[: -4 - 19 * len(rings)] + table.tobytes() + b"tail" == expected
        else:
            assert written.endswith(b"tail")
            assert written.split(b"DATA")[0] == expected.split(b"DATA")[0]
    assert not after
    check_same_but(recording, tmp_path / "clean", blank)


@pytest.mark.parametrize("kind", KINDS)
def test_organised_pcd_keeps_its_rows(call, tmp_path, kind):
    (tmp_path / "pcd").mkdir()
    source = tmp_path / "pcd/a.pcd"
    source.write_bytes(pcd_bytes(cloud(), kind, height=4))
    recording, blank = label(source, tmp_path / "out")
    run(call, tmp_path / "out", tmp_path / "clean.pcd")
    again = read(tmp_path / "clean.pcd")
    np.testing.assert_array_equal(again.hit, recording.hit & ~blank)
    assert np.isnan(again.points[blank]).all()
    before, after = source.read_bytes(), (tmp_path / "clean.pcd").read_bytes()
    assert before.split(b"DATA")[0] == after.split(b"DATA")[0]
    if kind == "binary":
        rows = [np.frombuffer(data[-19 * N :], "u1").reshape(N, 19) for data in (before, after)]
        np.testing.assert_array_equal(rows[0][~blank], rows[1][~blank])
        other = [4, 5, 6, 15, 16, 17, 18]  # padding, ring, intensity
        np.testing.assert_array_equal(rows[0][:, other], rows[1][:, other])


def ply_bytes(rows, form, faces=False):
    head = f"ply\nformat {form} 1.0\ncomment by hand\nelement sensor 1\nproperty int id\n"
    head += f"element vertex {len(rows)}\nproperty uchar r\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "i"))
    head += "element face 1\nproperty list uchar int vertex_indices\n" * faces
    head = (head + "end_header\n").replace(
        "element sensor 1\nproperty int id\n",
        "" if not faces else "element sensor 1\nproperty int id\n",
    )
    if form == "ascii":
        lines = [f"{k % 7} " + " ".join(map(repr, row)) for k, row in enumerate(rows.tolist())]
        return (head + "9\n" * faces + "\n".join(lines) + "\n" + "3 0 1 2\n" * faces).encode()
    order = "<" if form == "binary_little_endian" else ">"
    table = np.zeros(len(rows), [("r", "u1"), ("v", f"{order}f4", 4)])
    table["r"], table["v"] = np.arange(len(rows)) % 7, rows
    before, after = struct.pack(f"{order}i", 9), b"\3" + struct.pack(f"{order}3i", 0, 1, 2)
    return head.encode() + before * faces + table.tobytes() + after * faces


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("faces", [False, True])
def test_ply(call, tmp_path, form, faces):
    """Vertices that faces refer to keep their numbers."""
    (tmp_path / "ply").mkdir()
    for k in range(2):
        (tmp_path / f"ply/scan{k}.ply").write_bytes(ply_bytes(cloud(), form, faces))
    recording, blank = label(tmp_path / "ply", tmp_path / "out")
    run(call, tmp_path / "out", tmp_path / "clean")
    before, after = files_of(tmp_path / "ply"), files_of(tmp_path / "clean")
    assert set(before) == set(after)
    for scan, name in enumerate(sorted(before)):
        gone = blank[recording.beams_of(scan)]
        if faces:
            assert len(after[name]) == len(before[name]) or form == "ascii"
            assert before[name].split(b"end_header")[0] == after[name].split(b"end_header")[0]
        if form == "ascii":
            old, new = (one.decode().splitlines() for one in (before[name], after[name]))
            start = old.index("end_header") + 1 + faces
            if faces:
                for k in np.flatnonzero(gone):
                    words = old[start + k].split()
                    old[start + k] = " ".join([words[0], "nan nan nan", words[4]])
            else:
                old = [
                    one
                    for k, one in enumerate(old)
                    if not 0 <= k - start < N or not gone[k - start]
                ]
                old = [one.replace(f"vertex {N}", f"vertex {N - gone.sum()}") for one in old]
            assert old == new
        elif not faces:
            rows = np.frombuffer(before[name][-17 * N :], "V17")[~gone]
            head = before[name][: -17 * N].replace(b"vertex %d" % N, b"vertex %d" % len(rows))
            assert after[name] == head + rows.tobytes()
    again = read(tmp_path / "clean")
    if faces:
        np.testing.assert_array_equal(again.hit, recording.hit & ~blank)
    else:
        check_same_but(recording, tmp_path / "clean", blank)
