"""Mutates the content of bags, E57 and PCD files inside valid containers.

Mutations of single bytes hardly reach compressed, indexed or checksummed content: it is unpacked,
mutated and packed again. Each function takes the bytes of a file and `mutate`, which mutates some
bytes; a file that cannot be unpacked is mutated as it is.
"""

import bz2
import random
import sqlite3
import struct
from contextlib import closing

import lz4.frame
import lzf
from backports import zstd
from parts import Mutation

Record = tuple[bytes, bytes]  # header, content


def _resize(new: bytes, old: bytes, chance: random.Random) -> bytes:
    """Half of the time keep the old length, so that later offsets stay valid."""
    return new[: len(old)].ljust(len(old), b"\0") if chance.random() < 0.5 else new


# ROS 1


def _split_bag(data: bytes) -> tuple[list[Record], bytes]:
    """Records, and the bytes after them."""
    found, at = [], 0
    while at + 8 <= len(data):
        (n,) = struct.unpack_from("<I", data, at)
        if at + 8 + n > len(data):
            break
        (size,) = struct.unpack_from("<I", data, at + 4 + n)
        end = at + 8 + n + size
        if end > len(data):
            break
        found.append((data[at + 4 : at + 4 + n], data[at + 8 + n : end]))
        at = end
    return found, data[at:]


def join_bag(records: list[Record]) -> bytes:
    return b"".join(
        struct.pack("<I", len(head)) + head + struct.pack("<I", len(content)) + content
        for head, content in records
    )


def _fields(head: bytes) -> dict[bytes, bytes]:
    out, at = {}, 0
    while at + 4 <= len(head):
        (size,) = struct.unpack_from("<I", head, at)
        name, _, value = head[at + 4 : at + 4 + size].partition(b"=")
        out[name], at = value, at + 4 + size
    return out


def make_head(fields: dict[bytes, bytes]) -> bytes:
    lines = [name + b"=" + value for name, value in fields.items()]
    return b"".join(struct.pack("<I", len(line)) + line for line in lines)


_PACK = {b"none": bytes, b"bz2": bz2.compress, b"lz4": lz4.frame.compress}
_UNPACK = {b"none": bytes, b"bz2": bz2.decompress, b"lz4": lz4.frame.decompress}


def mutate_bag(data: bytes, mutate: Mutation, chance: random.Random) -> bytes:
    """Mutate a record of a ROS 1 bag or of its chunk."""
    start = data.find(b"\n") + 1
    records, rest = _split_bag(data[start:])
    chunks = [k for k, (head, _) in enumerate(records) if _fields(head).get(b"op") == b"\5"]
    try:
        if not chunks or chance.random() < 0.3:
            k = chance.randrange(len(records))
            head, content = records[k]
            new = (mutate(head), content) if chance.random() < 0.5 else (head, mutate(content))
            records[k] = new
            return data[:start] + join_bag(records) + rest
        k = chance.choice(chunks)
        fields = _fields(records[k][0])
        inside = _UNPACK[fields[b"compression"]](records[k][1])
        inner, tail = _split_bag(inside)
        if inner and chance.random() < 0.8:
            m = chance.randrange(len(inner))
            head, content = inner[m]
            inner[m] = head, _resize(mutate(content), content, chance)
            inside = join_bag(inner) + tail
        else:
            inside = _resize(mutate(inside), inside, chance)
        packed = _PACK[fields[b"compression"]](inside)
        fields[b"size"] = struct.pack("<I", len(inside))
        moved = len(packed) - len(records[k][1])
        records[k] = make_head(fields), packed
        first = _fields(records[0][0])
        (index,) = struct.unpack("<Q", first[b"index_pos"])
        first[b"index_pos"] = struct.pack("<Q", index + moved)
        records[0] = make_head(first), records[0][1]
    except (LookupError, ValueError, OSError, RuntimeError, struct.error):
        return mutate(data)
    return data[:start] + join_bag(records) + rest


# MCAP

_MAGIC = b"\x89MCAP0\r\n"
_PACK2 = {b"": bytes, b"lz4": lz4.frame.compress, b"zstd": zstd.compress}
_UNPACK2 = {b"": bytes, b"lz4": lz4.frame.decompress, b"zstd": zstd.decompress}


def _split_mcap(data: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 0
    while at + 9 <= len(data):
        (size,) = struct.unpack_from("<Q", data, at + 1)
        found.append((data[at], data[at + 9 : at + 9 + size]))
        at += 9 + size
    return found


def join_mcap(records: list[tuple[int, bytes]]) -> bytes:
    return b"".join(
        bytes([kind]) + struct.pack("<Q", len(content)) + content for kind, content in records
    )


def mutate_mcap(data: bytes, mutate: Mutation, chance: random.Random) -> bytes:
    """Mutate a record of an MCAP file or of its first chunk."""
    records = _split_mcap(data[8:-8])
    chunk = next((k for k, (kind, _) in enumerate(records) if kind == 6), None)
    try:
        if chunk is None or chance.random() < 0.3:
            k = chance.randrange(len(records))
            kind, content = records[k]
            records[k] = kind, _resize(mutate(content), content, chance)
            return _MAGIC + join_mcap(records) + _MAGIC
        content = records[chunk][1]
        (n,) = struct.unpack_from("<I", content, 28)
        packing = content[32 : 32 + n]
        inside = _UNPACK2[packing](content[40 + n :])
        inner = _split_mcap(inside)
        if inner and chance.random() < 0.8:
            m = chance.randrange(len(inner))
            kind, old = inner[m]
            keep = 22 if kind == 5 and chance.random() < 0.8 else 0
            inner[m] = kind, old[:keep] + _resize(mutate(old[keep:]), old[keep:], chance)
            inside = join_mcap(inner)
        else:
            inside = _resize(mutate(inside), inside, chance)
        packed = _PACK2[packing](inside)
        new = content[:16] + struct.pack("<QI", len(inside), 0) + content[28 : 32 + n]
        records[chunk] = 6, new + struct.pack("<Q", len(packed)) + packed
        moved = len(records[chunk][1]) - len(content)
        records = [_shift_offsets(record, moved, len(inside), len(packed)) for record in records]
    except (LookupError, ValueError, OSError, RuntimeError, struct.error, zstd.ZstdError):
        return mutate(data)
    return _MAGIC + join_mcap(records) + _MAGIC


def _shift_offsets(
    record: tuple[int, bytes], by: int, unpacked: int, packed: int
) -> tuple[int, bytes]:
    """A record of the index or footer after the only chunk grew."""
    kind, content = record
    out = bytearray(content)
    if kind == 2:
        for at in (0, 8):
            (place,) = struct.unpack_from("<Q", out, at)
            if place:
                struct.pack_into("<Q", out, at, place + by)
    elif kind == 8:
        (length,) = struct.unpack_from("<Q", out, 24)
        struct.pack_into("<Q", out, 24, length + by)
        (n,) = struct.unpack_from("<I", out, 32)
        for at in range(36, 36 + n, 10):
            (place,) = struct.unpack_from("<Q", out, at + 2)
            struct.pack_into("<Q", out, at + 2, place + by)
        struct.pack_into("<QQ", out, len(out) - 16, packed, unpacked)
    return kind, bytes(out)


# SQLite

_ODD = (None, -1, 0, 2**63 - 1, -(2**63), 1e300, "text", "", b"", "/scan", "cdr")
_LOOP = "WITH RECURSIVE r(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM r) SELECT x AS"
_HOSTILE = (
    "DROP TABLE messages",
    "DROP TABLE topics",
    "DROP TABLE schema",
    "DROP TABLE message_definitions",
    "DELETE FROM topics",
    "UPDATE schema SET schema_version = 'x'",
    "ALTER TABLE messages RENAME COLUMN data TO other",
    "ALTER TABLE messages RENAME TO more; CREATE VIEW messages AS SELECT * FROM more",
    "ALTER TABLE messages RENAME TO more; "
    f"CREATE VIEW messages AS {_LOOP} id, 1 AS topic_id, 1 AS timestamp, x'00' AS data FROM r",
    f"DROP TABLE topics; CREATE VIEW topics AS {_LOOP} id, '/scan' AS name, "
    "'sensor_msgs/msg/LaserScan' AS type, 'cdr' AS serialization_format FROM r",
    "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM topics; END",
    "ALTER TABLE messages ADD COLUMN more AS (zeroblob(1000000000))",
    "CREATE VIRTUAL TABLE v USING fts5(x)",
    "INSERT INTO messages SELECT * FROM messages",
    "PRAGMA journal_mode = WAL",
)


def mutate_db3(data: bytes, mutate: Mutation, chance: random.Random) -> bytes:
    """Mutate a value or the schema of a SQLite file."""
    if chance.random() < 0.3:
        return mutate(data)
    try:
        with closing(sqlite3.connect(":memory:")) as base:
            _mutate_database(base, data, mutate, chance)
            return bytes(base.serialize())
    except (sqlite3.Error, LookupError, ValueError, OverflowError):
        return mutate(data)


def _mutate_database(
    base: sqlite3.Connection, data: bytes, mutate: Mutation, chance: random.Random
) -> None:
    base.deserialize(data)
    if chance.random() < 0.05:
        base.executescript(chance.choice(_HOSTILE))
    else:
        table = chance.choice(["messages", "messages", "messages", "topics", "schema"])
        columns = [row[1] for row in base.execute(f"PRAGMA table_info({table})")]
        rows = [row[0] for row in base.execute(f"SELECT rowid FROM {table} LIMIT 100")]
        column, row = chance.choice(columns), chance.choice(rows)
        query = f"SELECT {column} FROM {table} WHERE rowid = ?"
        (old,) = base.execute(query, (row,)).fetchone() or (None,)
        if isinstance(old, bytes) and chance.random() < 0.8:
            new = mutate(old)
        elif isinstance(old, str) and chance.random() < 0.5:
            new = mutate(old.encode()).decode("utf-8", "replace")
        else:
            new = chance.choice(_ODD)
        base.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (new, row))
    base.commit()


# E57

_PAGE, _KEPT = 1024, 1020


def _make_crc32c_table() -> list[int]:
    out = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        out.append(value)
    return out


_CRC32C = _make_crc32c_table()


def _crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC32C[(crc ^ byte) & 255]
    return crc ^ 0xFFFFFFFF


def change_e57_xml(data: bytes, change: Mutation) -> bytes:
    """An E57 file with another XML section, its last one, and valid checksums."""
    text = _e57_content(data)
    at = text.find(b"<?xml")
    end = min(at + int.from_bytes(text[32:40], "little"), len(text))
    new = change(text[at:end]).ljust(end - at, b" ")
    text = text[:at] + new + text[end:]
    return _e57_pages(text[:32] + struct.pack("<Q", len(new)) + text[40:])


def mutate_e57(data: bytes, mutate: Mutation, chance: random.Random) -> bytes:
    """Mutate a page or the XML section of an E57 file, with valid checksums."""
    text = _e57_content(data)
    if b"<?xml" in text and chance.random() < 0.6:
        return change_e57_xml(data, lambda xml: mutate(xml)[: 16 * _KEPT])
    at = chance.randrange(max(-(-len(text) // _KEPT), 1)) * _KEPT
    old = text[at : at + _KEPT]
    return _e57_pages(
        text[:at] + mutate(old)[: len(old)].ljust(len(old), b"\0") + text[at + _KEPT :]
    )


def _e57_content(data: bytes) -> bytes:
    """All pages without their checksums."""
    return b"".join(data[at : at + _KEPT] for at in range(0, len(data), _PAGE))


def _e57_pages(text: bytes) -> bytes:
    pages = [text[at : at + _KEPT].ljust(_KEPT, b"\0") for at in range(0, len(text), _KEPT)]
    if pages:
        # the header holds the physical length of the file
        pages[0] = pages[0][:16] + struct.pack("<Q", len(pages) * _PAGE) + pages[0][24:]
    return b"".join(page + struct.pack(">I", _crc32c(page)) for page in pages)


# compressed PCD


def mutate_pcd(data: bytes, mutate: Mutation, chance: random.Random) -> bytes:
    """Mutate a PCD file; compressed points are mutated uncompressed."""
    mark = b"DATA binary_compressed\n"
    at = data.find(mark)
    if at < 0 or chance.random() < 0.5:
        return mutate(data)
    at += len(mark)
    try:
        packed, unpacked = struct.unpack_from("<II", data, at)
        inside = lzf.decompress(data[at + 8 : at + 8 + packed], min(unpacked, 1 << 20))
        inside = _resize(mutate(inside), inside, chance)
        new = lzf.compress(inside, 2 * len(inside) + 64)
        return data[:at] + struct.pack("<II", len(new), len(inside)) + new
    except (ValueError, TypeError, struct.error):
        return mutate(data)
