"""Recovery of bags that are cut, damaged or without an index: read sequentially from the front.

A chunk that cannot be decompressed is skipped and counted; at the first invalid record reading
ends and everything before it is kept.
"""

import os
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO

from rosbags.rosbag1.reader import Header, RecordType, normalize
from rosbags.typesys.msg import normalize_msgtype

from stillmap.core.input_files import InputFile, ShorterFileError
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import limits
from stillmap.io.ros.messages import Channel, Message

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
        except (limits.OutputLimitError, ShorterFileError):
            raise
        except Exception:  # any error of a library about damaged bytes
            self.damage.add(CUT, file.tell() if chunk_at is None else chunk_at)

    def chunk(self, unpack: Callable[[], tuple[str, bytes]], scan: _Scan, at: int) -> _Records:
        """Records of a chunk at a position; the beginning of a cut one can be decompressed.

        `unpack` gives its compression and content.
        """
        try:
            compression, data = unpack()
            raw = data if compression in ("", "none") else limits.decompress(compression, data)
        except limits.OutputLimitError:
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
            with closing(limits.open_database(self._path)) as database:
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
        limits.count_output(limits.RECORD_COST)
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
        limits.count_output(limits.RECORD_COST)
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
