"""Folders of PCD files, one scan each, and single PCD files.

One PCD file: header, and columns of points from text, records or compressed columns.

Written here because no library at hand reads files that lie about their size safely; only the
compression is a library's.
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
from stillmap.core.recording import Recording
from stillmap.io.point_cloud.binary_table import (
    Field,
    TableLayout,
    check_record_size,
    read_columns,
    truncated_error,
)
from stillmap.io.point_cloud.files import (
    list_files,
    pose_from_quaternion,
    quaternion_from_pose,
    require_nonempty_file,
    require_single_sensor,
    scan_hits,
    sensor_poses,
    stamps_from_names,
    strip_extension,
)
from stillmap.io.point_cloud.scans import Cloud, CloudSource, DatasetInfo, Origin, build_recording
from stillmap.io.point_cloud.time_field import find_time_column
from stillmap.io.text_lines import Progress
from stillmap.preprocessing.options import ReadOptions

_HEADER = 1 << 14  # bytes in which it must end

_TYPES = {"F": "f", "I": "i", "U": "u"}

_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}

_LARGEST_UNPACKED = 1 << 30  # bytes

_EXPANSION = 100  # what LZF can make of a byte at most, and a little more


class PcdHeader(NamedTuple):
    """What a file says of itself: `T` is its VIEWPOINT (4, 4), None where that is no pose."""

    layout: TableLayout
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


def read_header(path: Path) -> PcdHeader:
    """Read the header.

    Raises:
        InputError: there is none, or it cannot be meant.
    """
    require_nonempty_file(path)
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
    layout = TableLayout(path, fields, rows, start, lines, kind == "ascii")
    return PcdHeader(layout, _viewpoint(entries.get("VIEWPOINT")), kind == "binary_compressed")


def _viewpoint(words: list[str] | None) -> NDArray[np.float64] | None:
    if words is None:
        return np.eye(4)
    try:
        x, y, z, *wxyz = (float(word) for word in words)
        return pose_from_quaternion(wxyz, (x, y, z))
    except (ValueError, IndexError):
        return None


def _field(name: str, kind: str, size: int, count: int) -> Field:
    if size not in _SIZES[kind] or count < 1:
        raise ValueError(f"a column of type {kind}, size {size}, count {count}")
    return Field(name, np.dtype(f"<{_TYPES[kind]}{size}"), count)


def read_values(head: PcdHeader, wanted: list[str]) -> list[NDArray[Any]]:
    """(n,) of each of the wanted columns.

    Raises:
        InputError: see `columns`; or the compressed part is damaged or too large.
    """
    if head.compressed:
        return _unpacked(head.layout, wanted)
    blocks = list(read_columns(head.layout, wanted))
    if not blocks:
        return [np.empty(0) for _ in wanted]
    return [np.concatenate(parts) for parts in zip(*blocks, strict=True)]


def _unpacked(layout: TableLayout, wanted: list[str]) -> list[NDArray[Any]]:
    """Columns that lie one after the other in one compressed piece."""
    check_record_size(layout)
    places = [layout.find_column(name) for name in wanted]
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
        raise truncated_error(path, unpacked_size // layout.record, layout.rows)
    if unpacked_size != size or size > _EXPANSION * packed_size:
        what = f"is damaged: {packed_size} bytes cannot be {unpacked_size} when unpacked"
        raise InputError(what, where=str(path))
    try:
        data = import_extra("lzf", path).decompress(packed, size)
    except ValueError:
        data = None
    if data is None or len(data) != size:
        raise InputError("is damaged: its compressed part", where=str(path))
    out = []
    for field, byte, _ in places:
        column = np.frombuffer(data, field.dtype, layout.rows * field.count, byte * layout.rows)
        out.append(column.reshape(layout.rows, field.count)[:, 0])
    return out


EXTENSIONS = (".pcd",)

MARK = "*.pcd"  # every such folder has one

_FAR_ENOUGH = 5.0  # m from the origin: a viewpoint there tells in whose frame points are


def read(
    path: Path,
    options: ReadOptions,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Recording:
    """Read one PCD file or a folder of them.

    VIEWPOINT is where the scan was taken from: `T_recorded_base`. Points are the sensor's; where
    they lie around the viewpoints instead, they are taken back from there.

    Raises:
        InputError: no scan can be read.
    """
    files = [path] if path.is_file() else list_files(path, EXTENSIONS)
    stamps = stamps_from_names([strip_extension(file.name, EXTENSIONS) for file in files])
    known = DatasetInfo(path, "PCD", [], single=path.is_file())
    in_world = _lie_around_viewpoints(files)
    if in_world:
        known.warnings.append("points lie around their VIEWPOINT: taken back to the sensor's frame")
    origin = Origin()
    sources = [
        CloudSource(
            file.name, partial(_cloud, file, in_world, origin), stamps[i] if stamps else None
        )
        for i, file in enumerate(files)
    ]
    recording = build_recording(sources, known, options, progress, scratch)
    if notes := origin.notes():
        recording.source.update(notes)
        recording.source["warnings"] += origin.warnings()
    return recording


def _cloud(path: Path, in_world: bool, origin: Origin) -> Cloud:
    head = read_header(path)
    time = find_time_column(field.name for field in head.layout.fields)
    found = read_values(head, ["x", "y", "z", *([time] if time else [])])
    points = np.stack(found[:3], axis=1)
    if head.T is None or np.array_equal(head.T, np.eye(4)):
        points = origin.shift(points)
    elif in_world:
        T = se2.inverse(head.T)
        points = points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    return Cloud(points, head.T, found[3] if time else None)


def _lie_around_viewpoints(files: list[Path]) -> bool:
    """Whether points are in the frame of the viewpoints, as some programs write them.

    The scan whose viewpoint is farthest from the origin tells: a scan lies around its sensor.
    """
    farthest, at = None, _FAR_ENOUGH
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
        cloud = _cloud(farthest, False, Origin())
    except (InputError, OSError, MemoryError):
        return False
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(np.float64)
    if not len(points) or cloud.T is None:
        return False
    from_origin = np.median(np.linalg.norm(points, axis=1))
    from_viewpoint = np.median(np.linalg.norm(points - cloud.T[:3, 3], axis=1))
    return bool(from_viewpoint < from_origin)


def write(recording: Recording, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a folder of binary PCD files: the hits of each scan in the sensor's frame.

    Names are stamps in nanoseconds, with `_1` and so on where one repeats. VIEWPOINT is the
    recorded pose of the sensor; `time` is when a beam was taken, in seconds after the stamp.

    Raises:
        InputError: `path` is taken or cannot be written to, or there are several sensors.
    """
    require_single_sensor(recording, str(path))
    T = sensor_poses(recording, recording.T_recorded_base)
    with atomic_folder(Path(path), MARK, overwrite) as folder:
        repeats = 0
        for scan in recording.iter_scans(range(recording.n_scans)):
            stamp = int(recording.stamp_ns[scan])
            before = scan > 0 and stamp == recording.stamp_ns[scan - 1]
            repeats = repeats + 1 if before else 0
            name = f"{stamp:0{20 if stamp < 0 else 19}d}" + (f"_{repeats}" if repeats else "")
            pose = np.eye(4) if T is None else T[scan]
            (folder / f"{name}.pcd").write_bytes(_file(recording, scan, pose))


def _file(recording: Recording, scan: int, T: NDArray[np.float64]) -> bytes:
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
