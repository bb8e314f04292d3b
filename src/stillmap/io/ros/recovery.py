"""Recovery of bags that are cut, damaged or without an index: read sequentially from the front.

A chunk that cannot be decompressed is skipped and counted; at the first invalid record reading
ends and everything before it is kept.
"""

import os
import sqlite3
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import IO

from rosbags.rosbag1.reader import Header, RecordType, normalize
from rosbags.typesys.msg import normalize_msgtype

from stillmap.core.input_files import InputFile, ShorterFileError
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.builder import SkippedRecords
from stillmap.io.ros import limits
from stillmap.io.ros.messages import Channel

CUT = "end that is no record"
BAD_CHUNK = "chunk that cannot be decompressed"
BAD_ROWS = "rows that cannot be read"

_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK = 0x03, 0x04, 0x05, 0x06
_MCAP_MAGIC_BYTE = 0x89

Record = tuple[int, int, bytes]  # number of the channel, log time in ns, content


class _CutError(Exception):
    """The records end before the file does."""


class DamagedFile:
    """A file of a bag: all that can be read of it.

    Attributes:
        kind: readable name.
        channels: by their number in the file.
        damage: unreadable parts by reason and byte position.
    """

    def __init__(self, kind: str, path: Path) -> None:
        self.kind, self._path, self.damage = kind, path, SkippedRecords()
        self._is_bag1 = kind.startswith("ROS 1")
        self.channels: dict[int, Channel] = {}
        self._schemas: dict[int, str] = {}
        count = Counter(channel for channel, _, _ in self._all_records())
        self.channels = {n: c._replace(n_messages=count[n]) for n, c in self.channels.items()}

    def records(self, wanted: Collection[int], since_ns: int | None) -> Iterator[Record]:
        """The messages of these channels, from a log time on."""
        for record in self._all_records():
            if record[0] in wanted and (since_ns is None or record[1] >= since_ns):
                yield record

    def _all_records(self) -> Iterator[Record]:
        if self.kind.startswith("SQLite"):
            yield from self._rows()
            return
        with InputFile(self._path) as file:
            file.seek(len(b"#ROSBAG V2.0\n") if self._is_bag1 else 8)
            yield from self._until_cut(file)

    def _until_cut(self, file: IO[bytes], chunk_at: int | None = None) -> Iterator[Record]:
        """Records of a file, or of a decompressed chunk, up to the first invalid one."""
        try:
            yield from self._scan(file, chunk_at is not None)
        except (limits.OutputLimitError, ShorterFileError):
            raise
        except Exception:  # any error of a library about damaged bytes
            self.damage.add(CUT, file.tell() if chunk_at is None else chunk_at)

    def _scan(self, file: IO[bytes], in_chunk: bool) -> Iterator[Record]:
        at, end = file.tell(), file.seek(0, os.SEEK_END)
        file.seek(at)
        while (at := file.tell()) < end:
            limits.count_output(limits.RECORD_COST)
            header = Header.read(file) if self._is_bag1 else Header()  # type: ignore[arg-type]
            kind = header.get_uint8("op") if self._is_bag1 else _read_number(file, 1)
            if not self._is_bag1 and kind == _MCAP_MAGIC_BYTE:  # of the footer
                return
            size = _read_number(file, 4 if self._is_bag1 else 8)
            data = file.read(min(size, end - file.tell()))
            is_chunk = kind == (RecordType.CHUNK if self._is_bag1 else _MCAP_CHUNK)
            if is_chunk and not in_chunk:
                yield from self._chunk(header, data, at)
            elif is_chunk or kind == 0 or len(data) < size:
                raise _CutError
            elif self._is_bag1:
                yield from self._read_bag1(kind, header, data)
            else:
                yield from self._read_mcap(kind, data)

    def _chunk(self, header: Header, data: bytes, at: int) -> Iterator[Record]:
        """Records of a chunk at a position; the beginning of a cut one can be decompressed."""
        try:
            if self._is_bag1:
                compression = header.get_string("compression")
            else:
                record = BytesIO(data[28:])
                compression = _read_text(record)
                data = record.read(min(_read_number(record, 8), len(data)))
            raw = data if compression in ("", "none") else limits.decompress(compression, data)
        except limits.OutputLimitError:
            raise
        except Exception:  # any error of a library about damaged bytes
            self.damage.add(BAD_CHUNK, at)
        else:
            yield from self._until_cut(BytesIO(raw), at)

    def _read_bag1(self, kind: int, header: Header, data: bytes) -> Iterator[Record]:
        if kind == RecordType.CONNECTION:
            fields = Header.read(BytesIO(struct.pack("<I", len(data)) + data))
            topic, name = normalize(header.get_string("topic")), fields.get_string("type")
            number, digest = header.get_uint32("conn"), fields.get_string("md5sum")
            channel = Channel(number, topic, normalize_msgtype(name), "ros1", digest=digest)
            self.channels.setdefault(number, channel)
        elif kind == RecordType.MSGDATA:
            yield header.get_uint32("conn"), header.get_time("time"), data

    def _read_mcap(self, kind: int, data: bytes) -> Iterator[Record]:
        record = BytesIO(data)
        if kind == _MCAP_SCHEMA:
            number = _read_number(record, 2)
            self._schemas[number] = _read_text(record)
        elif kind == _MCAP_CHANNEL:
            number, name = _read_number(record, 2), self._schemas.get(_read_number(record, 2), "")
            topic, encoding = _read_text(record), _read_text(record)
            self.channels.setdefault(number, Channel(number, topic, name, encoding))
        elif kind == _MCAP_MESSAGE:
            number, _, log_ns, _ = struct.unpack_from("<HIQQ", data)
            yield number, min(log_ns, MAX_STAMP_NS), data[22:]

    def _rows(self) -> Iterator[Record]:
        rows = 0
        try:
            with closing(limits.open_database(self._path)) as database:
                topics = "SELECT id, name, type, serialization_format FROM topics"
                for number, *words in database.execute(topics):
                    if all(isinstance(word, str) for word in words):
                        self.channels.setdefault(number, Channel(number, *words))
                messages = "SELECT topic_id, timestamp, data FROM messages"
                for number, log_ns, raw in database.execute(messages):
                    rows += 1
                    if isinstance(raw, bytes) and is_log_time(log_ns) and number in self.channels:
                        yield number, log_ns, raw
        except sqlite3.Error:
            self.damage.add(BAD_ROWS, rows + 1)


def is_log_time(value: object) -> bool:
    """True for log times in ns: columns of SQLite are not typed."""
    return isinstance(value, int) and abs(value) <= MAX_STAMP_NS


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
