"""One PCD file: header, and columns of points from text, records or compressed columns.

Written here because no library at hand reads files that lie about their size safely; only the
compression is a library's.
"""

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.extras import extra
from stillmap.recording.clouds.files import require_content
from stillmap.recording.clouds.records import Field, Layout, columns, cut_short, require_record
from stillmap.recording.clouds.rigid import from_quaternion

_HEADER = 1 << 14  # bytes in which it must end
_TYPES = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_LARGEST_UNPACKED = 1 << 30  # bytes
_EXPANSION = 100  # what LZF can make of a byte at most, and a little more


class PcdHeader(NamedTuple):
    """What a file says of itself: `T` is its VIEWPOINT (4, 4), None where that is no pose."""

    layout: Layout
    T: NDArray[np.float64] | None
    compressed: bool


def is_pcd(head: bytes) -> bool:
    """Whether a file with these first bytes is one."""
    for line in head[:_HEADER].splitlines():
        words = line.split()
        if words and words[0] != b"#" and not words[0].startswith(b"#"):
            return words[0] in (b"VERSION", b"FIELDS")
        if words[1:2] == [b".PCD"] or words[:1] == [b"#.PCD"]:
            return True
    return False


def header(path: Path) -> PcdHeader:
    """Read the header.

    Raises:
        InputError: there is none, or it cannot be meant.
    """
    require_content(path)
    with path.open("rb") as file:
        head = file.read(_HEADER)
    if not is_pcd(head):
        raise InputError("is no PCD file", where=str(path))
    entries: dict[str, list[str]] = {}
    at = lines = 0
    while "DATA" not in entries:
        end = head.find(b"\n", at)
        if end < 0:
            raise InputError("is cut short: its header has no end", where=str(path))
        words = head[at:end].decode("ascii", "replace").split()
        at, lines = end + 1, lines + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    try:
        return _understood(path, entries, at, lines)
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"is damaged: its header: {error}", where=str(path)) from error


def _understood(path: Path, entries: dict[str, list[str]], start: int, lines: int) -> PcdHeader:
    names, types = entries["FIELDS"], entries["TYPE"]
    sizes = [int(word) for word in entries["SIZE"]]
    counts = [int(word) for word in entries.get("COUNT", ["1"] * len(names))]
    fields = tuple(_field(*one) for one in zip(names, types, sizes, counts, strict=True))
    rows = int(entries["POINTS"][0]) if "POINTS" in entries else -1
    if rows < 0:
        rows = int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])
    if rows < 0:
        raise ValueError("a number of points below zero")
    kind = entries["DATA"][0].lower()
    if kind not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {kind[:20]}")
    layout = Layout(path, fields, rows, start, lines, kind == "ascii")
    return PcdHeader(layout, _viewpoint(entries.get("VIEWPOINT")), kind == "binary_compressed")


def _viewpoint(words: list[str] | None) -> NDArray[np.float64] | None:
    if words is None:
        return np.eye(4)
    try:
        x, y, z, *wxyz = (float(word) for word in words)
        return from_quaternion(wxyz, (x, y, z))
    except (ValueError, IndexError):
        return None


def _field(name: str, kind: str, size: int, count: int) -> Field:
    if size not in _SIZES[kind] or count < 1:
        raise ValueError(f"a column of type {kind}, size {size}, count {count}")
    return Field(name, np.dtype(f"<{_TYPES[kind]}{size}"), count)


def values(head: PcdHeader, wanted: list[str]) -> list[NDArray[Any]]:
    """(n,) of each of the wanted columns.

    Raises:
        InputError: see `columns`; or the compressed part is damaged or too large.
    """
    if head.compressed:
        return _unpacked(head.layout, wanted)
    blocks = list(columns(head.layout, wanted))
    if not blocks:
        return [np.empty(0) for _ in wanted]
    return [np.concatenate(parts) for parts in zip(*blocks, strict=True)]


def _unpacked(layout: Layout, wanted: list[str]) -> list[NDArray[Any]]:
    """Columns that lie one after the other in one compressed piece."""
    require_record(layout)
    places = [layout.place(name) for name in wanted]
    size = layout.rows * layout.record
    path = layout.path
    if size == 0:
        return [np.empty(0, field.dtype) for field, _, _ in places]
    if size > _LARGEST_UNPACKED:
        what = f"is too large: more than {_LARGEST_UNPACKED >> 20} MiB when unpacked"
        raise InputError(what, where=str(path))
    with path.open("rb") as file:
        file.seek(layout.start)
        sizes = file.read(8)
        packed_size, unpacked_size = struct.unpack("<II", sizes) if len(sizes) == 8 else (0, 0)
        packed = file.read(min(packed_size, path.stat().st_size))
    if len(packed) < packed_size or len(sizes) < 8:
        raise InputError("is cut short: its compressed part has no end", where=str(path))
    if unpacked_size < size:
        raise cut_short(path, unpacked_size // layout.record, layout.rows)
    if unpacked_size != size or size > _EXPANSION * packed_size:
        what = f"is damaged: {packed_size} bytes cannot be {unpacked_size} when unpacked"
        raise InputError(what, where=str(path))
    try:
        data = extra("lzf", path).decompress(packed, size)
    except ValueError:
        data = None
    if data is None or len(data) != size:
        raise InputError("is damaged: its compressed part", where=str(path))
    out = []
    for field, byte, _ in places:
        column = np.frombuffer(data, field.dtype, layout.rows * field.count, byte * layout.rows)
        out.append(column.reshape(layout.rows, field.count)[:, 0])
    return out
