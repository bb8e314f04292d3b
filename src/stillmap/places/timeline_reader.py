"""A place over its sessions read from its folder: `sessions.json`, `changes.json`, `states.npz`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_folder import read_npz
from stillmap.core.errors import InputError
from stillmap.core.json import read_json
from stillmap.places.inputs import SESSIONS
from stillmap.places.place_change import Kind
from stillmap.places.reader import read_sessions
from stillmap.places.timeline import (
    ChangedCells,
    ChangeRecord,
    RefusedRecord,
    SessionRecord,
    Timeline,
)
from stillmap.places.writer import CHANGES, STATES

Float = NDArray[np.float64]

_MAX_ARRAY = 1 << 31  # bytes of an array when it is unpacked
_MAX_JSON = 64 << 20  # bytes
_MAX_STAMP = 2**63  # ns
_MAX_CELL = 2**30  # of either axis
_HINT = "merge the sessions anew"


def read_timeline(folder: Path, map_state: str = "last") -> Timeline:
    """The sessions of a place and what changed between them.

    Args:
        folder: which `stillmap merge` wrote.
        map_state: which state its map shows, as `run.json` says it.

    Raises:
        InputError: a file is missing, damaged, or was changed by hand.
    """
    records = read_sessions(folder)
    try:
        accepted = {one["name"]: _session_of(one) for one in records if one["accepted"]}
        refused = [
            RefusedRecord(one["name"], _source_of(one), str(one.get("why", "")))
            for one in records
            if not one["accepted"]
        ]
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(_damage(error), where=str(folder / SESSIONS), hint=_HINT) from error
    cells, names = read_states(folder)
    if sorted(names) != sorted(accepted):
        what = f"is of other sessions than those in {SESSIONS}"
        raise InputError(what, where=str(folder / STATES), hint=_HINT)
    sessions = [accepted[name] for name in names]
    return Timeline(sessions, refused, read_changes(folder, names), cells, map_state)


def read_changes(folder: Path, names: Sequence[str]) -> list[ChangeRecord]:
    """The entries of `changes.json`.

    Args:
        folder: of the place.
        names: of its sessions in the order of time.

    Raises:
        InputError: the file is missing or damaged.
    """
    path = folder / CHANGES
    records = read_json(path, _MAX_JSON, _HINT)
    try:
        if not isinstance(records, list):
            raise ValueError("is no list")
        changes = [_change_of(record, names) for record in records]
        if len({len(one.low) for one in changes}) > 1:
            raise ValueError("boxes in 2D and in 3D")
        if len({one.id for one in changes}) < len(changes):
            raise ValueError("two changes have one id")
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(_damage(error), where=str(path), hint=_HINT) from error
    return changes


def read_states(folder: Path) -> tuple[ChangedCells, list[str]]:
    """The cells in `states.npz`, and the names of the sessions in the order of time.

    Raises:
        InputError: the file is missing or damaged.
    """
    path = folder / STATES
    cells, occupied, observed, shown, resolution, sessions = read_npz(
        path,
        ("cells", "occupied", "observed", "shown", "resolution", "sessions"),
        _MAX_ARRAY,
        _HINT,
    ).values()
    K, S = len(cells) if cells.ndim else 0, len(sessions) if sessions.ndim else 0
    shapes = {"cells": (K, 2), "occupied": (K, S), "observed": (K, S), "shown": (K,)}
    arrays = {"cells": cells, "occupied": occupied, "observed": observed, "shown": shown}
    fits = all(arrays[name].shape == shape for name, shape in shapes.items())
    kinds = "".join(one.dtype.kind for one in (*arrays.values(), sessions, resolution))
    if not fits or kinds != "ibbbUf" or sessions.ndim != 1 or not S or resolution.shape != ():
        raise InputError("is damaged: arrays of other shapes", where=str(path), hint=_HINT)
    if not 0.0 < float(resolution) < 100.0 or not (abs(cells.astype(np.float64)) < _MAX_CELL).all():
        raise InputError("is damaged: cells that cannot be", where=str(path), hint=_HINT)
    if not observed.any(axis=1).all():
        raise InputError("is damaged: a cell that no session observed", where=str(path), hint=_HINT)
    found = ChangedCells(cells.astype(np.int64), occupied, observed, shown, float(resolution))
    return found, [str(name) for name in sessions]


def _damage(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"is damaged: {error} is missing"
    return f"is damaged: {error}"


def _session_of(record: dict[str, Any]) -> SessionRecord:
    first, last = (_whole(record[f"{name}_stamp_ns"]) for name in ("first", "last"))
    overlap, T = _number(record["overlap"]), np.array(record["T_place_session"], np.float64)
    if "\0" in record["name"]:
        raise ValueError(f"a session cannot have the name {record['name']!r}")
    if not 0.0 <= overlap <= 1.0:
        raise ValueError(f"the overlap of {record['name']} is {overlap}")
    if T.shape not in ((3, 3), (4, 4)) or not np.isfinite(T).all():
        raise ValueError(f"T_place_session of {record['name']} is no transform")
    return SessionRecord(record["name"], _source_of(record), first, last, overlap, T)


def _source_of(record: dict[str, Any]) -> str | None:
    source = record.get("input")
    return None if source is None else str(source)


def _change_of(record: dict[str, Any], names: Sequence[str]) -> ChangeRecord:
    kind, number = record["kind"], _whole(record["id"])
    if kind not in get_args(Kind):
        raise ValueError(f"{kind!r} is no kind of a change")
    before, after = (list(names).index(name) for name in record["between"])
    if before >= after:
        raise ValueError(f"change {number} ends before it begins")
    probability = _number(record["probability"])
    if not 0.0 <= probability <= 1.0:
        raise ValueError(f"the probability of change {number} is {probability}")
    low, high = _corners_of(record["box"])
    if kind != "moved":
        return ChangeRecord(number, kind, low, high, before, after, probability)
    start = _corners_of(record["from_box"])
    if len(start[0]) != len(low):
        raise ValueError(f"change {number} has boxes in 2D and in 3D")
    return ChangeRecord(number, kind, low, high, before, after, probability, *start)


def _corners_of(box: list[float]) -> tuple[Float, Float]:
    """Corners (D,) of a box x0, y0, x1, y1, and in 3D z0, z1."""
    if len(box) not in (4, 6):
        raise ValueError(f"a box of {len(box)} numbers")
    x0, y0, x1, y1, *z = [_number(value) for value in box]
    low, high = np.array([x0, y0, *z[:1]]), np.array([x1, y1, *z[1:]])
    if not (low <= high).all():
        raise ValueError("a box whose corners are exchanged")
    return low, high


def _number(value: object) -> float:
    """A number of JSON."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is no number")
    return float(value)


def _whole(value: object) -> int:
    """A whole number of JSON."""
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= _MAX_STAMP:
        raise ValueError(f"{value!r} is no whole number")
    return value
