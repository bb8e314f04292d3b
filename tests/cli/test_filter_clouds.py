"""`stillmap filter` of point clouds: points go, every other byte stays."""

import gzip
import json
import re
import struct

import numpy as np
import pytest
from labelled import label
from refusals import refused

from stillmap.io import read

N = 40  # points of a scan
RNG = np.random.default_rng(2)


def cloud(n=N):
    """(n, 4) float32 points and intensity with some that no beam can use."""
    rows = RNG.uniform(-8.0, 8.0, (n, 4)).astype(np.float32)
    rows[3, :3], rows[7, 0], rows[n - 1, :3] = 0.0, np.nan, np.inf
    return rows


def run(call, result, out, *more):
    done = call("filter", result, "-o", out, "--json", "--quiet", *more)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    return json.loads(done.stdout)


def check_same_but(before, after, blank):
    """The hits that were not blanked are there, in order, with their stamps and poses."""
    again, kept = read(after), before.hit & ~blank
    np.testing.assert_array_equal(again.points[again.hit], before.points[kept])
    np.testing.assert_array_equal(again.stamp_ns, before.stamp_ns)
    for name in ("T_recorded_base", "T_odom_base"):
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name))
    if before.beam_time is not None:
        np.testing.assert_array_equal(again.beam_time[again.hit], before.beam_time[kept])
    return again


def files(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def kitti(folder, layout="velodyne", times="times.txt"):
    (folder / layout).mkdir(parents=True)
    for k in range(4):
        cloud().tofile(folder / layout / f"{k:06d}.bin")
    (folder / layout / "000002.bin").write_bytes(b"123")
    (folder / times).write_text("".join(f"{0.1 * k}\n" for k in range(4)))
    (folder / "image_2").mkdir()
    (folder / "image_2/000000.txt").write_text("no picture")
    (folder / "labels").mkdir()
    np.arange(N, dtype="<u4").tofile(folder / "labels/000001.label")
    (folder / "labels/000003.label").write_bytes(b"of other points")
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    identity = "1 0 0 {} 0 1 0 0 0 0 1 0\n"
    (folder / "poses.txt").write_text("".join(identity.format(k) for k in range(4)))
    return folder


@pytest.mark.parametrize(
    ("layout", "times"),
    [("velodyne", "times.txt"), ("velodyne_points/data", "velodyne_points/timestamps.txt")],
)
def test_kitti_folder(call, tmp_path, layout, times):
    """Rows go, bit for bit; the damaged scan becomes an empty file, so that numbers stay."""
    source = kitti(tmp_path / "drive", layout, times)
    recording, blank = label(source, tmp_path / "drive/out")
    summary = run(call, source / "out", tmp_path / "clean")
    assert summary["blanked"] == blank.sum() > 20
    assert summary["scans_left_out"] == 1
    before, after = files(source), files(tmp_path / "clean")
    assert set(after) == {name for name in before if not name.startswith("out/")}
    for scan, number in enumerate((0, 1, 3)):
        name = f"{layout}/{number:06d}.bin"
        rows = np.frombuffer(before.pop(name), "V16")
        assert after.pop(name) == rows[~blank[recording.beams_of(scan)]].tobytes()
    assert after.pop(f"{layout}/000002.bin") == b""
    labels = np.flatnonzero(~blank[recording.beams_of(1)]).astype("<u4")
    assert after.pop("labels/000001.label") == labels.tobytes()
    assert all(before[name] == data for name, data in after.items())
    assert check_same_but(recording, tmp_path / "clean", blank).n_scans == 3


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
    after = files(tmp_path / "clean")
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
    before, after = files(tmp_path / "ply"), files(tmp_path / "clean")
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


@pytest.mark.parametrize(
    ("ending", "heading"), [(".3d", "40\n"), (".3d.gz", ""), (".3d", "# a b\n")]
)
def test_3dtk(call, tmp_path, ending, heading):
    (tmp_path / "scans").mkdir()
    lines = {}
    for k in range(2):
        rows = 100.0 * RNG.uniform(-8.0, 8.0, (N, 4))
        lines[k] = [" ".join(f"{v:.2f}" for v in row) + "\r\n" for row in rows]
        text = (heading + "".join(lines[k])).encode()
        path = tmp_path / f"scans/scan00{k}{ending}"
        path.write_bytes(gzip.compress(text) if ending.endswith("gz") else text)
        (tmp_path / f"scans/scan00{k}.pose").write_text(f"{100 * k} 0 0\n0 0 0\n")
    recording, blank = label(tmp_path / "scans", tmp_path / "out")
    run(call, tmp_path / "out", tmp_path / "clean")
    after = files(tmp_path / "clean")
    for k in range(2):
        gone = blank[recording.beams_of(k)]
        data = after[f"scan00{k}{ending}"]
        text = (gzip.decompress(data) if ending.endswith("gz") else data).decode()
        kept = [line for line, is_gone in zip(lines[k], gone, strict=True) if not is_gone]
        assert text == heading.replace("40", str(len(kept))) + "".join(kept)
    check_same_but(recording, tmp_path / "clean", blank)


def test_single_3dtk_scan_keeps_its_pose(call, tmp_path):
    rows = 100.0 * RNG.uniform(-8.0, 8.0, (N, 3))
    np.savetxt(tmp_path / "scan000.3d", rows, "%.2f")
    (tmp_path / "scan000.pose").write_text("100 0 0\n0 90 0\n")
    recording, blank = label(tmp_path / "scan000.3d", tmp_path / "out")
    run(call, tmp_path / "out", tmp_path / "clean.3d.gz")
    assert gzip.decompress((tmp_path / "clean.3d.gz").read_bytes()).count(b"\n") == N - blank.sum()
    check_same_but(recording, tmp_path / "clean.3d.gz", blank)


def las_file(path, version="1.4", point_format=7):
    """Extra bytes, two VLRs, an EVLR and bytes between them and the points."""
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.001), np.array([1.0, 2.0, 3.0])
    header.generating_software, header.system_identifier = "by hand", "a lidar"
    header.file_source_id = 7
    header.add_extra_dim(laspy.ExtraBytesParams("ring", np.uint16, "a ring"))
    header.vlrs.append(laspy.VLR("someone", 17, "theirs", b"\1\2\3"))
    header.extra_vlr_bytes = b"between"
    rows = RNG.uniform(-8.0, 8.0, (N, 3))
    points = laspy.ScaleAwarePointRecord.zeros(N, header=header)
    points.x, points.y, points.z = rows.T
    points["intensity"], points["ring"] = np.arange(N), np.arange(N) % 16
    points["return_number"] = 1 + np.arange(N) % 3
    with path.open("wb") as file:
        compressed = path.suffix == ".laz"
        with laspy.open(file, "w", header=header, do_compress=compressed, closefd=False) as writer:
            writer.write_points(points)
            if version == "1.4":
                record = laspy.VLR("someone", 18, "behind", b"\4" * 70000)
                writer.write_evlrs(laspy.vlrs.vlrlist.VLRList([record]))


@pytest.mark.parametrize(
    ("name", "version", "point_format"),
    [("a.las", "1.2", 3), ("a.las", "1.4", 7), ("a.laz", "1.4", 7), ("a.laz", "1.2", 1)],
)
@pytest.mark.parametrize("single", [True, False])
def test_las(call, tmp_path, name, version, point_format, single):
    """All dimensions, records and bytes of the header but for counts and bounds."""
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    (tmp_path / "las").mkdir()
    las_file(tmp_path / "las" / name, version, point_format)
    source = tmp_path / "las" / name if single else tmp_path / "las"
    out = tmp_path / f"clean{source.suffix}"
    recording, blank = label(source, tmp_path / "out")
    run(call, tmp_path / "out", out)
    new = out if single else out / name
    old, again = (laspy.read(one) for one in (tmp_path / "las" / name, new))
    np.testing.assert_array_equal(old.points.array[~blank], again.points.array)
    assert again.header.point_count == N - blank.sum()
    counts = np.bincount(np.asarray(again.return_number), minlength=6)[1:6]
    assert again.header.number_of_points_by_return[:5].tolist() == counts.tolist()
    np.testing.assert_allclose(again.header.mins, again.xyz.min(axis=0), atol=1e-9)
    np.testing.assert_allclose(again.header.maxs, again.xyz.max(axis=0), atol=1e-9)
    if version == "1.4":
        assert again.evlrs[0].record_data == b"\4" * 70000
    before, after = (tmp_path / "las" / name).read_bytes(), new.read_bytes()
    start = old.header.offset_to_point_data
    same = [(0, 107), (131, 179), (243, 247), (375, start)]
    same = same if version == "1.4" else [(0, 107), (131, 179), (227, start)]
    assert all(before[a:b] == after[a:b] for a, b in same)
    check_same_but(recording, out, blank)


def test_las_keeps_its_ending(call, tmp_path):
    las_file(tmp_path / "a.las")
    label(tmp_path / "a.las", tmp_path / "out")
    done = call("filter", tmp_path / "out", "-o", tmp_path / "clean.laz")
    refused(done, "clean.laz", ".las")


@pytest.mark.parametrize("layout", ["scenes", "tum"])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_depth_images(call, tmp_path, layout, step):
    """Depth becomes zero in the nearest pixels of blanked beams; text in PNG files is kept."""
    from PIL import Image, PngImagePlugin

    folder = tmp_path / "rgbd"
    (folder / "depth").mkdir(parents=True)
    depth = RNG.integers(500, 4000, (3, 13, 20)).astype(np.uint16)
    depth[:, 2, 3], depth[:, 4, :] = 65535, 0
    text = PngImagePlugin.PngInfo()
    text.add_text("camera", "a depth camera")
    names = [f"frame-{k:06d}.depth.png" for k in range(4)]
    if layout == "tum":
        names = [f"depth/{k}.png" for k in range(4)]
        lines = (f"{k}.0 {name}\n" for k, name in enumerate(names))
        (folder / "depth.txt").write_text("# by hand\n" + "".join(lines))
    for k, name in zip((0, 1, 3), names[:2] + names[3:], strict=True):
        Image.fromarray(depth[min(k, 2)]).save(folder / name, pnginfo=text)
    (folder / names[2]).write_bytes(b"\x89PNG\r\n\x1a\n no image")
    (folder / "frame-000000.color.jpg").write_bytes(b"a picture")
    recording, blank = label(folder, tmp_path / "out", options={"depth_step": step})
    assert run(call, tmp_path / "out", tmp_path / "clean")["scans_left_out"] == 1
    before, after = files(folder), files(tmp_path / "clean")
    assert set(before) == set(after)
    rows, columns = np.indices((13, 20))
    grid = -(-13 // step), -(-20 // step)
    nearest = [
        np.minimum((index + step // 2) // step, count - 1)
        for index, count in zip((rows, columns), grid, strict=True)
    ]
    for scan, (k, name) in enumerate(zip((0, 1, 3), names[:2] + names[3:], strict=True)):
        old = depth[min(k, 2)]
        gone = blank[recording.beams_of(scan)].reshape(grid)[tuple(nearest)]
        gone &= (old > 0) & (old < 65535)
        with Image.open(tmp_path / "clean" / name) as image:
            assert image.text == {"camera": "a depth camera"}
            np.testing.assert_array_equal(np.array(image), np.where(gone, 0, old))
        del before[name], after[name]
    with Image.open(tmp_path / "clean" / names[2]) as image:
        assert not np.array(image).any()
        assert np.array(image).shape == (13, 20)
    del before[names[2]], after[names[2]]
    assert before == after


def test_depth_images_of_other_kinds(call, tmp_path):
    from PIL import Image

    (tmp_path / "rgbd/depth").mkdir(parents=True)
    (tmp_path / "rgbd/depth.txt").write_text("1.0 depth/1.tif\n")
    Image.fromarray(np.full((8, 9), 900, np.uint16)).save(tmp_path / "rgbd/depth/1.tif")
    label(tmp_path / "rgbd", tmp_path / "out")
    refused(call("filter", tmp_path / "out", "-o", tmp_path / "clean"), "1.tif", "must be PNG")


@pytest.mark.parametrize(
    "output", ["clean.mcap", "clean.bag", "clean:pcd", "clean:stillmap", "clean.ply"]
)
def test_other_formats_by_name(call, tmp_path, output):
    source = kitti(tmp_path / "drive")
    recording, blank = label(source, tmp_path / "out")
    name, _, form = output.partition(":")
    out = tmp_path / name
    done = call("filter", tmp_path / "out", "-o", out, *(("--to", form) if form else ()))
    assert done.returncode == 0, done.stderr
    assert f"{blank.sum()} beams blanked" in done.stderr
    assert "1 scans left out that were not mapped" in done.stderr
    assert ("recorded poses are left out" in done.stderr) == output.endswith(("mcap", "bag"))
    again = read(out)
    hits = again.points[again.hit]
    kept = recording.points[recording.hit & ~blank]
    if output == "clean.ply":
        assert len(hits) == len(kept)  # as one cloud
    else:
        np.testing.assert_array_equal(hits, kept)
        np.testing.assert_array_equal(again.stamp_ns, recording.stamp_ns)


def test_refusals_come_before_anything_is_read(call, tmp_path):
    source = kitti(tmp_path / "drive")
    label(source, tmp_path / "out")
    (source / "times.txt").unlink()  # reading it would fail
    for output, words in (
        ("clean.log", ("clean.log", "2D at most", "3D")),
        ("clean.pcd", ("clean.pcd", "KITTI folder", "another ending")),
        ("drive/clean", ("lies in the folder of the recording",)),
        (".", ("holds the recording",)),
    ):
        refused(call("filter", tmp_path / "out", "-o", tmp_path / output), *words)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/other").write_text("")
    for more, words in (((), "already holds"), (("--overwrite",), "holds other things")):
        refused(call("filter", tmp_path / "out", "-o", tmp_path / "full", *more), words)
    (tmp_path / "out/beams/hit.npy").unlink()
    refused(call("filter", tmp_path / "out", "-o", tmp_path / "clean"), "hit.npy")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["drive", "full", "out"]


def test_folders_are_overwritten(call, tmp_path):
    source = kitti(tmp_path / "drive")
    label(source, tmp_path / "out")
    run(call, tmp_path / "out", tmp_path / "clean")
    (tmp_path / "clean/velodyne/000009.bin").write_bytes(b"")
    run(call, tmp_path / "out", tmp_path / "clean", "--overwrite")
    assert not (tmp_path / "clean/velodyne/000009.bin").exists()


def test_links_to_other_places_stay_links(call, tmp_path):
    """Linked folders of scans are written, others are not copied."""
    real = kitti(tmp_path / "real")
    (tmp_path / "drive").mkdir()
    for name in ("velodyne", "image_2"):
        (tmp_path / "drive" / name).symlink_to(f"../real/{name}")
    (tmp_path / "drive/times.txt").write_text((real / "times.txt").read_text())
    _, blank = label(tmp_path / "drive", tmp_path / "out")
    run(call, tmp_path / "out", tmp_path / "far/away/clean")
    clean = tmp_path / "far/away/clean"
    assert (clean / "image_2").resolve() == real / "image_2"
    assert not (clean / "velodyne").is_symlink()
    sizes = [path.stat().st_size for path in (clean / "velodyne").iterdir()]
    assert sum(sizes) == 16 * (3 * N - blank.sum())
    assert (real / "velodyne/000000.bin").stat().st_size == 16 * N


def e57_file(path, organised=False):
    """Two scans with every type of field, an image and an extension."""
    library = pytest.importorskip("pye57.libe57")
    file = library.ImageFile(str(path), "w")
    file.extensionsAdd("", library.E57_V1_0_URI)
    file.extensionsAdd("own", "http://example.org/own")
    root = file.root()
    for name in ("formatName", "guid"):
        root.set(name, library.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("own:number", library.IntegerNode(file, 7, 0, 9))
    scans, images = library.VectorNode(file, True), library.VectorNode(file, True)
    root.set("data3D", scans)
    root.set("images2D", images)
    blob = library.BlobNode(file, 3)
    picture = library.StructureNode(file)
    images.append(picture)
    picture.set("jpegImage", blob)
    blob.write(np.array([1, 2, 3], np.uint8), 0, 3)
    for scan in range(2):
        node, prototype = library.StructureNode(file), library.StructureNode(file)
        scans.append(node)
        pose, xyz = library.StructureNode(file), library.StructureNode(file)
        node.set("pose", pose)
        pose.set("translation", xyz)
        for axis in "xyz":
            xyz.set(axis, library.FloatNode(file, 1.0 + scan))
        single = library.FloatPrecision.E57_SINGLE
        prototype.set("cartesianX", library.FloatNode(file, 0.0, single, -9.0, 9.0))
        prototype.set("cartesianY", library.ScaledIntegerNode(file, 0, -9000, 9000, 0.001, 0.5))
        prototype.set("cartesianZ", library.FloatNode(file, 0.0))
        prototype.set("cartesianInvalidState", library.IntegerNode(file, 0, 0, 2))
        prototype.set("intensity", library.FloatNode(file, 0.0))
        prototype.set("own:ring", library.IntegerNode(file, 0, 0, 99))
        values = {
            "cartesianX": RNG.uniform(-8, 8, N).astype(np.float32),
            "cartesianY": RNG.integers(-8000, 8000, N),
            "cartesianZ": RNG.uniform(-8, 8, N),
            "cartesianInvalidState": (np.arange(N) == 4).astype(np.int64),
            "intensity": RNG.random(N),
            "own:ring": np.arange(N),
        }
        if organised:
            prototype.set("rowIndex", library.IntegerNode(file, 0, 0, N))
            values["rowIndex"] = np.arange(N)
        points = library.CompressedVectorNode(file, prototype, library.VectorNode(file, True))
        node.set("points", points)
        buffers = library.VectorSourceDestBuffer()
        for name, array in values.items():
            buffers.append(library.SourceDestBuffer(file, name, array, N, False, False))
        writer = points.writer(buffers)
        writer.write(N)
        writer.close()
    file.close()


def e57_content(path):
    """The description of a file without byte counts, and the stored values of each scan."""
    library = pytest.importorskip("pye57.libe57")
    content = path.read_bytes()
    start, length = (int.from_bytes(content[at : at + 8], "little") for at in (24, 32))
    first = start // 1024 * 1024
    pages = range(first, len(content), 1024)
    xml = b"".join(content[at : at + 1020] for at in pages)[start - first :][:length].decode()
    for attribute in ("fileOffset", "recordCount"):
        xml = re.sub(rf'{attribute}="\d+"', "", xml)
    file = library.ImageFile(str(path), "r")
    tables = []
    for scan in range(len(file.root()["data3D"])):
        points = file.root()["data3D"][scan]["points"]
        prototype = library.StructureNode(points.prototype())
        names = [prototype.get(k).elementName() for k in range(prototype.childCount())]
        floats = {"cartesianX": "f", "cartesianZ": "d", "intensity": "d"}
        table = {name: np.zeros(N, floats.get(name, "q")) for name in names}
        buffers = library.VectorSourceDestBuffer()
        for name, array in table.items():
            buffers.append(library.SourceDestBuffer(file, name, array, N, False, False))
        reader = points.reader(buffers)
        n = reader.read()
        reader.close()
        tables.append({name: array[:n] for name, array in table.items()})
    blob, piece = file.root()["images2D"][0]["jpegImage"], np.zeros(3, np.uint8)
    blob.read(piece, 0, 3)
    file.close()
    return xml.strip(), tables, piece.tolist()


@pytest.mark.parametrize("organised", [False, True])
@pytest.mark.parametrize("single", [True, False])
def test_e57(call, tmp_path, organised, single):
    """Every node and every stored value; points of grids stay and are marked as invalid."""
    pytest.importorskip("pye57")
    (tmp_path / "scans").mkdir()
    e57_file(tmp_path / "scans/a.e57", organised)
    if not single:
        (tmp_path / "scans/b.e57").write_bytes(b"ASTM-E57 and no more")
    source = tmp_path / "scans/a.e57" if single else tmp_path / "scans"
    out = tmp_path / ("clean.e57" if single else "clean")
    recording, blank = label(source, tmp_path / "out")
    assert run(call, tmp_path / "out", out)["scans_left_out"] == (not single)
    before, after = (
        e57_content(path) for path in (tmp_path / "scans/a.e57", out if single else out / "a.e57")
    )
    assert before[0] == after[0]
    assert before[2] == after[2] == [1, 2, 3]
    for scan, (old, new) in enumerate(zip(before[1], after[1], strict=True)):
        gone = blank[recording.beams_of(scan)]
        assert gone.any()
        for name in old:
            expected = old[name][~gone]
            if organised:
                marks = {"cartesianInvalidState": 2, "intensity": old[name], "own:ring": old[name]}
                marks["rowIndex"] = old[name]
                expected = np.where(gone, marks.get(name, 0), old[name])
            np.testing.assert_array_equal(new[name], expected)
    if not organised:
        check_same_but(recording, out, blank)


def test_e57_with_texts_is_refused_at_once(call, tmp_path):
    library = pytest.importorskip("pye57.libe57")
    e57_file(tmp_path / "a.e57")
    label(tmp_path / "a.e57", tmp_path / "out")
    file = library.ImageFile(str(tmp_path / "a.e57"), "w")
    scans, node = library.VectorNode(file, True), library.StructureNode(file)
    file.root().set("data3D", scans)
    scans.append(node)
    prototype = library.StructureNode(file)
    prototype.set("remark", library.StringNode(file, ""))
    codecs = library.VectorNode(file, True)
    node.set("points", library.CompressedVectorNode(file, prototype, codecs))
    file.close()
    done = call("filter", tmp_path / "out", "-o", tmp_path / "clean.e57")
    refused(done, "a.e57", "its points have texts", "--to")
