"""The limits of bags hold in the installed rosbags, and a part that was renamed is noticed."""

import bz2
import inspect

import lz4.frame
import pytest
from small_bags import Messages, write_bag

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.ros import indexed_bag, limits

COMPRESSORS = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": limits.zstd.compress}
BOMB = bytes(2 << 20)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(limits, "MAX_CHUNK", 1 << 20)


@pytest.mark.parametrize("name", COMPRESSORS)
def test_decompression_stops(name):
    with pytest.raises(InputError, match="larger than 1 MiB"):
        limits.decompress(name, COMPRESSORS[name](BOMB))


@pytest.mark.parametrize("name", ["lz4", "zstd"])
def test_mcap_reader_of_rosbags_is_limited(name):
    """Through the function that the reader calls, not through the table that was changed."""
    data = COMPRESSORS[name](BOMB)
    with pytest.raises(InputError, match="larger than 1 MiB"):
        indexed_bag.storage_mcap.decompress(data, name, len(BOMB), 0)


@pytest.mark.parametrize("name", ["bz2", "lz4"])
def test_reader_of_ros_1_is_limited(name, monkeypatch):
    chunk = indexed_bag.rosbag1.Chunk(0, 0, indexed_bag.rosbag1.decompressors[name])
    monkeypatch.setattr(indexed_bag.rosbag1.Reader, "read_chunk", lambda _: chunk)
    reader = object.__new__(indexed_bag._Bag1Reader)
    with pytest.raises(InputError, match="larger than 1 MiB"):
        reader.read_chunk().decompressor(COMPRESSORS[name](BOMB))


def test_every_compression_of_rosbags_is_limited():
    source = inspect.getsource(indexed_bag.storage_mcap)
    assert source.count("DECOMPRESSORS[") == 1, "another place decompresses"
    assert set(indexed_bag._BOUNDED) == {
        one for name, one in indexed_bag.rosbag1.decompressors.items() if name != "none"
    }


def test_databases_of_rosbags_are_limited(tmp_path, monkeypatch):
    messages = Messages("cdr")
    scans = [("/scan", k, messages.scan(k, [1.0, 2.0, 3.0])) for k in range(3)]
    path = write_bag(tmp_path, "db3", messages, scans)
    asked = []
    count = limits._step_counter
    monkeypatch.setattr(limits, "_step_counter", lambda p: asked.append(p) or count(p))
    assert read(path).n_scans == 3
    assert len(asked) >= 2, "apsw no longer calls the hook of new connections"


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        ("storage_mcap.DECOMPRESSORS", "brotli", len),
        ("storage_mcap", "DECOMPRESSORS", {}),
        ("rosbag1.decompressors", "brotli", len),
        ("rosbag1.Reader", "read_chunk", None),
        ("storage_sqlite3", "apsw", None),
        ("storage_sqlite3", "parse_qos", None),
    ],
)
def test_renamed_parts_are_noticed(monkeypatch, owner, name, value):
    place = indexed_bag
    for part in owner.split("."):
        place = getattr(place, part)
    if isinstance(place, dict):
        monkeypatch.setitem(place, name, value)
    elif value is None:
        monkeypatch.delattr(place, name)
    else:
        monkeypatch.setattr(place, name, value)
    with pytest.raises(InputError, match=r"rosbags [\d.]+ is not supported: .* has changed"):
        indexed_bag.require_known_rosbags()
