"""Opens bags of every kind, detected by their first bytes; rosbags reads those with an index."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinitionFormat, Qos, QosDurability
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap, storage_sqlite3
from rosbags.rosbag2.metadata import parse_qos

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile, InputPath, read_text
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import limits
from stillmap.io.ros.messages import (
    BAG1_MAGIC,
    DB3_MAGIC,
    MCAP_MAGIC,
    Bag,
    Channel,
    DamagedBagError,
    Message,
    is_compressed,
    storage_files,
)
from stillmap.io.ros.recovery import DamagedBag, is_log_time

_MAX_METADATA = 256 << 10  # bytes of YAML, which take two seconds to parse
_MAX_QOS_TEXT = 16 << 10  # bytes of YAML: a megabyte takes rosbags half a minute

# rosbags decompresses without a limit; its tables are where one can be set
storage_mcap.DECOMPRESSORS["lz4"] = lambda data, _: limits.decompress("lz4", data)
storage_mcap.DECOMPRESSORS["zstd"] = lambda data, _: limits.decompress("zstd", data)
_BOUNDED = {
    rosbag1.decompressors[name]: partial(limits.decompress, name) for name in ("bz2", "lz4")
}


def _parse_qos(text: Any) -> list[Qos]:
    return [] if isinstance(text, str) and len(text) > _MAX_QOS_TEXT else parse_qos(text)


for _module in (storage_mcap, storage_sqlite3):
    vars(_module).update(parse_qos=_parse_qos)


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


def _open_db3(path: Path) -> Any:
    # rosbags builds a URI from the path without quoting it
    reader = storage_sqlite3.Sqlite3Reader(Path(limits.database_path(path)))
    with limits.limit_databases(path):
        reader.open()
    return reader


def _open_other(make: Callable[[Path], Any], path: Path) -> Any:
    reader = make(InputPath(path))
    reader.open()
    return reader


_STORAGES: dict[bytes, tuple[str, Callable[[Path], Any]]] = {  # by first bytes: name, reader
    BAG1_MAGIC + b"2.0\n": ("ROS 1 bag", partial(_open_other, _Bag1Reader)),
    MCAP_MAGIC: ("MCAP", partial(_open_other, storage_mcap.McapReader)),
    DB3_MAGIC: ("SQLite bag", _open_db3),
}


class IndexedBag:
    """See `Bag`; any error of rosbags means damage."""

    def __init__(self, kind: str, reader: Any) -> None:
        self.kind, self._reader, self.damage = kind, reader, SkippedRecords()
        self.channels = [_channel(connection) for connection in reader.connections]

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """See `Bag`."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        channels = {c.id: c for c in self.channels}
        source = self._reader.messages(connections, start=since_ns) if connections else iter(())
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
        self._reader.close()


def _channel(connection: Any) -> Channel:
    ext = connection.ext
    is_text = connection.msgdef.format == MessageDefinitionFormat.MSG
    names = connection.id, connection.topic, connection.msgtype, "ros1"
    definition = connection.msgdef.data if is_text else ""
    channel = Channel(*names, connection.msgcount, connection.digest, definition)
    if isinstance(ext, ConnectionExtRosbag2):
        qos = tuple(ext.offered_qos_profiles)
        latched = any(q.durability == QosDurability.TRANSIENT_LOCAL for q in qos)
        channel = channel._replace(encoding=ext.serialization_format, latched=latched, qos=qos)
    else:
        channel = channel._replace(latched=bool(ext.latching), publisher=ext.callerid or "")
    if not all(isinstance(word, str) for word in (*channel[1:4], channel.digest)):
        raise DamagedBagError("a topic whose name or type is no text")
    return channel


class JoinedBag:
    """Several bags, in order of time, as one; equal channels become one."""

    def __init__(self, bags: list[Bag], kind: str) -> None:
        self._bags, self.kind = bags, kind
        self.damage = SkippedRecords().merge(*(bag.damage for bag in bags))
        self._channels: dict[tuple[str, str, str, str], Channel] = {}
        for bag in bags:
            for channel in bag.channels:
                new = channel._replace(id=len(self._channels), n_messages=0)
                first = self._channels.setdefault(_identity(channel), new)
                count = first.n_messages + channel.n_messages
                self._channels[_identity(channel)] = first._replace(n_messages=count)
        self.channels = list(self._channels.values())

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """See `Bag`."""
        for bag in self._bags:
            for message in bag.messages(topics, since_ns):
                yield message._replace(channel=self._channels[_identity(message.channel)])

    def close(self) -> None:
        """See `Bag`."""
        for bag in self._bags:
            bag.close()


def _identity(channel: Channel) -> tuple[str, str, str, str]:
    return channel.topic, channel.type, channel.encoding, channel.digest


class _CompressedBag:
    """A file compressed as a whole, decompressed into a folder that lives until `close`."""

    def __init__(self, path: Path, scratch: Path | None, trusted: bool) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix=".stillmap-", dir=scratch)
        try:
            file = Path(self._folder.name) / path.name.removesuffix(".zstd")
            is_whole = limits.decompress_file(path, file)
            self._bag = _open_file(file, scratch, trusted and is_whole)
        except BaseException:
            self._folder.cleanup()
            raise
        self.kind = f"{self._bag.kind}, compressed"
        self.channels, self.damage = self._bag.channels, self._bag.damage
        self.messages = self._bag.messages

    def close(self) -> None:
        self._bag.close()
        self._folder.cleanup()


def open_bag(paths: Sequence[Path], scratch: Path | None, *, trusted: bool) -> Bag:
    """Open a bag, or the parts of one run as one bag.

    Args:
        paths: files or folders of files, in order of time.
        scratch: folder for files that have to be decompressed; None: the system's.
        trusted: read with the index; else recover what is there, from the front.

    Raises:
        DamagedBagError: `trusted`, and a bag is damaged or has no index.
        InputError: no readable bag.
    """
    bags: list[Bag] = []
    try:
        for file in _list_all_files(paths):
            bags.append(_open_file(file, scratch, trusted))
    except BaseException:
        for bag in bags:
            bag.close()
        raise
    if len(paths) == 1 and not paths[0].is_dir():
        return bags[0]
    kinds = ", ".join(dict.fromkeys(bag.kind for bag in bags))
    return JoinedBag(bags, f"ROS 2 folder ({kinds})" if paths[0].is_dir() else kinds)


def bag_size(paths: Sequence[Path]) -> int:
    """Bytes of all files of bags."""
    return sum(file.stat().st_size for file in _list_all_files(paths))


def _open_file(path: Path, scratch: Path | None, trusted: bool) -> Bag:
    with InputFile(path) as file:
        start = file.read(32)
    if is_compressed(path, start):
        return _CompressedBag(path, scratch, trusted)
    for magic, (kind, open_indexed) in _STORAGES.items():
        if start.startswith(magic):
            try:
                return IndexedBag(kind, open_indexed(path)) if trusted else DamagedBag(kind, path)
            except InputError as error:
                raise InputError(error.what, where=str(path), hint=error.hint) from error
            except PermissionError as error:
                raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
            except Exception as error:  # any error of a library about damaged bytes
                raise DamagedBagError(str(error) or type(error).__name__) from error
    if start.startswith(BAG1_MAGIC):
        version = start[8:13].decode("ascii", "replace").strip()
        hint = "`rosbag fix` or `rosbag reindex` of ROS 1 makes a V2.0 of it"
        raise InputError(f"is a bag of version {version}", where=str(path), hint=hint)
    raise InputError("is no bag, in spite of its name", where=str(path))


def _list_all_files(paths: Sequence[Path]) -> list[Path]:
    return [file for path in paths for file in (_list_files(path) if path.is_dir() else [path])]


def _list_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 folder in the order of `metadata.yaml`, if there is one."""
    present = storage_files(folder)
    try:
        about = yaml.safe_load(read_text(folder / "metadata.yaml", _MAX_METADATA))
        names = about["rosbag2_bagfile_information"]["relative_file_paths"]
        # YAML aliases can nest lists without end
        paths = [folder / Path(name).name for name in names if isinstance(name, str)]
    except (InputError, ValueError, LookupError, TypeError, RecursionError, yaml.YAMLError):
        return present
    missing = [path.name for path in paths if path not in present]
    if missing:
        what = f"lacks the file {missing[0]!r} that its metadata.yaml names"
        hint = "without metadata.yaml the files that are there are read"
        raise InputError(what, where=str(folder), hint=hint)
    return paths or present
