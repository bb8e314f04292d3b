"""Bags that are cut, damaged or without index: read from the front, as far as they go.

A chunk that cannot be unpacked is skipped and counted; where the records themselves no longer
make sense, reading ends and what came before is kept.
"""

import dataclasses
import os
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from rosbags.rosbag1.reader import Header, RecordType, normalize
from rosbags.typesys.msg import normalize_msgtype

from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import limits, sqlite_limits
from stillmap.io.ros.bag_types import MAX_STAMP_NS, Channel, Message

CUT = "end that is no record"
BAD_CHUNK = "chunk that cannot be unpacked"
BAD_ROWS = "rows that cannot be read"

_UNPACKED: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "none": bytes,
    "bz2": limits.decompress_bz2,
    "lz4": limits.decompress_lz4,
    "zstd": limits.decompress_zstd,
}

_Scan = Callable[[dict[int, Channel], SkippedRecords], Iterator[tuple[int, int, bytes]]]


class _CutError(Exception):
    """The records end before the file does."""


@dataclasses.dataclass
class DamagedBag:
    """See `Bag`. `scan` yields channel id, log time and bytes, and enters channels it meets."""

    kind: str
    scan: _Scan
    channels: list[Channel] = dataclasses.field(default_factory=list)
    damage: SkippedRecords = dataclasses.field(default_factory=SkippedRecords)

    def __post_init__(self) -> None:
        found: dict[int, Channel] = {}
        count: dict[int, int] = {}
        for channel, _, _ in self.scan(found, self.damage):
            count[channel] = count.get(channel, 0) + 1
        self.channels = [c._replace(n_messages=count.get(c.id, 0)) for c in found.values()]

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


def open_bag1(path: Path) -> DamagedBag:
    """What can be read of a ROS 1 bag."""
    return DamagedBag("ROS 1 bag", lambda found, damage: _scan_bag1(path, found, damage))


def open_mcap(path: Path) -> DamagedBag:
    """What can be read of an MCAP file."""
    return DamagedBag("MCAP", lambda found, damage: _scan_mcap(path, found, damage))


def open_db3(path: Path) -> DamagedBag:
    """What can be read of a SQLite file."""
    return DamagedBag("SQLite bag", lambda found, damage: _scan_db3(path, found, damage))


def _scan_bag1(
    path: Path, found: dict[int, Channel], damage: SkippedRecords
) -> Iterator[tuple[int, int, bytes]]:
    with path.open("rb") as file:
        file.readline(64)  # #ROSBAG V2.0
        yield from _until_cut(file, damage, _bag1_records(file, found, damage, chunks=True))


def _bag1_records(
    file: IO[bytes], found: dict[int, Channel], damage: SkippedRecords, *, chunks: bool
) -> Iterator[tuple[int, int, bytes]]:
    """Records of a file, or of a chunk: none of these are `chunks` again."""
    end = _size(file)
    while file.tell() < end:
        at = file.tell()
        limits.count_output(limits.RECORD)
        header = Header.read(file)  # type: ignore[arg-type]
        kind, size = header.get_uint8("op"), _number(file, 4)
        if kind == RecordType.CHUNK and not chunks:
            raise _CutError
        # of a chunk that is cut the beginning can be unpacked
        data = file.read(size) if kind == RecordType.CHUNK else _exactly(file, size, end)
        if kind == RecordType.CHUNK:
            try:
                inner = BytesIO(_unpacked(header.get_string("compression"), data))
            except limits.OutputLimitError:
                raise
            except Exception:  # whatever a library makes of damaged bytes
                damage.add(BAD_CHUNK, at)
                continue
            records = _bag1_records(inner, found, damage, chunks=False)
            yield from _until_cut(inner, damage, records, at)
        elif kind == RecordType.CONNECTION:
            channel = _bag1_channel(header, data)
            found.setdefault(channel.id, channel)
        elif kind == RecordType.MSGDATA:
            yield header.get_uint32("conn"), header.get_time("time"), data


def _bag1_channel(header: Header, data: bytes) -> Channel:
    packed = BytesIO(struct.pack("<I", len(data)) + data)
    more = Header.read(packed)
    kind = normalize_msgtype(more.get_string("type"))
    topic = normalize(header.get_string("topic"))
    return Channel(header.get_uint32("conn"), topic, kind, "ros1", 0, more.get_string("md5sum"))


def _scan_mcap(
    path: Path, found: dict[int, Channel], damage: SkippedRecords
) -> Iterator[tuple[int, int, bytes]]:
    schemas: dict[int, str] = {}
    with path.open("rb") as file:
        file.read(8)  # magic
        records = _mcap_records(file, schemas, found, damage, chunks=True)
        yield from _until_cut(file, damage, records)


def _mcap_records(
    file: IO[bytes],
    schemas: dict[int, str],
    found: dict[int, Channel],
    damage: SkippedRecords,
    *,
    chunks: bool,
) -> Iterator[tuple[int, int, bytes]]:
    """See `_bag1_records`."""
    end = _size(file)
    while file.tell() < end:
        at = file.tell()
        limits.count_output(limits.RECORD)
        kind = _number(file, 1)
        if kind == 0x89:  # the magic at the end
            return
        if kind == 0:
            raise _CutError
        size = min(_number(file, 8), end)
        # of a chunk that is cut the beginning can be unpacked
        data = file.read(size) if kind == 0x06 else _exactly(file, size, end)
        record = BytesIO(data)
        if kind == 0x03:
            number = _number(record, 2)
            schemas[number] = _text(record)
        elif kind == 0x04:
            number, schema = _number(record, 2), _number(record, 2)
            topic, encoding = _text(record), _text(record)
            name = schemas.get(schema, "")
            found.setdefault(number, Channel(number, topic, name, encoding, 0, ""))
        elif kind == 0x05:
            number, _, log_ns, _ = struct.unpack("<HIQQ", _exactly(record, 22, len(data)))
            yield number, min(log_ns, MAX_STAMP_NS), data[22:]
        elif kind == 0x06:
            if not chunks:
                raise _CutError
            try:
                record.seek(28)
                packing = _text(record)
                size = min(_number(record, 8), len(data))
                inner = BytesIO(_unpacked(packing, record.read(size)))
            except limits.OutputLimitError:
                raise
            except Exception:  # whatever a library makes of damaged bytes
                damage.add(BAD_CHUNK, at)
                continue
            records = _mcap_records(inner, schemas, found, damage, chunks=False)
            yield from _until_cut(inner, damage, records, at)


def _scan_db3(
    path: Path, found: dict[int, Channel], damage: SkippedRecords
) -> Iterator[tuple[int, int, bytes]]:
    rows = 0
    try:
        with closing(sqlite_limits.open_database(path)) as database:
            for number, topic, kind, encoding in database.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            ):
                if all(isinstance(word, str) for word in (topic, kind, encoding)):
                    found.setdefault(number, Channel(number, topic, kind, encoding, 0, ""))
            for number, log_ns, raw in database.execute(
                "SELECT topic_id, timestamp, data FROM messages"
            ):
                rows += 1
                if isinstance(raw, bytes) and isinstance(log_ns, int) and number in found:
                    yield number, log_ns, raw
    except sqlite3.Error:
        damage.add(BAD_ROWS, rows + 1)


def _until_cut(
    file: IO[bytes],
    damage: SkippedRecords,
    records: Iterator[tuple[int, int, bytes]],
    at: int | None = None,
) -> Iterator[tuple[int, int, bytes]]:
    """Records up to the first that makes no sense; `at` is where an outer chunk begins."""
    try:
        yield from records
    except limits.OutputLimitError:
        raise
    except Exception:  # whatever a library makes of damaged bytes
        damage.add(CUT, file.tell() if at is None else at)


def _unpacked(packing: str, data: bytes) -> bytes:
    return _UNPACKED[packing](data)


def _size(file: IO[bytes]) -> int:
    at = file.tell()
    end = file.seek(0, os.SEEK_END)
    file.seek(at)
    return end


def _exactly(file: IO[bytes], size: int, end: int) -> bytes:
    if size > end - file.tell():
        raise _CutError
    return file.read(size)


def _number(file: IO[bytes], size: int) -> int:
    data = file.read(size)
    if len(data) != size:
        raise _CutError
    return int.from_bytes(data, "little")


def _text(file: IO[Any]) -> str:
    size = _number(file, 4)
    data: bytes = file.read(size)
    if len(data) != size:
        raise _CutError
    return data.decode()
