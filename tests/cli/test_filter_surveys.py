"""`stillmap filter` of LAS and LAZ files, and of formats that come back as others."""

import numpy as np
import pytest
from labelled import RNG, N, check_same_but, label, run
from refusals import refused

from stillmap.io import read


def las_file(path, version="1.4", point_format=7):
    """Extra bytes, two VLRs, an EVLR and bytes between them and the points."""
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.001), np.array([1.0, 2.0, 3.0])
    header.generating_software, header.system_identifier = b"Gel\xe4nde", "a lidar"
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
        options = {"do_compress": compressed, "closefd": False, "encoding_errors": "replace"}
        with laspy.open(file, "w", header=header, **options) as writer:
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


def e57_file(path):
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), "w") as file:
        for scan in range(2):
            columns = dict(zip("XYZ", RNG.uniform(-8.0, 8.0, (3, N)), strict=True))
            columns = {f"cartesian{axis}": values for axis, values in columns.items()}
            file.write_scan_raw(columns, translation=np.array([1.0 + scan, 0.0, 0.0]))


def threedtk_folder(path):
    path.mkdir()
    for k in range(2):
        np.savetxt(path / f"scan00{k}.3d", 100.0 * RNG.uniform(-8.0, 8.0, (N, 3)), "%.2f")
        (path / f"scan00{k}.pose").write_text(f"{100 * k} 0 0\n0 0 0\n")


def depth_folder(path):
    images = pytest.importorskip("PIL.Image")
    path.mkdir()
    for k in range(2):
        depth = RNG.integers(500, 4000, (13, 20)).astype(np.uint16)
        images.fromarray(depth).save(path / f"frame-{k:06d}.depth.png")


@pytest.mark.parametrize(
    ("name", "write", "form"),
    [
        ("a.e57", e57_file, "E57"),
        ("scans", threedtk_folder, "3DTK"),
        ("frames", depth_folder, "RGB-D folder"),
    ],
)
def test_formats_that_come_back_as_others(call, tmp_path, name, write, form):
    """As a folder of PCD files, one a scan at its pose, or as one PLY file; and it is said so."""
    write(tmp_path / name)
    recording, blank = label(tmp_path / name, tmp_path / "out")
    done = call("filter", tmp_path / "out", "-o", tmp_path / "clean")
    assert done.returncode == 0, done.stderr
    assert (
        f"the format {form} is not written again: it comes back as a folder of PCD" in done.stderr
    )
    again, kept = read(tmp_path / "clean"), recording.hit & ~blank
    assert again.source.format == "PCD"
    np.testing.assert_allclose(again.points[again.hit], recording.points[kept], atol=1e-6)
    if recording.T_recorded_base is not None:
        np.testing.assert_allclose(again.T_recorded_base, recording.T_recorded_base, atol=1e-9)
    done = call("filter", tmp_path / "out", "-o", tmp_path / "clean.ply")
    assert "it comes back as a PLY file" in done.stderr
    assert read(tmp_path / "clean.ply").hit.sum() == kept.sum()
    refused(call("filter", tmp_path / "out", "-o", tmp_path / "new.e57"), "new.e57", "--to")
