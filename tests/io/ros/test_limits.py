"""The limits of bags hold in the installed rosbags, and a part that was renamed is noticed."""

import bz2
import inspect

import lz4.frame
import pytest
from small_bags import Messages, write_bag

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.io.ros import bag, limits

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
        bag.storage_mcap.decompress(data, name, len(BOMB), 0)


@pytest.mark.parametrize("name", ["bz2", "lz4"])
def test_reader_of_ros_1_is_limited(name, monkeypatch):
    chunk = bag.rosbag1.Chunk(0, 0, bag.rosbag1.decompressors[name])
    monkeypatch.setattr(bag.rosbag1.Reader, "read_chunk", lambda _: chunk)
    reader = object.__new__(bag._Bag1Reader)
    with pytest.raises(InputError, match="larger than 1 MiB"):
        reader.read_chunk().decompressor(COMPRESSORS[name](BOMB))


def test_every_compression_of_rosbags_is_limited():
    source = inspect.getsource(bag.storage_mcap)
    assert source.count("DECOMPRESSORS[") == 1, "another place decompresses"
    assert set(bag._BOUNDED) == {
        one for name, one in bag.rosbag1.decompressors.items() if name != "none"
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
