"""PLY point clouds: single files or folders; read and written here."""

from pathlib import Path

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.files import atomic_file
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud import clouds, table

EXTENSIONS = (".ply",)

_MAX_HEADER = 1 << 16  # bytes
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_NAMES = {"<f4": "float", "<f8": "double", "u1": "uchar"}  # of what is written


def is_ply(head: bytes) -> bool:
    """True if a file with these first bytes is a PLY file."""
    return head.startswith((b"ply\n", b"ply\r"))


def read(path: Path, context: ReadContext) -> Recording:
    """Read the vertices of one PLY file or of a folder of them.

    Raises:
        InputError: no cloud can be read.
    """
    notes = Source(str(path), format="PLY")
    return clouds.read_clouds(notes, EXTENSIONS, _read_cloud, context)


def _read_cloud(path: Path, origin: clouds.Origin, scratch: Path | None) -> clouds.Cloud:
    blocks = table.read_columns(read_layout(path), ("x", "y", "z"))
    points, _ = table.gather_points(blocks, origin.shift, scratch)
    return clouds.Cloud(points)


def read_layout(path: Path) -> table.TableLayout:
    """Read the header: the layout of the vertices, ordered where others may refer to them.

    Raises:
        InputError: it is no PLY file, or its vertices cannot be located.
    """
    with table.open_table(path) as file:
        head = file.read(_MAX_HEADER)
    lines, start = table.split_header(path, head, lambda words: words == ["end_header"])
    if lines[0] != ["ply"]:
        raise InputError("is no PLY file", where=str(path))
    with explaining_damage(path, KeyError, IndexError, what="is damaged: its header"):
        return _parse_header(path, lines, start)


def _parse_header(path: Path, lines: list[list[str]], header: int) -> table.TableLayout:
    encoding, order = "", ""
    elements: list[tuple[str, int, list[tuple[str, str, int]]]] = []
    with_lists: set[str] = set()
    for words in lines[1:-1]:
        if words[:1] == ["format"]:
            encoding, order = words[1], _ORDERS[words[1]]
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            if words[1] == "list":
                with_lists.add(elements[-1][0])
            else:
                elements[-1][2].append((words[2], order + _TYPES[words[1]], 1))
    text, start, before = encoding == "ascii", header, len(lines)
    for name, rows, columns in elements:
        if rows < 0:
            raise ValueError("a negative count of points")
        if name in with_lists and (name == "vertex" or not text):
            raise ValueError("its vertices have list properties, or follow such")
        if name == "vertex":
            ordered = any(n > 0 for one, n, _ in elements if one != name)
            dtype = table.record_type(columns)
            at = header, start, before
            return table.TableLayout(path, dtype, rows, *at, text, ordered=ordered)
        start += rows * sum(np.dtype(kind).itemsize for _, kind, _ in columns)
        before += rows
    raise ValueError("no vertices")


def make_header(fields: table.Fields, count: int) -> bytes:
    """Of a little-endian file whose vertices have these fields, float32, float64 or uint8."""
    properties = "".join(f"property {_NAMES[kind]} {name}\n" for name, kind in fields)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}"
    return (head + "end_header\n").encode("ascii")


def write(recording: Recording, path: Path, poses: Float) -> None:
    """Write all hits in the map frame as one binary cloud, atomically.

    Args:
        recording: T scans.
        path: the file; it is replaced.
        poses: (T, D+1, D+1) T_map_base.

    Raises:
        InputError: `path` cannot be written.
    """
    with atomic_file(path) as work, work.open("wb") as file:
        fields = [(name, "<f8") for name in "xyz"]
        file.write(make_header(fields, int(np.count_nonzero(recording.hit))))
        for points in clouds.iter_map_points(recording, poses):
            file.write(points.astype("<f8").tobytes())
