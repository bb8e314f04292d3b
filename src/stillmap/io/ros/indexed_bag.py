"""Undamaged bags, read by rosbags with their index."""

from collections.abc import Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import apsw
from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinitionFormat, Qos, QosDurability
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap, storage_sqlite3
from rosbags.rosbag2.metadata import parse_qos

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputPath
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import limits
from stillmap.io.ros.bag_types import Channel, DamagedBagError, Message, is_log_time

_CHUNK_READERS = ("open", "read_index_data", "read_chunk")  # of rosbag1.Reader


def require_known_rosbags() -> None:
    """Refuse a version of rosbags in which the limits below would not take effect.

    They are set where rosbags has no option: in its tables of decompressors, in its parser of
    quality of service, and in methods that `_Bag1Reader` overrides.

    Raises:
        InputError: it is one.
    """
    checks = {
        "storage_mcap.DECOMPRESSORS": set(storage_mcap.DECOMPRESSORS) == {"", "lz4", "zstd"},
        "reader.decompressors": set(rosbag1.decompressors) == {"none", "bz2", "lz4"},
        "reader.Chunk": "decompressor" in rosbag1.Chunk._fields,
        "reader.Reader": all(hasattr(rosbag1.Reader, name) for name in _CHUNK_READERS),
        "parse_qos": all("parse_qos" in vars(one) for one in (storage_mcap, storage_sqlite3)),
        "storage_sqlite3.apsw": vars(storage_sqlite3).get("apsw") is apsw,
    }
    changed = [name for name, is_known in checks.items() if not is_known]
    if changed:
        what = f"rosbags {version('rosbags')} is not supported: {', '.join(changed)} has changed"
        raise InputError(what, hint="constraints.txt names the version that is")


require_known_rosbags()

# rosbags decompresses without a limit; its table is where one can be set
storage_mcap.DECOMPRESSORS["lz4"] = lambda data, _: limits.decompress("lz4", data)
storage_mcap.DECOMPRESSORS["zstd"] = lambda data, _: limits.decompress("zstd", data)

_MAX_QOS_TEXT = 16 << 10  # bytes of YAML: a megabyte takes rosbags half a minute


def _parse_qos(text: Any) -> list[Qos]:
    return [] if isinstance(text, str) and len(text) > _MAX_QOS_TEXT else parse_qos(text)


for _module in (storage_mcap, storage_sqlite3):
    vars(_module).update(parse_qos=_parse_qos)

_BOUNDED = {
    rosbag1.decompressors[name]: partial(limits.decompress, name) for name in ("bz2", "lz4")
}


class _Bag1Reader(rosbag1.Reader):
    """The reader of rosbags with limits on decompression and on an index that repeats itself."""

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
        decompress = _BOUNDED.get(chunk.decompressor, chunk.decompressor)
        return chunk._replace(decompressor=decompress)


class IndexedBag:
    """See `Bag`."""

    def __init__(self, kind: str, reader: Any) -> None:
        self.kind, self.reader, self.damage = kind, reader, SkippedRecords()
        self.channels = [_channel(connection) for connection in reader.connections]

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """See `Bag`."""
        connections = [c for c in self.reader.connections if c.topic in topics]
        if not connections:
            return
        channels = {c.id: c for c in self.channels}
        source = self.reader.messages(connections, start=since_ns)
        while True:
            try:
                connection, log_ns, raw = next(source)
            except StopIteration:
                return
            except InputError:
                raise
            except Exception as error:  # any error of rosbags about damaged bytes
                raise DamagedBagError(str(error) or type(error).__name__) from error
            if not (is_log_time(log_ns) and isinstance(raw, bytes)):
                raise DamagedBagError("a message without time or content")
            yield Message(channels[connection.id], log_ns, raw)

    def close(self) -> None:
        """See `Bag`."""
        self.reader.close()


def open_bag1(path: Path) -> Any:
    """Open the reader of a ROS 1 bag. Any error of rosbags means damage; likewise below."""
    reader = _Bag1Reader(InputPath(path))
    reader.open()
    return reader


def open_mcap(path: Path) -> Any:
    """Open the reader of an MCAP file of ROS 2."""
    reader = storage_mcap.McapReader(InputPath(path))
    reader.open()
    return reader


def open_db3(path: Path) -> Any:
    """Open the reader of a SQLite file of ROS 2."""
    # rosbags builds a URI from the path without quoting it
    reader = storage_sqlite3.Sqlite3Reader(Path(limits.database_path(path)))
    with limits.limit_databases(path):
        reader.open()
    return reader


def _channel(connection: Any) -> Channel:
    ext = connection.ext
    publisher = ""
    qos: tuple[Qos, ...] = ()
    if isinstance(ext, ConnectionExtRosbag2):
        qos = tuple(ext.offered_qos_profiles)
        encoding = ext.serialization_format
        latched = any(q.durability == QosDurability.TRANSIENT_LOCAL for q in qos)
    else:
        encoding, latched = "ros1", bool(ext.latching)
        publisher = ext.callerid or ""
    names = connection.topic, connection.msgtype, encoding, connection.digest
    if not all(isinstance(name, str) for name in names):
        raise DamagedBagError("a topic whose name or type is no text")
    is_text = connection.msgdef.format == MessageDefinitionFormat.MSG
    return Channel(
        connection.id,
        connection.topic,
        connection.msgtype,
        encoding,
        connection.msgcount,
        connection.digest,
        connection.msgdef.data if is_text else "",
        latched,
        publisher,
        qos,
    )
