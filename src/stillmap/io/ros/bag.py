"""Opens bags of every kind, detected by their first bytes; rosbags reads those with an index."""

import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

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
    Channel,
    DamagedBagError,
    Message,
    is_compressed,
    storage_files,
)
from stillmap.io.ros.recovery import DamagedFile, Record, is_log_time

T = TypeVar("T")

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


class _IndexedFile:
    """A file read by rosbags, with the attributes of `DamagedFile`; any error means damage."""

    def __init__(self, kind: str, reader: Any) -> None:
        self.kind, self._reader, self.damage = kind, reader, SkippedRecords()
        self.channels = {c.id: _channel(c) for c in reader.connections}
        self.close = reader.close

    def records(self, wanted: Collection[int], since_ns: int | None) -> Iterator[Record]:
        """The messages of these channels, from a log time on."""
        connections = [c for c in self._reader.connections if c.id in wanted]
        if not connections:
            return
        try:
            for connection, log_ns, raw in self._reader.messages(connections, start=since_ns):
                if not (is_log_time(log_ns) and isinstance(raw, bytes)):
                    raise DamagedBagError("a message without time or content")
                yield connection.id, log_ns, raw
        except (InputError, DamagedBagError):
            raise
        except Exception as error:  # any error of rosbags about damaged bytes
            raise DamagedBagError(str(error) or type(error).__name__) from error


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


_File = _IndexedFile | DamagedFile


class Bag:
    """A bag, or the parts of one run in order of time, as one; equal channels become one.

    Attributes:
        kind: readable name.
        channels: all channels.
        damage: unreadable parts by reason and byte position.

    Args:
        paths: files or folders of files, in order of time.
        scratch: folder for files that have to be decompressed; None: the system's.
        trusted: read with the index; else recover what is there, from the front.

    Raises:
        DamagedBagError: `trusted`, and a bag is damaged or has no index.
        InputError: no readable bag.
    """

    def __init__(self, paths: Sequence[Path], scratch: Path | None, *, trusted: bool) -> None:
        self._open = partial(Bag, paths, scratch, trusted=trusted)
        with ExitStack() as stack:
            files = _list_all_files(paths)
            self._files = [_open_file(file, scratch, trusted, stack) for file in files]
            self.close = stack.pop_all().close
        kinds = ", ".join(dict.fromkeys(file.kind for file in self._files))
        self.kind = f"ROS 2 folder ({kinds})" if paths[0].is_dir() else kinds
        self.damage = SkippedRecords().merge(*(file.damage for file in self._files))
        joined: dict[Channel, Channel] = {}
        for channel in (c for file in self._files for c in file.channels.values()):
            same = channel._replace(id=0, n_messages=0)
            known = joined.get(same, same._replace(id=len(joined)))
            joined[same] = known._replace(n_messages=known.n_messages + channel.n_messages)
        self.channels = list(joined.values())
        self._joined = [
            {n: joined[c._replace(id=0, n_messages=0)] for n, c in file.channels.items()}
            for file in self._files
        ]

    def reopen(self) -> "Bag":
        """Open the same files again."""
        return self._open()

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """Messages of these topics, roughly by log time; with `since_ns` no earlier ones.

        Raises:
            DamagedBagError: an indexed bag is damaged.
        """
        for file, joined in zip(self._files, self._joined, strict=True):
            channels = {number: c for number, c in joined.items() if c.topic in topics}
            if channels:
                for number, log_ns, raw in file.records(channels.keys(), since_ns):
                    yield Message(channels[number], log_ns, raw)


def read_bag(
    paths: Sequence[Path], scratch: Path | None, use: Callable[[Bag], T], more: Sequence[Path] = ()
) -> tuple[T, str]:
    """Calls `use` on a bag, opened by its index or else by recovery; its result and the damage.

    Args:
        paths, scratch: see Bag.
        use: may be called twice.
        more: bags that `use` opens too.

    Raises:
        InputError: nothing can be read, or `use` says so.
    """
    damage, where, size = "", str(paths[0]), sum(f.stat().st_size for f in _list_all_files(paths))
    size += sum(file.stat().st_size for file in _list_all_files(more))
    for trusted in (True, False):
        try:
            with limits.limit_output(size), closing(Bag(paths, scratch, trusted=trusted)) as bag:
                return use(bag), damage
        except DamagedBagError as error:
            damage = str(error).rstrip(".")
        except InputError as error:
            what = f"{error.what}; it is damaged: {damage}" if damage else error.what
            raise InputError(what, where=error.where or where, hint=error.hint) from error
    raise InputError(f"is damaged: {damage}", where=where)


def _open_file(path: Path, scratch: Path | None, trusted: bool, stack: ExitStack) -> _File:
    """Open a file until the `stack` is closed."""
    with InputFile(path) as file:
        start = file.read(32)
    if is_compressed(path, start):
        folder = tempfile.TemporaryDirectory(prefix=".stillmap-", dir=scratch)
        unpacked = Path(stack.enter_context(folder)) / path.name.removesuffix(".zstd")
        is_whole = limits.decompress_file(path, unpacked)
        part = _open_file(unpacked, scratch, trusted and is_whole, stack)
        part.kind += ", compressed"
        return part
    for magic, (kind, open_indexed) in _STORAGES.items():
        if start.startswith(magic):
            try:
                if not trusted:
                    return DamagedFile(kind, path)
                indexed = _IndexedFile(kind, open_indexed(path))
            except InputError as error:
                raise InputError(error.what, where=str(path), hint=error.hint) from error
            except PermissionError as error:
                raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from error
            except Exception as error:  # any error of a library about damaged bytes
                raise DamagedBagError(str(error) or type(error).__name__) from error
            stack.callback(indexed.close)
            return indexed
    hint = "`rosbag fix` of ROS 1 makes version 2.0 of older bags"
    raise InputError("is no bag of ROS 1 (version 2.0) or ROS 2", where=str(path), hint=hint)


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
