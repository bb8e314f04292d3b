"""Hostile bags: endless, exhausting memory, or crashing their reader."""

import bz2
import os
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from small_bags import START, Messages, write_bag

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.builder import ReadContext
from stillmap.io.ros import limits
from stillmap.io.ros.messages import Channel, Message
from stillmap.io.ros.reader import collect_messages
from stillmap.prepare.options import ReadOptions


def scans_of(messages, n=3):
    return [("/scan", START + k, messages.scan(START + k, [1.0, 2.0, 3.0])) for k in range(n)]


@pytest.fixture
def db3(tmp_path):
    """A SQLite bag of three scans, changed by a script; gives its path."""

    def write(script: str = "") -> Path:
        messages = Messages("cdr")
        name = f"bag{len(list(tmp_path.iterdir()))}"
        path = write_bag(tmp_path, "db3", messages, scans_of(messages), name)
        database = sqlite3.connect(path)
        database.executescript(script)
        database.commit()
        database.close()
        return path

    return write


@pytest.mark.parametrize("place", [(np.nan, 0, 0), (1, np.nan, 0), (0, 0, np.inf), (1e300, 0, 0)])
def test_invalid_poses(bag, messages, place):
    turn = (0.0, 0.0, 0.0, 1.0)
    content = scans_of(messages)
    for k, xyz in enumerate([place, (1, 2, 0), place]):
        moving = messages.transform(START + k, "odom", "base_link", xyz)
        fixed = messages.transform(START, "base_link", "laser", (0.1, 0, 0) if k else place)
        content += [
            ("/tf", START + k, messages.tf(moving)),
            ("/tf_static", START + k, messages.tf(fixed)),
            ("/odom", START + k, messages.odometry(START + k, xyz, turn)),
        ]
    recording = read(bag(content))
    assert np.isfinite(recording.T_base_sensor).all()
    assert np.isfinite(recording.T_odom_base).all()
    assert recording.source.skipped_odometry["transform that is none"].count == 5


def test_values_of_other_types(db3):
    changes = (
        "UPDATE messages SET timestamp = 'x' WHERE id = 1;",
        "UPDATE messages SET timestamp = 1.5 WHERE id = 1;",
        "UPDATE messages SET data = 'text' WHERE id = 1;",
    )
    for change in changes:
        assert read(db3(change)).n_scans == 2
    for column in ("name", "type", "serialization_format"):
        with pytest.raises(InputError):
            read(db3(f"UPDATE topics SET {column} = x'00ff'"))


def test_tree_with_a_shared_page(db3, monkeypatch):
    monkeypatch.setattr(limits, "_MIN_STEPS", 0)
    monkeypatch.setattr(limits, "_STEPS_PER_BYTE", 3)
    path, size = db3(), 4096
    content = bytearray(path.read_bytes())
    with closing(sqlite3.connect(path)) as database:
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
        ((root,),) = database.execute(query).fetchall()
    at = (root - 1) * size
    content += content[at : at + size]
    for _ in range(3):
        child, inner = len(content) // size, bytearray(size)
        struct.pack_into(">BHHHBI", inner, 0, 5, 0, 400, size - 2000, 0, child)
        for k in range(400):
            struct.pack_into(">H", inner, 12 + 2 * k, size - 5 * (k + 1))
            struct.pack_into(">IB", inner, size - 5 * (k + 1), child, 127)
        content += inner
    content[at : at + size] = content[-size:]
    struct.pack_into(">I", content, 28, len(content) // size)
    path.write_bytes(content)
    recording = read(path)
    assert recording.source.damage["rows that cannot be read"].count == 1
    assert recording.n_scans <= 3  # the others repeat stamps and readings


def _record(fields: dict[bytes, bytes], content: bytes) -> bytes:
    lines = [name + b"=" + value for name, value in fields.items()]
    head = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(content)) + content


def _chunk(content: bytes) -> bytes:
    size = struct.pack("<I", len(content))
    fields = {b"op": b"\5", b"compression": b"bz2", b"size": size}
    return _record(fields, bz2.compress(content))


def test_nested_chunks(tmp_path):
    content = b""
    for _ in range(12):
        content = _chunk(content * 20)
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + content)
    with pytest.raises(InputError, match="holds no scans"):
        read(tmp_path / "a.bag")


def test_output_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "_MIN_LIMIT", 1 << 20)
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + _chunk(b"\0" * (1 << 20)) * 30)
    with pytest.raises(InputError, match="more than 300 times its size"):
        read(tmp_path / "a.bag")


def test_repeating_index(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "_MIN_LIMIT", 1 << 20)
    monkeypatch.setattr(limits, "_MAX_RATIO", 10)
    messages = Messages("ros1")
    scan = messages.scan(START, np.ones(4000), angle_increment=1e-5)
    path = write_bag(tmp_path, "bag", messages, [("/scan", START, scan)])
    content, times = path.read_bytes(), 20_000
    at = content.index(b"op=\4") - 8
    (head,) = struct.unpack_from("<I", content, at)
    entry = content[at + 8 + head : at + 20 + head]
    index = content[at : at + 4 + head].replace(b"count=\1\0", b"count=" + struct.pack("<H", times))
    index += struct.pack("<I", 12 * times) + entry * times
    moved = len(index) - (20 + head)
    content = bytearray(content[:at] + index + content[at + 20 + head :])
    place = content.index(b"index_pos=") + 10
    (end,) = struct.unpack_from("<Q", content, place)
    struct.pack_into("<Q", content, place, end + moved)
    path.write_bytes(content)
    with pytest.raises(InputError, match="more than 10 times its size"):
        read(path)


def test_log_time_beyond_64_bits(tmp_path):
    messages = Messages("cdr")
    path = write_bag(tmp_path, "mcap", messages, scans_of(messages))
    late = struct.pack("<Q", START + 1), struct.pack("<Q", 2**64 - 1)
    content = path.read_bytes().replace(*late)
    path.write_bytes(content)
    assert read(path).n_scans == 2  # rosbags skips it
    path.write_bytes(content[:-50])
    assert read(path).n_scans == 3


def test_recursive_metadata(tmp_path):
    messages = Messages("cdr")
    path = write_bag(tmp_path, "folder", messages, scans_of(messages))
    lines = ["a0: &a0 [x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    lines += ["rosbag2_bagfile_information: {relative_file_paths: *a11}"]
    (path / "metadata.yaml").write_text("\n".join(lines))
    assert read(path).n_scans == 3
    (path / "metadata.yaml").unlink()
    os.mkfifo(path / "metadata.yaml")
    assert read(path).n_scans == 3
    os.mkfifo(path / "tiny_1.db3")
    with pytest.raises(InputError, match="is no regular file"):
        read(path)


def test_messages_of_a_topic_that_nobody_wanted():
    """As of a damaged bag in which a connection takes the number of another one."""
    transforms = Channel(1, "/tf", "tf2_msgs/msg/TFMessage", "ros1", 1, "")

    class Damaged:
        channels = (transforms,)

        def messages(self, topics):
            assert topics == {"/scan"}
            yield Message(transforms, START, b"")

    content = collect_messages(Damaged(), {"/scan": "scans"}, ReadContext(ReadOptions()))
    assert content.unreadable.total == 1
