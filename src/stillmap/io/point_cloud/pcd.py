"""PCD files: single clouds, or folders of one file per scan; read and written here.

Text, binary and compressed columns.
"""

from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.files import atomic_folder
from stillmap.core.recording import Recording
from stillmap.core.source import Source
from stillmap.io.builder import ReadContext
from stillmap.io.point_cloud import clouds, table
from stillmap.io.trajectory import pose_from_quaternion, quaternion_from_pose

EXTENSIONS = (".pcd",)
MARKER = "*.pcd"  # only folders with such a file are overwritten

_MAX_HEADER = 1 << 14  # bytes
_TYPES = {  # by TYPE and SIZE
    **{("F", size): f"<f{size}" for size in ("4", "8")},
    **{(kind, size): f"<{kind.lower()}{size}" for kind in "IU" for size in ("1", "2", "4", "8")},
}
_MIN_VIEWPOINT_DISTANCE = 5.0  # m from the origin, to detect the frame of the points


Header = tuple[table.TableLayout, Float | None]


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
    with explaining_damage(path, KeyError, IndexError, what="is damaged: its header"):
        return _parse_header(path, entries, start, len(lines))


def _parse_header(path: Path, entries: dict[str, list[str]], start: int, lines: int) -> Header:
    names, kinds, sizes = entries["FIELDS"], entries["TYPE"], entries["SIZE"]
    counts = [int(word) for word in entries.get("COUNT", ["1"] * len(names))]
    types = [_TYPES[kind, size] for kind, size in zip(kinds, sizes, strict=True)]
    dtype = table.record_type(list(zip(names, types, counts, strict=True)))
    height = entries.get("HEIGHT", ["1"])[0]
    rows = int(entries["POINTS"][0]) if "POINTS" in entries else -1
    if rows < 0:
        rows = int(entries["WIDTH"][0]) * int(height)
    kind = entries["DATA"][0].lower()
    if rows < 0 or min(counts) < 1 or kind not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"{rows} points, DATA {kind[:20]}")
    is_text, is_compressed = kind == "ascii", kind == "binary_compressed"
    ordered = height != "1"
    layout = table.TableLayout(
        path, dtype, rows, start, start, lines, is_text, is_compressed, ordered
    )
    return layout, _parse_viewpoint(entries.get("VIEWPOINT"))


def _parse_viewpoint(words: list[str] | None) -> Float | None:
    if words is None:
        return np.eye(4)
    try:
        x, y, z, *wxyz = (float(word) for word in words)
        return pose_from_quaternion(wxyz, (x, y, z))
    except (ValueError, IndexError):
        return None


def read(path: Path, context: ReadContext) -> Recording:
    """Read one PCD file or a folder of them.

    VIEWPOINT becomes `T_recorded_base`. Points are in the sensor frame; where a program wrote them
    in the map frame, they are transformed back.

    Raises:
        InputError: no scan can be read.
    """
    notes = Source(str(path), format="PCD")
    in_map_frame = _detect_map_frame(clouds.files_of(path, EXTENSIONS))
    if in_map_frame:
        text = "points are in the map frame: transformed to the sensor frame by VIEWPOINT"
        notes.warnings.append(text)
    read_cloud = partial(_read_cloud, in_map_frame=in_map_frame)
    return clouds.read_clouds(notes, EXTENSIONS, read_cloud, context, in_sensor_frame=True)


def _read_cloud(
    path: Path, origin: clouds.Origin, scratch: Path | None = None, *, in_map_frame: bool = False
) -> clouds.Cloud:
    layout, T = read_header(path)
    T_sensor_map = np.eye(4) if T is None or not in_map_frame else se2.inverse(T)
    time = table.find_time_column(layout.dtype.names or ())
    names = ["x", "y", "z", *([time] if time else [])]

    def to_sensor(points: NDArray[np.generic]) -> NDArray[np.generic]:
        if T is None or np.array_equal(T, np.eye(4)):
            return origin.shift(points)
        if not in_map_frame:
            return points
        return points.astype(np.float64) @ T_sensor_map[:3, :3].T + T_sensor_map[:3, 3]

    points, times = table.gather_points(table.read_columns(layout, names), to_sensor, scratch)
    return clouds.Cloud(points, T, times[0] if times else None)


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
            points, T, *_ = _read_cloud(farthest, clouds.Origin())
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
    T = clouds.sensor_poses(recording, recording.T_recorded_base)
    with atomic_folder(path, MARKER, overwrite) as folder:
        repeats = 0
        for scan in recording.iter_scans(range(recording.n_scans)):
            stamp = int(recording.stamp_ns[scan])
            before = scan > 0 and stamp == recording.stamp_ns[scan - 1]
            repeats = repeats + 1 if before else 0
            name = f"{stamp:0{20 if stamp < 0 else 19}d}" + (f"_{repeats}" if repeats else "")
            pose = np.eye(4) if T is None else T[scan]
            (folder / f"{name}.pcd").write_bytes(_encode_scan(recording, scan, pose))
    return clouds.describe_non_returns(recording)


def _encode_scan(recording: Recording, scan: int, T: Float) -> bytes:
    points, times = clouds.scan_hits(recording, scan)
    rows = points if times is None else np.column_stack([points, times])
    fields = [(name, "<f4") for name in ("x", "y", "z", "time")[: rows.shape[1]]]
    return make_header(fields, len(rows), T) + rows.astype("<f4").tobytes()


def make_header(fields: table.Fields, count: int, viewpoint: Float) -> bytes:
    """Of binary points with these fields, all of them of TYPE F: packed colours are, too, by
    convention of PCL; `viewpoint` (4, 4)."""
    n, pose = len(fields), (*viewpoint[:3, 3], *quaternion_from_pose(viewpoint))
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(name for name, _ in fields)}\n"
        f"SIZE {' '.join(kind[-1] for _, kind in fields)}\nTYPE{' F' * n}\nCOUNT{' 1' * n}\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT {' '.join(f'{value:.17g}' for value in pose)}\n"
        f"POINTS {count}\nDATA binary\n"
    )
    return header.encode()
