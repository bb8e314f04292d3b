"""Damaged bags: an error of one line, or skipped messages."""

import struct
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode
from small_bags import SECOND, START, Messages, write_bag

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.builder import TIME_BACKWARDS
from stillmap.io.ros import lasers
from stillmap.io.ros.messages import UNREADABLE


def scans_of(messages, n, **changes):
    out = []
    for k in range(n):
        stamp = START + k * SECOND // 10
        ranges = 2.0 + 0.05 * k + 0.001 * np.arange(400)
        out.append(("/scan", stamp, messages.scan(stamp, ranges, angle_increment=0.01, **changes)))
    return out


def skipped(recording):
    return {reason: one.count for reason, one in recording.source.skipped.items()}


def file_of(path: Path) -> Path:
    return next(path.glob("*.db3")) if path.is_dir() else path


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9, 0.999])
def test_cut(bag, messages, kind, share):
    path = bag(scans_of(messages, 200))
    file = file_of(path)
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    try:
        recording = read(path)
    except InputError:
        # SQLite may keep its list of tables at the end
        assert share < 0.1 or kind in ("db3", "folder")
        return
    assert recording.n_scans > 0.7 * share * 200 - 3
    if kind in ("bag", "mcap"):
        assert "cut or damaged" in recording.source.warnings[0]
    # the recovered scans are unchanged
    got = np.linalg.norm(recording.points, axis=1).reshape(-1, 400)[:, 0]
    k = (recording.stamp_ns - START) // (SECOND // 10)
    np.testing.assert_allclose(got, 2.0 + 0.05 * k, rtol=1e-6)


def test_no_index(tmp_path):
    """As a killed recorder leaves a bag."""
    messages = Messages("ros1")
    path = write_bag(tmp_path, "bag", messages, scans_of(messages, 20))
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len("index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    assert read(path).n_scans == 20


def test_wrong_array_lengths(bag, messages):
    content = scans_of(messages, 6)
    kind, message = content[3][2]
    raw = messages.raw(kind, message)
    at = raw.index(struct.pack("<I", 400))
    for k, count in ((1, 401), (3, 2**31), (4, 2**32 - 1)):
        content[k] = (*content[k][:2], (kind, raw[:at] + struct.pack("<I", count) + raw[at + 4 :]))
    content[5] = (*content[5][:2], (kind, raw[:50]))
    recording = read(bag(content))
    assert recording.n_scans == 2
    assert skipped(recording) == {UNREADABLE: 4}
    assert recording.source.skipped[UNREADABLE].lines == [2, 4, 5, 6]


def test_numbers_of_beams_may_vary(bag, messages):
    content = [
        ("/scan", START + k, messages.scan(START + k, np.full(n, 3.0), angle_increment=0.01))
        for k, n in enumerate((5, 7, 0, 5, 1))
    ]
    recording = read(bag(content))
    np.testing.assert_array_equal(np.diff(recording.offset), [5, 7, 5, 1])
    assert skipped(recording) == {"scan without readings": 1}


def test_decreasing_and_repeated_stamps(bag, messages):
    stamps = [0, 1, 2, 2, 9, 3, 3, 4, 3.5]
    readings = [1.0, 2.0, 3.0, 3.0, 4.0, 5.0, 6.0, 7.0, 6.5]
    content = [
        ("/scan", START + k, messages.scan(START + int(s * SECOND), np.full(4, r)))
        for k, (s, r) in enumerate(zip(stamps, readings, strict=True))
    ]
    recording = read(bag(content))
    np.testing.assert_array_equal((recording.stamp_ns - START) / SECOND, [0, 1, 2, 3, 3, 3.5, 4])
    lengths = np.linalg.norm(recording.points[::4], axis=1)
    np.testing.assert_allclose(lengths, [1.0, 2.0, 3.0, 5.0, 6.0, 6.5, 7.0])
    np.testing.assert_array_equal(recording.record, [1, 2, 3, 6, 7, 9, 8])
    assert skipped(recording) == {TIME_BACKWARDS: 1, lasers.REPEATED: 1}


def test_headers_without_stamps(bag, messages):
    content = [
        ("/scan", START + k * SECOND, messages.scan(0, np.full(4, 2.0 + k))) for k in range(3)
    ]
    recording = read(bag(content))
    np.testing.assert_array_equal(recording.stamp_ns, START + np.arange(3) * SECOND)
    assert "log times are used" in recording.source.warnings[0]


def test_invalid_transforms(bag, messages):
    content = scans_of(messages, 3)
    bad = [
        messages.transform(START, "odom", "base_link", (0, 0, 0), (0, 0, 0, 0)),
        messages.transform(START, "odom", "odom", (0, 0, 0)),
        messages.transform(START, "", "base_link", (0, 0, 0)),
    ]
    content.append(("/tf", START, messages.tf(*bad)))
    recording = read(bag(content))
    assert recording.T_odom_base is None
    assert recording.source.skipped_odometry["transform that is none"].count == 3


@pytest.mark.parametrize(
    ("kind", "packing"),
    [
        ("bag", {"fmt": Writer.CompressionFormat.BZ2}),
        ("bag", {"fmt": Writer.CompressionFormat.LZ4}),
        ("folder", {"mode": CompressionMode.MESSAGE, "fmt": CompressionFormat.ZSTD}),
        ("folder", {"mode": CompressionMode.FILE, "fmt": CompressionFormat.ZSTD}),
        ("mcap", {"mode": CompressionMode.STORAGE, "fmt": CompressionFormat.ZSTD}),
    ],
)
def test_compressed_bags(tmp_path, kind, packing):
    messages = Messages("ros1" if kind == "bag" else "cdr")
    path = write_bag(tmp_path, kind, messages, scans_of(messages, 20), **packing)
    assert read(path).n_scans == 20


def test_folders_whose_metadata_lacks_or_names_more(tmp_path):
    messages = Messages("cdr")
    path = write_bag(tmp_path, "folder", messages, scans_of(messages, 5))
    file = file_of(path)
    file.rename(path / "other.db3")
    with pytest.raises(InputError, match=rf"lacks the file '{file.name}'"):
        read(path)
    (path / "metadata.yaml").unlink()
    assert read(path).n_scans == 5


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"#ROSBAG V1.2\n", "version 2.0"),
        (b"#ROSBAG V2.0\n", "holds no scans"),
        (b"\x89MCAP0\r\n", "holds no scans"),
        (b"SQLite format 3\0" + bytes(100), "holds no scans"),
        (b"", "is empty"),
        (b"\0\1\2\3", "is no recording that stillmap reads"),
    ],
)
def test_other_files(tmp_path, content, text):
    path = tmp_path / "odd.bag"
    path.write_bytes(content)
    with pytest.raises(InputError, match=text) as caught:
        read(path)
    assert str(path) in str(caught.value)
