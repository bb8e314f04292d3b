"""Bags that are whole, read by the library with their index."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.interfaces import (
    ConnectionExtRosbag2,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
)
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap, storage_sqlite3
from rosbags.rosbag2.metadata import parse_qos

from stillmap.core.errors import InputError
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import limits, sqlite_limits
from stillmap.io.ros.bag_types import MAX_STAMP_NS, Channel, DamagedBagError, Message

# the library unpacks whatever comes; its table is where it can be told to stop
storage_mcap.DECOMPRESSORS["lz4"] = lambda data, _: limits.decompress_lz4(data)
storage_mcap.DECOMPRESSORS["zstd"] = lambda data, _: limits.decompress_zstd(data)

_MAX_PROFILES = 16 << 10  # bytes of YAML about how a topic was sent


def _profiles(said: Any) -> list[Qos]:
    return [] if isinstance(said, str) and len(said) > _MAX_PROFILES else parse_qos(said)


# a megabyte of YAML takes the library half a minute
for _module in (storage_mcap, storage_sqlite3):
    vars(_module).update(parse_qos=_profiles)

_BOUNDED = {
    rosbag1.decompressors["bz2"]: limits.decompress_bz2,
    rosbag1.decompressors["lz4"]: limits.decompress_lz4,
}


class _Bag1Reader(rosbag1.Reader):
    """The library's, with limits on what is unpacked, and on an index that repeats itself."""

    def open(self) -> None:
        self._index_left = self.path.stat().st_size
        super().open()

    def read_index_data(self, pos: int, indexes: dict[int, list[rosbag1.IndexData]]) -> None:
        assert self.bio is not None
        at = self.bio.tell()
        super().read_index_data(pos, indexes)
        self._index_left -= self.bio.tell() - at
        if self._index_left < 0:
            raise rosbag1.ReaderError("Index is larger than the bag.")

    def read_chunk(self) -> rosbag1.Chunk:
        chunk = super().read_chunk()
        unpacked = _BOUNDED.get(chunk.decompressor, chunk.decompressor)
        return chunk._replace(decompressor=unpacked)


@dataclasses.dataclass
class IndexedBag:
    """See `Bag`."""

    kind: str
    reader: Any
    channels: list[Channel] = dataclasses.field(default_factory=list)
    damage: SkippedRecords = dataclasses.field(default_factory=SkippedRecords)

    def __post_init__(self) -> None:
        self.channels = [_channel(connection) for connection in self.reader.connections]

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """See `Bag`."""
        chosen = [c for c in self.reader.connections if c.topic in topics]
        if not chosen:
            return
        channels = {c.id: c for c in self.channels}
        source = self.reader.messages(chosen, start=since_ns)
        while True:
            try:
                connection, log_ns, raw = next(source)
            except StopIteration:
                return
            except InputError:
                raise
            except Exception as error:  # whatever the library makes of damaged bytes
                raise DamagedBagError(str(error) or type(error).__name__) from error
            # a column of SQLite holds anything
            if not (isinstance(log_ns, int) and log_ns <= MAX_STAMP_NS and isinstance(raw, bytes)):
                raise DamagedBagError("a message without time or content")
            yield Message(channels[connection.id], log_ns, raw)

    def close(self) -> None:
        """See `Bag`."""
        self.reader.close()


def open_bag1(path: Path) -> IndexedBag:
    """A ROS 1 bag with its index. Raises whatever the library says of one that is damaged."""
    reader = _Bag1Reader(path)
    reader.open()
    return IndexedBag("ROS 1 bag", reader)


def open_mcap(path: Path) -> IndexedBag:
    """An MCAP file of ROS 2. Raises whatever the library says of one that is damaged."""
    reader = storage_mcap.McapReader(path)
    reader.open()
    return IndexedBag("MCAP", reader)


def open_db3(path: Path) -> IndexedBag:
    """A SQLite file of ROS 2. Raises whatever the library says of one that is damaged."""
    # the library makes an address of the path
    reader = storage_sqlite3.Sqlite3Reader(Path(sqlite_limits.database_uri(path)))
    with sqlite_limits.limit_databases(path):
        reader.open()
    return IndexedBag("SQLite bag", reader)


def _channel(connection: Any) -> Channel:
    ext = connection.ext
    if isinstance(ext, ConnectionExtRosbag2):
        encoding = ext.serialization_format
        latched = any(
            q.durability == QosDurability.TRANSIENT_LOCAL for q in ext.offered_qos_profiles
        )
    else:
        encoding, latched = "ros1", bool(ext.latching)
    in_words = connection.msgdef.format == MessageDefinitionFormat.MSG
    words = connection.topic, connection.msgtype, encoding, connection.digest
    if not all(isinstance(word, str) for word in words):
        raise DamagedBagError("a topic whose name or type is no text")
    return Channel(
        connection.id,
        connection.topic,
        connection.msgtype,
        encoding,
        connection.msgcount,
        connection.digest,
        connection.msgdef.data if in_words else "",
        latched,
    )
