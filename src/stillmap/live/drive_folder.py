"""A drive in a folder: its scans, poses and answers, of which the result can be made later.

Scans lie in temporary files already, which have no name. Here they get one, without a copy where
both are on one disk: it may be full.
"""

import os
from contextlib import suppress
from pathlib import Path
from typing import IO, Annotated, Any, TypedDict

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stillmap.core import config
from stillmap.core.array_folder import open_npy
from stillmap.core.arrays import iter_bytes, map_file, write_npy
from stillmap.core.config import Limits
from stillmap.core.errors import InputError
from stillmap.core.files import new_folder, sync
from stillmap.core.grid_map import GridMap
from stillmap.core.input_files import require_regular
from stillmap.core.json import read_json, write_json
from stillmap.core.schema import SchemaError, check
from stillmap.io.rigid_transforms import MAX_TRANSLATION
from stillmap.live.cloud_extension import KeptCloud
from stillmap.live.drive_checks import (
    check_arrays,
    check_cloud,
    check_map,
    check_scans,
    check_sensors,
)
from stillmap.live.history import KeptScans, beam_fields
from stillmap.live.map_extension import KeptMap
from stillmap.live.placement import Placement
from stillmap.live.saving import Snapshot
from stillmap.pipeline.options import Options

_FORMAT_VERSION = 1
_RECORD = "drive.json"
_BEAMS = ("points", "hit", "p_static", "time")
_SCANS = ("number", "counts", "answers", "poses", "submap")
_KNOWN = ("p_occupied", "hits")  # of a map that is extended
_KNOWN_CLOUD = ("known_points", "known_p_static", "known_route", "stands")  # in 3D likewise
_LARGEST_RECORD = 16 << 20  # bytes

_Row = list[float]
_Coordinate = Annotated[float, Limits(gt=-MAX_TRANSLATION, lt=MAX_TRANSLATION)]


class _Sensor(TypedDict):
    name: str
    T_base_sensor: list[_Row]


class _Extended(TypedDict):
    origin: tuple[_Coordinate, _Coordinate, _Coordinate]
    resolution: Annotated[float, Limits(gt=0.0, lt=1e3)]


class _Record(TypedDict):
    format_version: int
    dimension: Annotated[int, Limits(ge=2, le=3)]
    rows: list[Annotated[int, Limits(ge=0)]]  # of beams in each part
    sensors: list[_Sensor]
    has_odometry: bool
    has_times: bool
    disk_was_full: bool
    warnings: list[str]
    options: dict[str, Any]
    extended: _Extended | None


def keep_drive(snapshot: Snapshot, parent: Path) -> Path:
    """Make a folder of a drive, from which `read_drive` reads it.

    Args:
        snapshot: all scans, and what is known of them.
        parent: a new folder is made there.

    Raises:
        OSError: there is no room; nothing is left of it.
    """
    with new_folder("stillmap-drive-", parent) as folder:
        _write(snapshot, folder)
        sync(folder)
    return folder


def _write(snapshot: Snapshot, folder: Path) -> None:
    kept, arrays = snapshot.kept, _small_arrays(snapshot)
    for name, array in arrays.items():
        write_npy(folder / f"{name}.npy", array)
        sync(folder / f"{name}.npy")
    for name, parts, files in zip(_BEAMS, kept.parts, kept.files, strict=True):
        for number, (part, file) in enumerate(zip(parts, files, strict=True)):
            _put(part, file, folder / f"{name}-{number}")
    grid = None if snapshot.kept_map is None else snapshot.kept_map.grid
    record = {
        "format_version": _FORMAT_VERSION,
        "dimension": snapshot.placement.poses.shape[-1] - 1,
        "sensors": [{"name": name, "T_base_sensor": T} for name, T in kept.sensors],
        "has_odometry": kept.has_odometry,
        "has_times": kept.has_times,
        "disk_was_full": kept.disk_was_full,
        "warnings": kept.warnings,
        "options": config.to_dict(snapshot.options),
        "rows": [len(part) for part in kept.parts[0]],
        "extended": grid and {"origin": grid.origin, "resolution": float(grid.resolution)},
    }
    write_json(folder / _RECORD, record)
    sync(folder / _RECORD)


def _small_arrays(snapshot: Snapshot) -> dict[str, NDArray[Any]]:
    kept, placement = snapshot.kept, snapshot.placement
    arrays = {"number": kept.number, "counts": kept.counts, "answers": kept.answers}
    arrays |= {"poses": placement.poses, "submap": placement.submap}
    if (kept_map := snapshot.kept_map) is not None:
        planar = kept_map.grid.p_occupied, kept_map.hits
        arrays |= dict(zip(_KNOWN, map(np.asarray, planar), strict=True))
        if (cloud := kept_map.cloud) is not None:
            in_space = cloud.points, cloud.p_static, cloud.route, cloud.stands
            arrays |= dict(zip(_KNOWN_CLOUD, in_space, strict=True))
    return arrays


def _put(part: NDArray[Any], file: IO[bytes] | None, path: Path) -> None:
    """Give the open file of an array a name, or copy it."""
    if file is not None and not file.closed:
        with suppress(OSError):  # another disk, or a file that had a name once
            _link(file, path)
            os.fsync(file.fileno())
            return
    with path.open("wb") as copy:
        for block in iter_bytes(part):
            copy.write(block)
    sync(path)


def _link(file: IO[bytes], path: Path) -> None:
    here = os.open(path.parent, os.O_RDONLY)  # with it os.link follows links
    try:
        source = f"/proc/self/fd/{file.fileno()}"
        os.link(source, path.name, src_dir_fd=here, dst_dir_fd=here, follow_symlinks=True)
    finally:
        os.close(here)


def read_drive(folder: Path) -> Snapshot:
    """A drive that `keep_drive` has left.

    Raises:
        InputError: it is none, or damaged.
    """
    record = read_json(folder / _RECORD, _LARGEST_RECORD)
    try:
        check(record, _Record)
        if record["format_version"] != _FORMAT_VERSION:
            raise ValueError(f"its version {record['format_version']} is unknown here")
        return _read(folder, record)
    except (SchemaError, ValueError) as error:
        raise InputError(f"is damaged: {error}", where=str(folder / _RECORD)) from error


def remove_drive(folder: Path) -> None:
    """Remove the files that `keep_drive` has made, and the folder if it holds nothing else."""
    known = {_RECORD, *(f"{name}.npy" for name in (*_SCANS, *_KNOWN, *_KNOWN_CLOUD))}
    for path in list(folder.iterdir()):
        if path.name in known or path.name.rpartition("-")[0] in _BEAMS:
            path.unlink()
    with suppress(OSError):
        folder.rmdir()


def _read(folder: Path, record: _Record) -> Snapshot:
    D = record["dimension"]
    number, counts, answers, poses, submap = given = [
        open_npy(folder / f"{name}.npy") for name in _SCANS
    ]
    sensors = [(one["name"], np.array(one["T_base_sensor"], float)) for one in record["sensors"]]
    check_arrays(D, record["rows"], given)
    check_sensors(D, [mount for _, mount in sensors], answers["sensor"])
    parts = [
        [_map(folder / f"{name}-{k}", rows, *kind) for k, rows in enumerate(record["rows"])]
        for name, kind in zip(_BEAMS, beam_fields(D), strict=True)
    ]
    kept = KeptScans(
        number,
        counts,
        answers,
        parts,
        [[None] * len(one) for one in parts],
        sensors,
        record["has_odometry"],
        record["has_times"],
        record["warnings"],
        record["disk_was_full"],
    )
    options = config.override(Options(), record["options"], str(folder / _RECORD))
    kept_map, placement = _read_kept_map(folder, record["extended"], D), Placement(poses, submap)
    check_scans(kept, placement)
    return Snapshot(kept, placement, options, None, kept_map)


def _read_kept_map(folder: Path, about: _Extended | None, dimension: int) -> KeptMap | None:
    if about is None:
        return None
    p_occupied, hits = layers = [open_npy(folder / f"{name}.npy") for name in _KNOWN]
    check_map(layers)
    cloud = None
    if dimension == 3:
        cloud = KeptCloud(*(open_npy(folder / f"{name}.npy") for name in _KNOWN_CLOUD))
        check_cloud(cloud, p_occupied.shape)
    x, y, yaw = about["origin"]
    return KeptMap(GridMap(p_occupied, (x, y, yaw), about["resolution"]), hits, cloud)


def _map(path: Path, rows: int, kind: DTypeLike, row: tuple[int, ...]) -> NDArray[Any]:
    """Rows of a file of beams, not copied: the disk may be full."""
    shape, dtype = (rows, *row), np.dtype(kind)
    if not rows:
        return np.empty(shape, dtype)
    try:
        require_regular(path)
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size < dtype.itemsize * int(np.prod(shape)):
                raise InputError("is too short", where=str(path))
            return map_file(file, shape, dtype, writable=False)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", where=str(path)) from error
