"""`stillmap filter` of LAS, LAZ and E57 files."""

import re

import numpy as np
import pytest
from labelled import RNG, N, check_same_but, label, run
from refusals import refused


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
