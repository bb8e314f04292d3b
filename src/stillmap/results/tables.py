"""Tables of a result: its beams, poses, moving objects and their tracks, as Arrow tables."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import import_extra
from stillmap.core.files import atomic_file
from stillmap.core.local_frame import FAR
from stillmap.core.recording import Recording
from stillmap.io.trajectory import pose_rows
from stillmap.results.mapped_place import MappedPlace
from stillmap.results.reader import Track
from stillmap.tracking import MovingObject
from stillmap.tracking.objects import mean_speed, track_length

if TYPE_CHECKING:
    import pyarrow

Float = NDArray[np.float64]
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
        poses, p_static = result.poses, result.p_static
        schema = _beam_schema(poses)
        recording, deskewed = result.recording, result.deskewed
        parts = [
            arrow.table(_beam_columns(recording, deskewed, poses, p_static, scans), schema)
            for scans in _split_scans(recording)
        ]
        return arrow.concat_tables(parts) if parts else schema.empty_table()
    make = {"poses": _pose_columns, "objects": _object_columns, "tracks": _track_columns}[name]
    return arrow.table(make(result))


def _beam_schema(poses: Float) -> "pyarrow.Schema":
    """Names and types of the columns of a beam; see `_beam_columns`. `poses` (T, D+1, D+1)."""
    arrow = import_module("pyarrow")
    length = arrow.float64() if _are_far(poses) else arrow.float32()
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


def _are_far(poses: Float) -> bool:
    """True if 32 bits do not hold positions of poses (T, D+1, D+1) to the millimetre."""
    return bool(np.abs(poses[:, :-1, -1]).max(initial=0.0) > FAR)


def _beam_columns(
    recording: Recording,
    deskewed: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
    scans: slice,
) -> dict[str, NDArray[Any]]:
    """Columns of the beams of a slice of scans, in the order of the recording.

    `scan` (from 0), `stamp_ns`, `beam` (index in the scan), `x`, `y`, in 3D `z` (end point in m in
    the map frame; 64 bits where it is far from the origin), `range` (m), `hit`, `p_static`.
    Unusable beams are NaN.
    """
    offset = recording.offset[scans.start : scans.stop + 1]
    beams = slice(int(offset[0]), int(offset[-1]))
    scan = np.repeat(np.arange(scans.start, scans.stop, dtype=np.int32), np.diff(offset))
    number = np.arange(beams.start, beams.stop)
    ends = deskewed.end_points(number, poses)
    if not _are_far(poses):
        ends = ends.astype(np.float32)
    points = recording.points[beams].astype(np.float64)
    return {
        "scan": scan,
        "stamp_ns": recording.stamp_ns[scan],
        "beam": (number - recording.offset[scan]).astype(np.int32),
        **{axis: np.ascontiguousarray(ends[:, k]) for k, axis in enumerate("xyz"[: ends.shape[1]])},
        "range": np.sqrt(sum(column * column for column in points.T)).astype(np.float32),
        "hit": np.asarray(recording.hit[beams]),
        "p_static": np.asarray(p_static[beams]),
    }


def _split_scans(recording: Recording) -> Iterator[slice]:
    """Ranges of scans of about a million beams together, at least one scan each."""
    first, T = 0, recording.n_scans
    while first < T:
        end = int(np.searchsorted(recording.offset, recording.offset[first] + _ROWS, "right")) - 1
        end = min(max(end, first + 1), T)
        yield slice(first, end)
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
    arrow, recording, deskewed = import_module("pyarrow"), result.recording, result.deskewed
    schema = _beam_schema(result.poses)
    with (
        atomic_file(path) as work,
        work.open("wb") as file,  # not by name: it need not be UTF-8
        parquet.ParquetWriter(file, schema, compression="zstd") as writer,
    ):
        for scans in _split_scans(recording):
            columns = _beam_columns(recording, deskewed, result.poses, result.p_static, scans)
            writer.write_table(arrow.table(columns, schema=schema), row_group_size=1 << 40)


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
    objects = result.objects
    sides = ("length", "width", "height")[: result.poses.shape[-1] - 1]
    return {
        "id": np.array([one.id for one in objects], np.int64),
        "first_stamp_ns": np.array([one.stamp_ns[0] for one in objects], np.int64),
        "last_stamp_ns": np.array([one.stamp_ns[-1] for one in objects], np.int64),
        **{
            side: np.array([one.size[k] for one in objects], np.float64)
            for k, side in enumerate(sides)
        },
        "distance": np.array([track_length(one.xy) for one in objects], np.float64),
        "speed": np.array([mean_speed(one.velocity) for one in objects], np.float64),
        "beams": np.array([_count_beams(one) for one in objects], np.int64),
        "p_dynamic": np.array([one.p_dynamic for one in objects], np.float64),
        "p_identity": np.array([one.p_identity for one in objects], np.float64),
    }


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
