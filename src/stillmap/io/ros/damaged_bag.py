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
from typing import IO, Any

from rosbags.rosbag1.reader import Header, RecordType, normalize
from rosbags.typesys.msg import normalize_msgtype

from stillmap.core.input_files import InputFile, ShorterFileError
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import limits
from stillmap.io.ros.bag_types import Channel, Message, is_log_time

CUT = "end that is no record"
BAD_CHUNK = "chunk that cannot be decompressed"
BAD_ROWS = "rows that cannot be read"

_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK = 0x03, 0x04, 0x05, 0x06
_MCAP_MAGIC_BYTE = 0x89

Records = Iterator[tuple[int, int, bytes]]  # channel id, log time in ns, content
_Scan = Callable[[dict[int, Channel], SkippedRecords], Records]


class _CutError(Exception):
    """The records end before the file does."""


class DamagedBag:
    """See `Bag`. `scan` yields records and enters the channels that it meets."""

    def __init__(self, kind: str, scan: _Scan) -> None:
        self.kind, self.scan, self.damage = kind, scan, SkippedRecords()
        found: dict[int, Channel] = {}
        count = Counter(channel for channel, _, _ in scan(found, self.damage))
        self.channels = [c._replace(n_messages=count[c.id]) for c in found.values()]

    def messages(self, topics: set[str], since_ns: int | None = None) -> Iterator[Message]:
        """See `Bag`."""
        wanted = {c.id: c for c in self.channels if c.topic in topics}
        if not wanted:
            return
        for channel, log_ns, raw in self.scan({}, SkippedRecords()):
            if channel in wanted and (since_ns is None or log_ns >= since_ns):
                yield Message(wanted[channel], log_ns, raw)

    def close(self) -> None:
        """See `Bag`."""


def scan_bag1(path: Path, found: dict[int, Channel], damage: SkippedRecords) -> Records:
    """Records of a ROS 1 bag."""
    with InputFile(path) as file:
        file.readline(64)  # #ROSBAG V2.0
        yield from _until_cut(file, damage, _bag1_records(file, found, damage))


def _bag1_records(
    file: IO[bytes], found: dict[int, Channel], damage: SkippedRecords, *, in_chunk: bool = False
) -> Records:
    """Records of a file, or of a decompressed chunk, which holds no further chunks."""
    end = _size(file)
    while file.tell() < end:
        at = file.tell()
        limits.count_output(limits.RECORD_COST)
        header = Header.read(file)  # type: ignore[arg-type]
        kind, size = header.get_uint8("op"), _read_number(file, 4)
        if kind == RecordType.CHUNK:
            if in_chunk:
                raise _CutError
            # the beginning of a cut chunk can be decompressed
            read = partial(_bag1_chunk, header, file.read(size))
            records = partial(_bag1_records, found=found, damage=damage, in_chunk=True)
            yield from _chunk_records(read, records, damage, at)
            continue
        data = _read_exactly(file, size, end)
        if kind == RecordType.CONNECTION:
            channel = _bag1_channel(header, data)
            found.setdefault(channel.id, channel)
        elif kind == RecordType.MSGDATA:
            yield header.get_uint32("conn"), header.get_time("time"), data


def _bag1_chunk(header: Header, data: bytes) -> tuple[str, bytes]:
    return header.get_string("compression"), data


def _bag1_channel(header: Header, data: bytes) -> Channel:
    fields = Header.read(BytesIO(struct.pack("<I", len(data)) + data))
    kind = normalize_msgtype(fields.get_string("type"))
    topic = normalize(header.get_string("topic"))
    return Channel(header.get_uint32("conn"), topic, kind, "ros1", 0, fields.get_string("md5sum"))


def scan_mcap(path: Path, found: dict[int, Channel], damage: SkippedRecords) -> Records:
    """Records of an MCAP file."""
    with InputFile(path) as file:
        file.read(8)  # magic
        yield from _until_cut(file, damage, _mcap_records(file, {}, found, damage))


def _mcap_records(
    file: IO[bytes],
    schemas: dict[int, str],
    found: dict[int, Channel],
    damage: SkippedRecords,
    *,
    in_chunk: bool = False,
) -> Records:
    """See `_bag1_records`."""
    end = _size(file)
    while file.tell() < end:
        at = file.tell()
        limits.count_output(limits.RECORD_COST)
        kind = _read_number(file, 1)
        if kind == _MCAP_MAGIC_BYTE:  # of the footer
            return
        if kind == 0 or (kind == _MCAP_CHUNK and in_chunk):
            raise _CutError
        size = min(_read_number(file, 8), end)
        if kind == _MCAP_CHUNK:
            # the beginning of a cut chunk can be decompressed
            read = partial(_mcap_chunk, file.read(size))
            records = partial(
                _mcap_records, schemas=schemas, found=found, damage=damage, in_chunk=True
            )
            yield from _chunk_records(read, records, damage, at)
            continue
        data = _read_exactly(file, size, end)
        record = BytesIO(data)
        if kind == _MCAP_SCHEMA:
            number = _read_number(record, 2)
            schemas[number] = _read_text(record)
        elif kind == _MCAP_CHANNEL:
            number, schema = _read_number(record, 2), _read_number(record, 2)
            topic, encoding = _read_text(record), _read_text(record)
            name = schemas.get(schema, "")
            found.setdefault(number, Channel(number, topic, name, encoding, 0, ""))
        elif kind == _MCAP_MESSAGE:
            number, _, log_ns, _ = struct.unpack("<HIQQ", _read_exactly(record, 22, len(data)))
            yield number, min(log_ns, MAX_STAMP_NS), data[22:]


def _mcap_chunk(data: bytes) -> tuple[str, bytes]:
    record = BytesIO(data)
    record.seek(28)
    compression = _read_text(record)
    return compression, record.read(min(_read_number(record, 8), len(data)))


def _chunk_records(
    read: Callable[[], tuple[str, bytes]],
    records: Callable[[IO[bytes]], Records],
    damage: SkippedRecords,
    at: int,
) -> Records:
    """Records of a chunk of (compression, data) at a position; it is counted if it is damaged."""
    try:
        compression, data = read()
        raw = data if compression in ("", "none") else limits.decompress(compression, data)
    except (limits.OutputLimitError, ShorterFileError):
        raise
    except Exception:  # any error of a library about damaged bytes
        damage.add(BAD_CHUNK, at)
    else:
        chunk = BytesIO(raw)
        yield from _until_cut(chunk, damage, records(chunk), at)


def scan_db3(path: Path, found: dict[int, Channel], damage: SkippedRecords) -> Records:
    """Records of a SQLite file."""
    rows = 0
    try:
        with closing(limits.open_database(path)) as database:
            for number, topic, kind, encoding in database.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            ):
                if all(isinstance(word, str) for word in (topic, kind, encoding)):
                    found.setdefault(number, Channel(number, topic, kind, encoding, 0, ""))
            for number, log_ns, raw in database.execute(
                "SELECT topic_id, timestamp, data FROM messages"
            ):
                rows += 1
                if isinstance(raw, bytes) and is_log_time(log_ns) and number in found:
                    yield number, log_ns, raw
    except sqlite3.Error:
        damage.add(BAD_ROWS, rows + 1)


def _until_cut(
    file: IO[bytes], damage: SkippedRecords, records: Records, at: int | None = None
) -> Records:
    """Records up to the first invalid one; `at` is the position of the enclosing chunk."""
    try:
        yield from records
    except (limits.OutputLimitError, ShorterFileError):
        raise
    except Exception:  # any error of a library about damaged bytes
        damage.add(CUT, file.tell() if at is None else at)


def _size(file: IO[bytes]) -> int:
    at = file.tell()
    end = file.seek(0, os.SEEK_END)
    file.seek(at)
    return end


def _read_exactly(file: IO[bytes], size: int, end: int) -> bytes:
    if size > end - file.tell():
        raise _CutError
    return file.read(size)


def _read_number(file: IO[bytes], size: int) -> int:
    data = file.read(size)
    if len(data) != size:
        raise _CutError
    return int.from_bytes(data, "little")


def _read_text(file: IO[Any]) -> str:
    size = _read_number(file, 4)
    data: bytes = file.read(size)
    if len(data) != size:
        raise _CutError
    return data.decode()
