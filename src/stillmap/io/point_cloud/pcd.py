"""PCD files: single clouds, or folders of one file per scan; read and written here.

Text, binary and compressed columns. Only the LZF decompression is a library's; the reason is in
CONTRIBUTING.md.
"""

import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_folder
from stillmap.core.input_files import InputFile
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud import clouds, table
from stillmap.io.point_cloud.clouds import (
    Cloud,
    Origin,
    describe_non_returns,
    scan_hits,
    sensor_poses,
)
from stillmap.io.point_cloud.table import Columns, Field, TableLayout
from stillmap.io.trajectory import pose_from_quaternion, quaternion_from_pose

EXTENSIONS = (".pcd",)
MARKER = "*.pcd"  # only folders with such a file are overwritten

_MAX_HEADER = 1 << 14  # bytes
_TYPES = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}
_MAX_UNPACKED = 1 << 30  # bytes
_MAX_EXPANSION = 100  # unpacked over packed bytes: LZF reaches a little less
_MIN_VIEWPOINT_DISTANCE = 5.0  # m from the origin, to detect the frame of the points


Header = tuple[TableLayout, Float | None]


def is_pcd(head: bytes) -> bool:
    """True if the first bytes of a file are a PCD header."""
    for line in head[:_MAX_HEADER].splitlines():
        words = line.split()
        if words and not words[0].startswith(b"#"):
            return words[0] in (b"VERSION", b"FIELDS")
        if words[1:2] == [b".PCD"] or words[:1] == [b"#.PCD"]:
            return True
    return False


def read_header(path: Path) -> Header:
    """The layout, ordered where points lie in rows, and VIEWPOINT (4, 4); None: it is invalid.

    Raises:
        InputError: it is missing, truncated or invalid.
    """
    with table.open_table(path) as file:
        head = file.read(_MAX_HEADER)
    if not is_pcd(head):
        raise InputError("is no PCD file", where=str(path))
    lines, start = table.split_header(path, head, lambda words: words[:1] == ["DATA"])
    entries = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    try:
        return _parse_header(path, entries, start, len(lines))
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"is damaged: its header: {error}", where=str(path)) from error


def _parse_header(path: Path, entries: dict[str, list[str]], start: int, lines: int) -> Header:
    names, kinds, sizes = entries["FIELDS"], entries["TYPE"], entries["SIZE"]
    counts = [int(word) for word in entries.get("COUNT", ["1"] * len(names))]
    dtypes = [
        np.dtype(f"<{kind.lower()}{_TYPES[kind][_TYPES[kind].index(size)]}")
        for kind, size in zip(kinds, sizes, strict=True)
    ]
    fields = tuple(Field(*column) for column in zip(names, dtypes, counts, strict=True))
    height = entries.get("HEIGHT", ["1"])[0]
    rows = int(entries["POINTS"][0]) if "POINTS" in entries else -1
    if rows < 0:
        rows = int(entries["WIDTH"][0]) * int(height)
    kind = entries["DATA"][0].lower()
    if rows < 0 or min(counts) < 1 or kind not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"{rows} points, DATA {kind[:20]}")
    is_text, is_compressed = kind == "ascii", kind == "binary_compressed"
    ordered = height != "1"
    layout = TableLayout(path, fields, rows, start, start, lines, is_text, is_compressed, ordered)
    return layout, _parse_viewpoint(entries.get("VIEWPOINT"))


def _parse_viewpoint(words: list[str] | None) -> Float | None:
    if words is None:
        return np.eye(4)
    try:
        x, y, z, *wxyz = (float(word) for word in words)
        return pose_from_quaternion(wxyz, (x, y, z))
    except (ValueError, IndexError):
        return None


def unpack_columns(layout: TableLayout) -> list[NDArray[np.uint8]]:
    """The columns of a compressed file, bytes (n, size) each.

    Raises:
        InputError: the compressed part is damaged or too large.
    """
    rows, path = layout.rows, layout.path
    size = rows * layout.record
    if size > _MAX_UNPACKED:
        what = f"is too large: more than {_MAX_UNPACKED >> 20} MiB when unpacked"
        raise InputError(what, where=str(path))
    with InputFile(path) as file:
        file.seek(layout.start)
        sizes = file.read(8).ljust(8, b"\0")
        packed_size, unpacked_size = struct.unpack("<II", sizes)
        packed = file.read(min(packed_size, file.size))
    if len(packed) < packed_size or unpacked_size < size:
        raise table.truncated_error(path)
    data = b""
    if size and unpacked_size == size <= _MAX_EXPANSION * packed_size:
        try:
            data = import_extra("lzf", path).decompress(packed, size) or b""
        except ValueError:
            data = b""
    if len(data) != size:
        raise InputError("is damaged: its compressed part", where=str(path))
    columns, at = [], 0
    for field in layout.fields:
        column = np.frombuffer(data, np.uint8, rows * field.size, at)
        columns.append(column.reshape(rows, field.size))
        at += rows * field.size
    return columns


def read_columns(layout: TableLayout, names: Sequence[str]) -> Iterator[Columns]:
    """Yield values (k,) of the named columns, block by block; see `table.read_columns`."""
    if not layout.compressed:
        yield from table.read_columns(layout, names)
        return
    fields = [layout.find_column(name)[0] for name in names]
    columns = unpack_columns(layout)
    yield [columns[layout.fields.index(field)].view(field.dtype)[:, 0] for field in fields]


def read(path: Path, context: ReadContext) -> Recording:
    """Read one PCD file or a folder of them.

    VIEWPOINT becomes `T_recorded_base`. Points are in the sensor frame; where a program wrote them
    in the map frame, they are transformed back.

    Raises:
        InputError: no scan can be read.
    """
    files, origin = clouds.files_of(path, EXTENSIONS), Origin()
    notes = Source(str(path), format="PCD")
    in_map_frame = _detect_map_frame(files)
    if in_map_frame:
        text = "points are in the map frame: transformed to the sensor frame by VIEWPOINT"
        notes.warnings.append(text)
    read_cloud = partial(_read_cloud, in_map_frame=in_map_frame, origin=origin)
    sources = clouds.sources_of(files, EXTENSIONS, read_cloud)
    recording = clouds.build_recording(sources, notes, context, single=path.is_file())
    origin.place(recording)
    if recording.T_recorded_base is None:
        origin.add_notes(recording, in_sensor_frame=True)
    return recording


def _read_cloud(path: Path, in_map_frame: bool, origin: Origin) -> Cloud:
    layout, T = read_header(path)
    T_sensor_map = np.eye(4) if T is None or not in_map_frame else se2.inverse(T)
    time = table.find_time_column(field.name for field in layout.fields)
    names = ["x", "y", "z", *([time] if time else [])]

    def to_sensor(points: NDArray[np.generic]) -> NDArray[np.generic]:
        if T is None or np.array_equal(T, np.eye(4)):
            return origin.shift(points)
        if not in_map_frame:
            return points
        return points.astype(np.float64) @ T_sensor_map[:3, :3].T + T_sensor_map[:3, 3]

    blocks = read_columns(layout, names)
    points, times = table.gather_points(blocks, to_sensor)
    return Cloud(points, T, times[0] if times else None)


def _detect_map_frame(files: list[Path]) -> bool:
    """True if points are in the map frame instead of the sensor frame.

    Decided on the scan with the farthest viewpoint: its points surround the viewpoint, or the
    origin.
    """
    farthest, at = None, _MIN_VIEWPOINT_DISTANCE
    for file in files:
        with suppress(InputError, OSError):
            _, T = read_header(file)
            if T is not None and np.linalg.norm(T[:3, 3]) > at:
                farthest, at = file, float(np.linalg.norm(T[:3, 3]))
    with suppress(InputError, OSError, MemoryError):
        if farthest is not None:
            points, T, *_ = _read_cloud(farthest, False, Origin())
            points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
            if T is not None and len(points):
                from_origin = np.median(np.linalg.norm(points, axis=1))
                from_viewpoint = np.median(np.linalg.norm(points - T[:3, 3], axis=1))
                return bool(from_viewpoint < from_origin)
    return False


def write(recording: Recording, path: Path, overwrite: bool = False) -> list[str]:
    """Write a folder of binary PCD files with the hits of each scan in the sensor frame.

    Names are stamps in nanoseconds, with `_1` and so on for repeated stamps. VIEWPOINT is the
    recorded pose of the sensor, or where a cloud without one lies; `time` is in seconds after the
    stamp. Returns what is left out, a sentence each.

    Raises:
        InputError: `path` is taken or cannot be written.
    """
    T = sensor_poses(recording, recording.T_recorded_base)
    with atomic_folder(path, MARKER, overwrite) as folder:
        repeats = 0
        for scan in recording.iter_scans(range(recording.n_scans)):
            stamp = int(recording.stamp_ns[scan])
            before = scan > 0 and stamp == recording.stamp_ns[scan - 1]
            repeats = repeats + 1 if before else 0
            name = f"{stamp:0{20 if stamp < 0 else 19}d}" + (f"_{repeats}" if repeats else "")
            pose = np.eye(4) if T is None else T[scan]
            (folder / f"{name}.pcd").write_bytes(_encode_scan(recording, scan, pose))
    return describe_non_returns(recording)


def _encode_scan(recording: Recording, scan: int, T: Float) -> bytes:
    points, times = scan_hits(recording, scan)
    rows = points if times is None else np.column_stack([points, times])
    names = ["x", "y", "z", "time"][: rows.shape[1]]
    viewpoint = " ".join(f"{value:.17g}" for value in (*T[:3, 3], *quaternion_from_pose(T)))
    n = len(names)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(names)}\nSIZE{' 4' * n}\nTYPE{' F' * n}\nCOUNT{' 1' * n}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {len(rows)}\nDATA binary\n"
    )
    return header.encode() + rows.astype("<f4").tobytes()
