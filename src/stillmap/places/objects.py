"""Moving objects of sessions in the frame of their place."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.array_types import Float
from stillmap.core.input_files import copy_content
from stillmap.core.json import read_json
from stillmap.io.point_cloud.ply import read_layout
from stillmap.io.point_cloud.table import read_columns
from stillmap.results import objects
from stillmap.results.reader import read_tracks
from stillmap.tracking import compute_flow_map

_OBJECTS, _LIST = "objects", "objects.json"
_MAX_BYTES = 256 << 20


def copy_objects(result: Path, state: Path) -> None:
    """Keep the objects of a session in the map frame of its result: the list, and clouds of points.

    Textured models stay with the result.
    """
    source = result / _OBJECTS
    if not (source / _LIST).is_file():
        return
    target = state / _OBJECTS
    target.mkdir()
    for path in sorted(source.iterdir()):
        if path.name == _LIST or path.suffix == ".ply":
            copy_content(path, target / path.name)


def write_objects(folder: Path, transforms: Mapping[str, Float]) -> None:
    """Write `objects/` of each session in the frame of the place, and of the place those of all,
    numbered anew, with its `traffic.npz`.

    Args:
        folder: of the place, with the objects in the state of each session.
        transforms: (D+1, D+1) of each session by its name, to the map frame of the place from that
            of the session's result.
    """
    joined = folder / _OBJECTS
    joined.mkdir()
    records = list[dict[str, Any]]()
    for name, T in transforms.items():
        home = folder / "sessions" / name
        for record in _place_objects(home, T):
            number, cloud = len(records), home / _OBJECTS / f"{record['id']:04d}.ply"
            if cloud.is_file():
                copy_content(cloud, joined / f"{number:04d}.ply")
            records.append({**record, "id": number, "session": name})
    objects.write_records(joined / _LIST, records)
    objects.write_traffic(folder / "traffic.npz", compute_flow_map(read_tracks(joined / _LIST)))


def _place_objects(home: Path, T: Float) -> list[dict[str, Any]]:
    """Write the objects of a session; returns their records.

    Raises:
        InputError: what is kept of them is damaged.
    """
    source, target = home / "state" / _OBJECTS, home / _OBJECTS
    if not source.is_dir():
        return []
    target.mkdir()
    # read_tracks checks them
    kept = read_json(source / _LIST, _MAX_BYTES) if read_tracks(source / _LIST) else []
    records = [_transform_record(record, T) for record in kept]
    objects.write_records(target / _LIST, records)
    D, names = T.shape[-1] - 1, [name for name, _ in objects.OBJECT_FIELDS]
    for path in sorted(source.glob("*.ply")):
        blocks = read_columns(read_layout(path), names)
        rows = np.hstack([np.zeros((len(names), 0)), *blocks])
        moved = T[:D, :D] @ rows[:D] + T[:D, D:]
        objects.write_ply(target / path.name, moved.T, *rows[3:])
    return records


def _transform_record(record: dict[str, Any], T: Float) -> dict[str, Any]:
    """An entry whose track lies in another frame."""
    track = record["track"]
    D = T.shape[-1] - 1
    names = "xyz"[:D]
    points = np.array([track[name] for name in names], np.float64)
    moved = T[:D, :D] @ points + T[:D, D:]
    velocity = np.zeros((D, points.shape[1]))
    velocity[:2] = [track["vx"], track["vy"]]
    turned = T[:D, :D] @ velocity
    columns = [*zip(names, moved, strict=True), ("vx", turned[0]), ("vy", turned[1])]
    changed = {name: np.round(values, objects.MILLIMETRES).tolist() for name, values in columns}
    return {**record, "track": {**track, **changed}}
