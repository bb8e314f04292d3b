"""Limits on what a bag may expand to, and recovery of damaged bags.

A few bytes can claim to be terabytes.
Decompression stops at `MAX_CHUNK`, the output of a whole bag at a multiple of its size. A SQLite
file can hold views that never end, generated columns, and trees in which one page occurs a million
times: its tables have to be plain tables, and the steps that a query may take are bounded.

Bags that are cut, damaged or without an index are read sequentially from the front. A chunk that
cannot be decompressed is skipped and counted; at the first invalid record reading ends and
everything before it is kept.
"""

import bz2
import os
import sqlite3
import struct
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from contextvars import ContextVar
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

import apsw
import lz4.frame  # type: ignore[import-untyped]
from rosbags.rosbag1.reader import Header, RecordType, normalize
from rosbags.typesys.msg import normalize_msgtype

from stillmap.core.errors import InputError
from stillmap.core.input_files import InputFile, ShorterFileError, require_regular
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros.messages import Channel, Message

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_CHUNK = 256 << 20  # bytes of one chunk or message; recorders write chunks of about one megabyte
RECORD_COST = 64  # bytes that a record counts for, even an empty one

_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
_MAX_RATIO, _MIN_LIMIT = 300, 512 << 20  # output of a bag: times its size; bytes
_TABLES = ("topics", "messages", "schema", "message_definitions")
_STEP_INTERVAL = 1000  # virtual machine steps between two calls of the progress handler
_STEPS_PER_BYTE = 30  # a row takes about 20 steps, and has at least as many bytes
_MIN_STEPS = 1_000_000  # a hundredth of a second


class OutputLimitError(InputError):
    """More data comes out of a file than can have been put in."""


_bytes_left: ContextVar[list[int] | None] = ContextVar("bytes_left", default=None)


@contextmanager
def limit_output(size: int) -> Iterator[None]:
    """Within this context a bag of `size` bytes yields no more than such a bag can hold.

    Its index may name one message a million times, and many small parts add up.
    """
    token = _bytes_left.set([max(_MAX_RATIO * size, _MIN_LIMIT)])
    try:
        yield
    finally:
        _bytes_left.reset(token)


def count_output(count: int) -> None:
    """Count bytes of output.

    Raises:
        OutputLimitError: the limit is exceeded.
    """
    left = _bytes_left.get()
    if left is None:
        return
    left[0] -= count
    if left[0] < 0:
        raise OutputLimitError(f"is damaged: it expands to more than {_MAX_RATIO} times its size")


def decompress(compression: str, data: bytes) -> bytes:
    """Decompress up to `MAX_CHUNK` bytes of a compression in `_DECOMPRESSORS`.

    Raises:
        InputError: there are more.
        Exception: any error of the library about damaged data.
    """
    count_output(0)
    out = bytes(_DECOMPRESSORS[compression]().decompress(data, MAX_CHUNK + 1))
    count_output(len(out))
    if len(out) > MAX_CHUNK:
        what = f"a compressed part is larger than {MAX_CHUNK >> 20} MiB"
        raise InputError(what, hint="a recording compressed in smaller chunks can be read")
    return out


def decompress_file(path: Path, out: Path) -> bool:
    """Decompress a file of zstd frames; False if only its beginning could be, as it is damaged.

    Raises:
        InputError: it becomes too large.
    """
    with InputFile(path) as source, zstd.open(source, "rb") as stream, out.open("wb") as file:
        limit = max(_MAX_RATIO * source.size, _MIN_LIMIT)
        try:
            while piece := stream.read(1 << 20):
                file.write(piece)
                if file.tell() > limit:
                    what = f"decompresses to more than {_MAX_RATIO} times its size"
                    raise InputError(what, where=str(path))
        except (zstd.ZstdError, EOFError):
            return False
    return True


def database_path(path: Path) -> str:
    """The path quoted for a SQLite URI, in which ?, # and % have a meaning."""
    return quote(os.path.realpath(os.fsencode(path)))


def open_database(path: Path) -> sqlite3.Connection:
    """Open a SQLite file for reading, with checked tables and bounded queries.

    Raises:
        sqlite3.Error: it cannot be read.
        InputError: a table is a view, a virtual table or has generated columns.
    """
    require_regular(path)
    database = sqlite3.connect(f"file:{database_path(path)}?immutable=1&mode=ro", uri=True)
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK)
        database.set_progress_handler(_step_counter(path), _STEP_INTERVAL)
        query = "SELECT name, type, sql FROM sqlite_master WHERE name = ? COLLATE NOCASE"
        for table in _TABLES:
            for name, kind, sql in database.execute(query, (table,)).fetchall():
                plain = kind == "table" and str(sql).upper().startswith("CREATE TABLE")
                info = f"PRAGMA table_xinfo({table})"
                if not plain or any(column[-1] for column in database.execute(info).fetchall()):
                    raise InputError(f"is no bag: its {name} are no plain table")
    except BaseException:
        database.close()
        raise
    return database


@contextmanager
def limit_databases(path: Path) -> Iterator[None]:
    """Apply the limits of `open_database` to databases that rosbags opens in this context.

    Raises:
        sqlite3.Error, InputError: see `open_database`.
    """
    open_database(path).close()

    def limit(database: apsw.Connection) -> None:
        database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_CHUNK)
        database.set_progress_handler(_step_counter(path), _STEP_INTERVAL)

    apsw.connection_hooks.append(limit)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(limit)


def _step_counter(path: Path) -> Callable[[], bool]:
    """A progress handler that returns True, which aborts the query, after too many steps."""
    left = _MIN_STEPS + _STEPS_PER_BYTE * path.stat().st_size

    def exceeded() -> bool:
        nonlocal left
        left -= _STEP_INTERVAL
        return left < 0

    return exceeded


CUT = "end that is no record"
BAD_CHUNK = "chunk that cannot be decompressed"
BAD_ROWS = "rows that cannot be read"

_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK = 0x03, 0x04, 0x05, 0x06
_MCAP_MAGIC_BYTE = 0x89

_Records = Iterator[tuple[int, int, bytes]]  # channel id, log time in ns, content
# records of a file, or of a decompressed chunk, which holds no further chunks
_Scan = Callable[["DamagedBag", IO[bytes], bool], _Records]


class _CutError(Exception):
    """The records end before the file does."""


class DamagedBag:
    """See `Bag`."""

    def __init__(self, kind: str, path: Path) -> None:
        self.kind, self._path, self.damage = kind, path, SkippedRecords()
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, str] = {}
        count = Counter(channel for channel, _, _ in self._records())
        self.channels = [c._replace(n_messages=count[c.id]) for c in self._channels.values()]

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """See `Bag`."""
        wanted = {c.id: c for c in self.channels if c.topic in topics}
        damage, self.damage = self.damage, SkippedRecords()
        for channel, log_ns, raw in self._records() if wanted else ():
            if channel in wanted and (since_ns is None or log_ns >= since_ns):
                yield Message(wanted[channel], log_ns, raw)
        self.damage = damage

    def close(self) -> None:
        """See `Bag`."""

    def _records(self) -> _Records:
        if self.kind.startswith("SQLite"):
            yield from self._rows()
            return
        with InputFile(self._path) as file:
            is_bag1 = self.kind.startswith("ROS 1")
            file.seek(len(b"#ROSBAG V2.0\n") if is_bag1 else 8)
            yield from self._until_cut(file, _scan_bag1 if is_bag1 else _scan_mcap)

    def _until_cut(self, file: IO[bytes], scan: _Scan, chunk_at: int | None = None) -> _Records:
        """Records up to the first invalid one."""
        try:
            yield from scan(self, file, chunk_at is not None)
        except (OutputLimitError, ShorterFileError):
            raise
        except Exception:  # any error of a library about damaged bytes
            self.damage.add(CUT, file.tell() if chunk_at is None else chunk_at)

    def chunk(self, unpack: Callable[[], tuple[str, bytes]], scan: _Scan, at: int) -> _Records:
        """Records of a chunk at a position; the beginning of a cut one can be decompressed.

        `unpack` gives its compression and content.
        """
        try:
            compression, data = unpack()
            raw = data if compression in ("", "none") else decompress(compression, data)
        except OutputLimitError:
            raise
        except Exception:  # any error of a library about damaged bytes
            self.damage.add(BAD_CHUNK, at)
        else:
            yield from self._until_cut(BytesIO(raw), scan, at)

    def add(self, channel: Channel) -> None:
        self._channels.setdefault(channel.id, channel)

    def add_mcap(self, kind: int, record: IO[bytes]) -> None:
        """Add a schema or channel of an MCAP file."""
        number = _read_number(record, 2)
        if kind == _MCAP_SCHEMA:
            self._schemas[number] = _read_text(record)
            return
        name = self._schemas.get(_read_number(record, 2), "")
        topic, encoding = _read_text(record), _read_text(record)
        self.add(Channel(number, topic, name, encoding))

    def _rows(self) -> _Records:
        rows = 0
        try:
            with closing(open_database(self._path)) as database:
                topics = "SELECT id, name, type, serialization_format FROM topics"
                for number, *words in database.execute(topics):
                    if all(isinstance(word, str) for word in words):
                        self.add(Channel(number, *words))
                messages = "SELECT topic_id, timestamp, data FROM messages"
                for number, log_ns, raw in database.execute(messages):
                    rows += 1
                    if isinstance(raw, bytes) and is_log_time(log_ns) and number in self._channels:
                        yield number, log_ns, raw
        except sqlite3.Error:
            self.damage.add(BAD_ROWS, rows + 1)


def is_log_time(value: object) -> bool:
    """True for log times in ns: columns of SQLite are not typed."""
    return isinstance(value, int) and abs(value) <= MAX_STAMP_NS


def _scan_bag1(bag: DamagedBag, file: IO[bytes], in_chunk: bool) -> _Records:
    end = _size(file)
    while (at := file.tell()) < end:
        count_output(RECORD_COST)
        header = Header.read(file)  # type: ignore[arg-type]
        kind, size = header.get_uint8("op"), _read_number(file, 4)
        data = file.read(min(size, end - file.tell()))
        if kind == RecordType.CHUNK and not in_chunk:
            yield from bag.chunk(partial(_unpack_bag1, header, data), _scan_bag1, at)
        elif kind == RecordType.CHUNK or len(data) < size:
            raise _CutError
        elif kind == RecordType.CONNECTION:
            fields = Header.read(BytesIO(struct.pack("<I", size) + data))
            topic, name = normalize(header.get_string("topic")), fields.get_string("type")
            number, digest = header.get_uint32("conn"), fields.get_string("md5sum")
            bag.add(Channel(number, topic, normalize_msgtype(name), "ros1", digest=digest))
        elif kind == RecordType.MSGDATA:
            yield header.get_uint32("conn"), header.get_time("time"), data


def _scan_mcap(bag: DamagedBag, file: IO[bytes], in_chunk: bool) -> _Records:
    end = _size(file)
    while (at := file.tell()) < end:
        count_output(RECORD_COST)
        kind = _read_number(file, 1)
        if kind == _MCAP_MAGIC_BYTE:  # of the footer
            return
        size = _read_number(file, 8)
        data = file.read(min(size, end - file.tell()))
        record = BytesIO(data)
        if kind == _MCAP_CHUNK and not in_chunk:
            yield from bag.chunk(partial(_unpack_mcap, record), _scan_mcap, at)
        elif kind in (0, _MCAP_CHUNK) or len(data) < size:
            raise _CutError
        elif kind in (_MCAP_SCHEMA, _MCAP_CHANNEL):
            bag.add_mcap(kind, record)
        elif kind == _MCAP_MESSAGE:
            number, _, log_ns, _ = struct.unpack_from("<HIQQ", data)
            yield number, min(log_ns, MAX_STAMP_NS), data[22:]


def _unpack_bag1(header: Header, data: bytes) -> tuple[str, bytes]:
    return header.get_string("compression"), data


def _unpack_mcap(record: BytesIO) -> tuple[str, bytes]:
    record.seek(28)
    compression = _read_text(record)
    return compression, record.read(min(_read_number(record, 8), len(record.getvalue())))


def _size(file: IO[bytes]) -> int:
    at = file.tell()
    end = file.seek(0, os.SEEK_END)
    file.seek(at)
    return end


def _read_number(file: IO[bytes], size: int) -> int:
    data = file.read(size)
    if len(data) != size:
        raise _CutError
    return int.from_bytes(data, "little")


def _read_text(file: IO[bytes]) -> str:
    size = _read_number(file, 4)
    data = file.read(size)
    if len(data) != size:
        raise _CutError
    return data.decode()
