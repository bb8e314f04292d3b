"""E57 files: their scans, and XML sections that would fetch a schema, or take too long."""

import re
import socket
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pye57")
pytest.importorskip("lzf")  # of the seeds
import containers
import corpus

from stillmap.core.errors import InputError
from stillmap.core.source import Skipped
from stillmap.io import read
from stillmap.io.point_cloud import e57

XSI = b' xmlns:i="http://www.w3.org/2001/XMLSchema-instance"'


@pytest.fixture
def write_e57(tmp_path):
    """Writes an E57 file whose XML section is changed."""
    (tmp_path / "made").mkdir()
    seed = next(corpus.e57(tmp_path / "made"))

    def write(change):
        (tmp_path / "a.e57").write_bytes(containers.change_e57_xml(seed, change))
        return tmp_path / "a.e57"

    return write


def at_root(attribute):
    return lambda xml: xml.replace(b"<e57Root", b"<e57Root" + XSI + attribute, 1)


def at_end(text):
    return lambda xml: xml.replace(b"</e57Root>", text + b"</e57Root>", 1)


@pytest.mark.parametrize(
    "attribute",
    [
        b' i:schemaLocation="http://www.astm.org/COMMIT/E57/2010-e57-v1.0 URL"',
        b" i:noNamespaceSchemaLocation='URL'",
        b' more=">" i:schemaLocation = "http://www.astm.org/COMMIT/E57/2010-e57-v1.0 URL"',
    ],
)
def test_no_schema_is_fetched(write_e57, attribute):
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}/a.xsd".encode()
        with pytest.raises(InputError, match="names a schema to fetch"):
            read(write_e57(at_root(attribute.replace(b"URL", url))))
        server.settimeout(0.1)
        with pytest.raises(TimeoutError):
            server.accept()


@pytest.mark.parametrize("opening", [b"<!--", b"<![CDATA[", b"<?", b"<", b'<a "', b"<a '<b "])
def test_markup_that_does_not_end(write_e57, opening):
    path = write_e57(at_end(opening * ((4 << 20) // len(opening))))
    start = time.process_time()
    with pytest.raises(InputError, match="is refused: its XML section"):
        read(path)
    assert time.process_time() - start < 5.0  # quadratic: minutes


def test_depth_counts_tags_alone(write_e57):
    quiet = b"<!-- <a> -->" * 200 + b"<?p <a '> ?>" * 200
    assert read(write_e57(at_end(quiet))).n_scans == 2
    with pytest.raises(InputError, match="nested too deeply"):
        read(write_e57(at_end(b'<a x="/>">' * 200)))


def test_damaged_scans_are_given_up_on(write_e57, monkeypatch):
    """Each costs memory that libe57 keeps."""

    def repeat(xml):
        first = re.search(rb"<vectorChild.*?</vectorChild>", xml, re.DOTALL)[0]
        damaged = re.sub(rb'fileOffset="\d+"', b'fileOffset="99999999"', first)
        return xml.replace(first, first + 9 * damaged, 1)

    monkeypatch.setattr(e57, "_MAX_DAMAGED", 5)
    recording = read(write_e57(repeat))
    assert recording.n_scans == 1
    skipped = recording.source.skipped
    assert skipped["holds too many damaged scans"].count == 5
    assert sum(one.count for one in skipped.values()) == 10


@pytest.mark.parametrize(("seconds", "is_stamp"), [("1e9", True), ("4.9e9", False), ("-1", False)])
def test_stamps_that_are_no_time(write_e57, seconds, is_stamp):
    start = f"<acquisitionStart type='Structure'><dateTimeValue type='Float'>{seconds}"
    start += "</dateTimeValue></acquisitionStart>"

    def stamp(xml):
        kept = re.sub(rb"<acquisitionStart.*?</acquisitionStart>", b"", xml, flags=re.DOTALL)
        return kept.replace(b"<pose type", start.encode() + b"<pose type")

    stamps = read(write_e57(stamp)).stamp_ns.tolist()
    assert stamps == ([10**18 + e57.GPS_EPOCH_S * 10**9] * 2 if is_stamp else [0, 10**9])


def described(path, change):
    path.write_bytes(containers.change_e57_xml(path.read_bytes(), change))


@pytest.fixture
def scanned(tmp_path):
    """An E57 file of two scans, their points and poses."""
    pye57 = pytest.importorskip("pye57")
    rng = np.random.default_rng(5)
    file = pye57.E57(str(tmp_path / "a.e57"), mode="w")
    points, poses = rng.normal(0, 5, (2, 300, 3)).astype(np.float32), np.stack([np.eye(4)] * 2)
    poses[1, :3, :3] = Rotation.from_euler("zyx", [0.5, 0.1, -0.2]).as_matrix()
    poses[1, :3, 3] = 400_000, 5_000_000, 100
    for scan, T in zip(points, poses, strict=True):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), scan.T.copy(), strict=True))
        columns["cartesianInvalidState"] = (np.arange(300) == 7).astype(np.int8)
        file.write_scan_raw(columns, rotation=np.array([w, x, y, z]), translation=T[:3, 3])
    file.close()
    return tmp_path / "a.e57", points, poses


def test_e57(scanned):
    path, points, poses = scanned
    found = read(path)
    valid = np.arange(600) % 300 != 7
    np.testing.assert_array_equal(found.hit, valid)
    np.testing.assert_allclose(found.points[valid], points.reshape(-1, 3)[valid], atol=1e-6)
    np.testing.assert_allclose(found.T_recorded_base, poses, atol=1e-9)
    assert found.stamp_ns.tolist() == [0, 10**9]
    both = path.with_name("b.e57")
    both.write_bytes(path.read_bytes())
    path.with_name("c.e57").write_bytes(path.read_bytes()[:5000])
    folder = read(path.parent)
    assert folder.n_scans == 4
    assert folder.source.skipped["is damaged"].lines == [5]


def test_e57_with_another_description_is_read(scanned):
    path, *_ = scanned
    described(path, lambda xml: re.sub(rb"<pose.*?</pose>", b"", xml, flags=re.DOTALL))
    found = read(path)
    assert found.n_scans == 2
    assert found.T_recorded_base is None
    assert "no sensor pose is recorded" in found.source.warnings[-1]


@pytest.mark.parametrize("count", [b"301", b"5000", b"9999999999999"])
def test_e57_that_promises_more(scanned, count):
    path, *_ = scanned
    old, new = b'recordCount="300"', b'recordCount="' + count + b'"'
    described(path, lambda xml: xml.replace(old, new, 1))
    found = read(path)
    assert found.n_scans == 1
    ((reason, damage),) = found.source.skipped.items()
    assert reason in ("is truncated", "is damaged")
    assert damage == Skipped(1, [1])


def test_e57_with_entities_is_refused(write_e57):
    defined = b'?><!DOCTYPE a [<!ENTITY b "c">]>'
    with pytest.raises(InputError, match="entities"):
        read(write_e57(lambda xml: xml.replace(b"?>", defined, 1)))


@pytest.mark.parametrize("kept", [10, 48, 1024, 5000])
def test_e57_that_is_cut(scanned, kept):
    path, *_ = scanned
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"is (no E57|damaged)"):
        read(path)
