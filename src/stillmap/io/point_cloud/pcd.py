"""PCD files: single clouds, or folders of one file per scan; read and written here.

Text, binary and compressed columns. Only the LZF decompression is a library's; the reason is in
CONTRIBUTING.md.
"""

import struct
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError, import_extra
from stillmap.core.files import atomic_folder
from stillmap.core.input_files import InputFile
from stillmap.core.recording import Recording
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud.binary_table import (
    Field,
    TableLayout,
    check_record_size,
    read_columns,
    split_header,
    truncated_error,
)
from stillmap.io.point_cloud.hits import require_single_sensor, scan_hits, sensor_poses
from stillmap.io.point_cloud.origin import Origin, place_clouds
from stillmap.io.point_cloud.scans import Cloud, DatasetInfo, build_recording, files_of, sources_of
from stillmap.io.point_cloud.signatures import MAX_PCD_HEADER, PCD_EXTENSIONS, is_pcd
from stillmap.io.point_cloud.time_field import find_time_column
from stillmap.io.rigid_transforms import pose_from_quaternion, quaternion_from_pose
from stillmap.io.scan_files import require_nonempty_file

_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}

_MAX_UNPACKED = 1 << 30  # bytes

_MAX_EXPANSION = 100  # unpacked over packed bytes: LZF reaches a little less


class PcdHeader(NamedTuple):
    """Layout, VIEWPOINT `T` (4, 4; None: invalid), whether columns are compressed, and whether
    points are organised in rows (HEIGHT above 1)."""

    layout: TableLayout
    T: NDArray[np.float64] | None
    compressed: bool
    organised: bool


def read_header(path: Path) -> PcdHeader:
    """Read the header.

    Raises:
        InputError: it is missing, truncated or invalid.
    """
    require_nonempty_file(path)
    with InputFile(path) as file:
        head = file.read(MAX_PCD_HEADER)
    if not is_pcd(head):
        raise InputError("is no PCD file", where=str(path))
    lines, start = split_header(path, head, lambda words: words[:1] == ["DATA"])
    entries = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    try:
        return _parse_header(path, entries, start, len(lines))
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"is damaged: its header: {error}", where=str(path)) from error


def _parse_header(path: Path, entries: dict[str, list[str]], start: int, lines: int) -> PcdHeader:
    names, types = entries["FIELDS"], entries["TYPE"]
    sizes = [int(word) for word in entries["SIZE"]]
    counts = [int(word) for word in entries.get("COUNT", ["1"] * len(names))]
    fields = tuple(_make_field(*one) for one in zip(names, types, sizes, counts, strict=True))
    rows = int(entries["POINTS"][0]) if "POINTS" in entries else -1
    if rows < 0:
        rows = int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])
    if rows < 0:
        raise ValueError("a negative count of points")
    kind = entries["DATA"][0].lower()
    if kind not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {kind[:20]}")
    layout = TableLayout(path, fields, start, rows, start, lines, kind == "ascii")
    T = _parse_viewpoint(entries.get("VIEWPOINT"))
    organised = entries.get("HEIGHT", ["1"])[:1] != ["1"]
    return PcdHeader(layout, T, kind == "binary_compressed", organised)


def _parse_viewpoint(words: list[str] | None) -> NDArray[np.float64] | None:
    if words is None:
        return np.eye(4)
    try:
        x, y, z, *wxyz = (float(word) for word in words)
        return pose_from_quaternion(wxyz, (x, y, z))
    except (ValueError, IndexError):
        return None


def _make_field(name: str, kind: str, size: int, count: int) -> Field:
    if size not in _SIZES[kind] or count < 1:
        raise ValueError(f"a column of type {kind}, size {size}, count {count}")
    return Field(name, np.dtype(f"<{kind.lower()}{size}"), count)


def read_values(head: PcdHeader, wanted: list[str]) -> list[NDArray[Any]]:
    """Read values (n,) of the wanted columns.

    Raises:
        InputError: see `read_columns`; or the compressed part is damaged or too large.
    """
    if head.compressed:
        return _read_compressed(head.layout, wanted)
    blocks = list(read_columns(head.layout, wanted))
    if not blocks:
        return [np.empty(0) for _ in wanted]
    return [np.concatenate(parts) for parts in zip(*blocks, strict=True)]


def _read_compressed(layout: TableLayout, wanted: list[str]) -> list[NDArray[Any]]:
    """Read columns that are stored one after the other in one LZF block."""
    columns = [layout.find_column(name) for name in wanted]
    data = unpack_columns(layout)
    out = []
    for field, byte, _ in columns:
        column = np.frombuffer(data, field.dtype, layout.rows * field.count, byte * layout.rows)
        out.append(column.reshape(layout.rows, field.count)[:, 0])
    return out


def unpack_columns(layout: TableLayout) -> bytes:
    """The columns of a compressed file, one after the other.

    Raises:
        InputError: the compressed part is damaged or too large.
    """
    check_record_size(layout)
    size, path = layout.rows * layout.record, layout.path
    if size == 0:
        return b""
    if size > _MAX_UNPACKED:
        what = f"is too large: more than {_MAX_UNPACKED >> 20} MiB when unpacked"
        raise InputError(what, where=str(path))
    with InputFile(path) as file:
        file.seek(layout.start)
        sizes = file.read(8)
        packed_size, unpacked_size = struct.unpack("<II", sizes) if len(sizes) == 8 else (0, 0)
        packed = file.read(min(packed_size, path.stat().st_size))
    if len(packed) < packed_size or len(sizes) < 8:
        raise InputError("is truncated: its compressed part does not end", where=str(path))
    if unpacked_size < size:
        raise truncated_error(path, unpacked_size // layout.record, layout.rows)
    if unpacked_size != size or size > _MAX_EXPANSION * packed_size:
        what = f"is damaged: {packed_size} bytes cannot unpack to {unpacked_size}"
        raise InputError(what, where=str(path))
    try:
        data = import_extra("lzf", path).decompress(packed, size)
    except ValueError:
        data = None
    if data is None or len(data) != size:
        raise InputError("is damaged: its compressed part", where=str(path))
    return bytes(data)


MARKER = "*.pcd"  # only folders with such a file are overwritten

_MIN_VIEWPOINT_DISTANCE = 5.0  # m from the origin, to detect the frame of the points


def read(path: Path, context: ReadContext) -> Recording:
    """Read one PCD file or a folder of them.

    VIEWPOINT becomes `T_recorded_base`. Points are in the sensor frame; where a program wrote them
    in the map frame, they are transformed back.

    Raises:
        InputError: no scan can be read.
    """
    files, origin = files_of(path, PCD_EXTENSIONS), Origin()
    info = DatasetInfo(path, "PCD", [], single=path.is_file())
    in_map_frame = _detect_map_frame(files)
    if in_map_frame:
        text = "points are in the map frame: transformed to the sensor frame by VIEWPOINT"
        info.warnings.append(text)
    read_cloud = partial(_read_cloud, in_map_frame=in_map_frame, origin=origin)
    recording = build_recording(sources_of(files, PCD_EXTENSIONS, read_cloud), info, context)
    origin.place(recording)
    if recording.T_recorded_base is None:
        origin.add_notes(recording, in_sensor_frame=True)
    return recording


def _read_cloud(path: Path, in_map_frame: bool, origin: Origin) -> Cloud:
    head = read_header(path)
    time = find_time_column(field.name for field in head.layout.fields)
    found = read_values(head, ["x", "y", "z", *([time] if time else [])])
    points = np.stack(found[:3], axis=1)
    if head.T is None or np.array_equal(head.T, np.eye(4)):
        points = origin.shift(points)
    elif in_map_frame:
        T = se2.inverse(head.T)
        points = points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    return Cloud(points, head.T, found[3] if time else None)


def _detect_map_frame(files: list[Path]) -> bool:
    """True if points are in the map frame instead of the sensor frame.

    Decided on the scan with the farthest viewpoint: its points surround the viewpoint, or the
    origin.
    """
    farthest, at = None, _MIN_VIEWPOINT_DISTANCE
    for file in files:
        try:
            T = read_header(file).T
        except (InputError, OSError):
            continue
        distance = 0.0 if T is None else float(np.linalg.norm(T[:3, 3]))
        if distance > at:
            farthest, at = file, distance
    if farthest is None:
        return False
    try:
        cloud = _read_cloud(farthest, False, Origin())
    except (InputError, OSError, MemoryError):
        return False
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
    if not len(points) or cloud.T is None:
        return False
    from_origin = np.median(np.linalg.norm(points, axis=1))
    from_viewpoint = np.median(np.linalg.norm(points - cloud.T[:3, 3], axis=1))
    return bool(from_viewpoint < from_origin)


def write(recording: Recording, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a folder of binary PCD files with the hits of each scan in the sensor frame.

    Names are stamps in nanoseconds, with `_1` and so on for repeated stamps. VIEWPOINT is the
    recorded pose of the sensor, or where a cloud without one lies; `time` is in seconds after the
    stamp.

    Raises:
        InputError: `path` is taken or cannot be written, or there are several sensors.
    """
    require_single_sensor(recording, str(path))
    T = sensor_poses(recording, place_clouds(recording, recording.T_recorded_base))
    with atomic_folder(Path(path), MARKER, overwrite) as folder:
        repeats = 0
        for scan in recording.iter_scans(range(recording.n_scans)):
            stamp = int(recording.stamp_ns[scan])
            before = scan > 0 and stamp == recording.stamp_ns[scan - 1]
            repeats = repeats + 1 if before else 0
            name = f"{stamp:0{20 if stamp < 0 else 19}d}" + (f"_{repeats}" if repeats else "")
            pose = np.eye(4) if T is None else T[scan]
            (folder / f"{name}.pcd").write_bytes(_encode_scan(recording, scan, pose))


def _encode_scan(recording: Recording, scan: int, T: NDArray[np.float64]) -> bytes:
    points, times = scan_hits(recording, scan)
    rows = points if times is None else np.column_stack([points, times])
    names = ["x", "y", "z", "time"][: rows.shape[1]]
    viewpoint = " ".join(f"{value:.17g}" for value in (*T[:3, 3], *quaternion_from_pose(T)))
    header = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join('4' for _ in names)}",
        f"TYPE {' '.join('F' for _ in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        f"VIEWPOINT {viewpoint}",
        f"POINTS {len(rows)}",
        "DATA binary",
    )
    return "".join(f"{line}\n" for line in header).encode() + rows.astype("<f4").tobytes()
