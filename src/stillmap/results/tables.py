"""Tables of a result: its beams, poses, moving objects and their tracks, as Arrow tables."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.errors import import_extra
from stillmap.core.files import atomic_file
from stillmap.core.local_frame import FAR
from stillmap.io.trajectory import pose_rows
from stillmap.results.mapped_place import MappedPlace
from stillmap.results.reader import Track
from stillmap.tracking import MovingObject
from stillmap.tracking.objects import mean_speed, track_length

if TYPE_CHECKING:
    import pyarrow

TableName = Literal["beams", "poses", "objects", "tracks"]

_ROWS = 1 << 20  # of a part of the beams, approximately


def make_table(result: MappedPlace, name: TableName) -> "pyarrow.Table":
    """See `Result.to_arrow`.

    Raises:
        MissingExtra: pyarrow is not installed.
        ValueError: there is no such table.
    """
    if name not in get_args(TableName):
        names = ", ".join(map(repr, get_args(TableName)))
        raise ValueError(f"table: expected one of {names}, got {name!r}")
    arrow = import_extra("pyarrow", "a table", "made", group="notebook")
    if name == "beams":
        parts = [_beam_schema(result.poses).empty_table(), *_iter_beams(result)]
        return arrow.concat_tables(parts)
    make = {"poses": _pose_columns, "objects": _object_columns, "tracks": _track_columns}[name]
    return arrow.table(make(result))


def _beam_schema(poses: Float) -> "pyarrow.Schema":
    """Names and types of the columns of a beam; see `_iter_beams`. `poses` (T, D+1, D+1)."""
    arrow = import_module("pyarrow")
    # 32 bits do not hold positions far from the origin to the millimetre
    is_far = np.abs(poses[:, :-1, -1]).max(initial=0.0) > FAR
    length = arrow.float64() if is_far else arrow.float32()
    kinds = {
        "scan": arrow.int32(),
        "stamp_ns": arrow.int64(),
        "beam": arrow.int32(),
        **dict.fromkeys("xyz"[: poses.shape[-1] - 1], length),
        "range": arrow.float32(),
        "hit": arrow.bool_(),
        "p_static": arrow.float32(),
    }
    return arrow.schema([arrow.field(name, kind, nullable=False) for name, kind in kinds.items()])


def _iter_beams(result: MappedPlace) -> Iterator["pyarrow.Table"]:
    """Tables of about a million beams, of whole scans, in the order of the recording.

    `scan` (from 0), `stamp_ns`, `beam` (index in the scan), `x`, `y`, in 3D `z` (end point in m in
    the map frame; 64 bits where it is far from the origin), `range` (m), `hit`, `p_static`.
    Unusable beams are NaN.
    """
    arrow, recording, deskewed = import_module("pyarrow"), result.recording, result.deskewed
    schema, first, T = _beam_schema(result.poses), 0, recording.n_scans
    while first < T:
        end = int(np.searchsorted(recording.offset, recording.offset[first] + _ROWS, "right")) - 1
        end = min(max(end, first + 1), T)
        offset = recording.offset[first : end + 1]
        beams = slice(int(offset[0]), int(offset[-1]))
        scan = np.repeat(np.arange(first, end, dtype=np.int32), np.diff(offset))
        number = np.arange(beams.start, beams.stop)
        ends = deskewed.end_points(number, result.poses)
        points = recording.points[beams].astype(np.float64)
        columns = {
            "scan": scan,
            "stamp_ns": recording.stamp_ns[scan],
            "beam": (number - recording.offset[scan]).astype(np.int32),
            **dict(zip("xyz", ends.T, strict=False)),
            "range": np.sqrt(sum(column * column for column in points.T)),
            "hit": recording.hit[beams],
            "p_static": result.p_static[beams],
        }
        kinds = {one.name: one.type.to_pandas_dtype() for one in schema}
        columns = {name: np.ascontiguousarray(c, kinds[name]) for name, c in columns.items()}
        yield arrow.table(columns, schema)
        first = end


def write_parquet(result: MappedPlace, path: Path) -> None:
    """Write a row per beam of a 2D result, a row group for about a million beams.

    Args:
        result: labels and poses.
        path: the file, written atomically.

    Raises:
        InputError: pyarrow is not installed, or the file cannot be written.
    """
    parquet = import_extra("pyarrow.parquet", path, "written")
    with (
        atomic_file(path) as work,
        work.open("wb") as file,  # not by name: it need not be UTF-8
        parquet.ParquetWriter(file, _beam_schema(result.poses), compression="zstd") as writer,
    ):
        for part in _iter_beams(result):
            writer.write_table(part, row_group_size=1 << 40)


def _pose_columns(result: MappedPlace) -> dict[str, NDArray[Any]]:
    """A row per scan: `stamp_ns`, `x`, `y` and `theta`, or in 3D `z` and a quaternion."""
    poses = result.poses
    if poses.shape[-1] == 4:
        names = ("x", "y", "z", "qx", "qy", "qz", "qw")
        columns = dict(zip(names, pose_rows(poses).T, strict=True))
    else:
        columns = dict(zip(("x", "y", "theta"), se2.parameters(poses).T, strict=True))
    return {"stamp_ns": np.asarray(result.stamp_ns), **columns}


def _object_columns(result: MappedPlace) -> dict[str, Any]:
    """A row per object: `id`, `first_stamp_ns`, `last_stamp_ns`, `length`, `width`, in 3D `height`
    (m), `distance` (m along its track), `speed` (m/s, mean), `beams`, `p_dynamic`, `p_identity`."""
    sides, rows = ("length", "width", "height")[: result.poses.shape[-1] - 1], []
    for one in result.objects:
        first, last, beams = one.stamp_ns[0], one.stamp_ns[-1], _count_beams(one)
        way = track_length(one.xy), mean_speed(one.velocity)
        size = one.size[: len(sides)]
        rows.append((one.id, first, last, *size, *way, beams, one.p_dynamic, one.p_identity))
    names = ("id", "first_stamp_ns", "last_stamp_ns", *sides, "distance", "speed", "beams")
    names += ("p_dynamic", "p_identity")
    columns = dict(zip(names, zip(*rows, strict=True) if rows else [()] * len(names), strict=True))
    kinds = dict.fromkeys(("id", "first_stamp_ns", "last_stamp_ns", "beams"), np.int64)
    return {name: np.array(c, kinds.get(name, np.float64)) for name, c in columns.items()}


def _track_columns(result: MappedPlace) -> dict[str, NDArray[Any]]:
    """A row per position of an object: `id`, `stamp_ns`, `x`, `y`, in 3D `z`, `vx`, `vy`."""
    objects = result.objects
    columns: dict[str, list[Any]] = {
        "id": [np.full(len(one.stamp_ns), one.id, np.int64) for one in objects],
        "stamp_ns": [one.stamp_ns for one in objects],
        "x": [one.xy[:, 0] for one in objects],
        "y": [one.xy[:, 1] for one in objects],
    }
    if result.poses.shape[-1] == 4:
        columns["z"] = [np.zeros(len(one.xy)) if one.z is None else one.z for one in objects]
    columns["vx"] = [one.velocity[:, 0] for one in objects]
    columns["vy"] = [one.velocity[:, 1] for one in objects]
    empty = {"id": np.int64, "stamp_ns": np.int64}
    return {
        name: np.concatenate([np.zeros(0, empty.get(name, np.float64)), *parts])
        for name, parts in columns.items()
    }


def _count_beams(one: MovingObject | Track) -> int:
    """Beams that fell on an object: a list of them where it was just tracked."""
    if isinstance(one.beams, int):
        return one.beams
    return 0 if one.beams is None else len(one.beams)
