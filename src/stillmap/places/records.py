"""The JSON files of a place: its sessions, and the changes between them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.short_repr import ShortRepr
from stillmap.places.reader import read_sessions
from stillmap.places.timeline import ChangeRecord
from stillmap.places.timeline_reader import read_changes, read_states
from stillmap.results.reader import SESSIONS

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlaceSession(ShortRepr):
    """A session that was given to a merge.

    Attributes:
        name: unique in the place.
        input: its path, as it was given; None: it had none.
        accepted: whether it is in the place.
        why: the reason if it is not.
        T_place_session: (D+1, D+1); None: it is not in the place.
        covariance: of T_place_session, (3, 3) of x, y, heading, in 3D (6, 6) of translation and
            rotation vector, in the frame of the session; 0 of the first.
        overlap: share of its hits in area that the sessions before it knew.
        scans: its scans among those of the place.
    """

    name: str
    input: str | None
    accepted: bool
    why: str = ""
    T_place_session: Float | None = None
    covariance: Float | None = None
    overlap: float = 0.0
    scans: slice = field(default_factory=lambda: slice(0, 0))


@dataclass(frozen=True)
class SessionChange:
    """Something that is otherwise from one session to the next that looked.

    Attributes:
        id: its number.
        kind: "appeared", "gone", "moved" or "door".
        box: m, x0, y0, x1, y1 and in 3D z0, z1: where it is now, or was.
        from_box: of where it was before it moved; None of other kinds.
        between: the last session before and the first one after.
        probability: that it changed.
    """

    id: int
    kind: str
    box: tuple[float, ...]
    from_box: tuple[float, ...] | None
    between: tuple[str, str]
    probability: float


def read_place_sessions(folder: Path) -> list[PlaceSession]:
    """The sessions of a place, accepted or not, in the order in which they were given.

    Raises:
        InputError: `sessions.json` is missing or damaged.
    """
    try:
        return [_to_session(record) for record in read_sessions(folder)]
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(folder / SESSIONS)) from error


def _to_session(record: dict[str, Any]) -> PlaceSession:
    source = record.get("input")
    name, path = record["name"], None if source is None else str(source)
    if not record["accepted"]:
        return PlaceSession(name, path, False, str(record.get("why", "")))
    T = np.array(record["T_place_session"], np.float64)
    covariance = np.array(record["covariance"], np.float64)
    dof = {(3, 3): 3, (4, 4): 6}.get(T.shape)
    if dof is None or covariance.shape != (dof, dof) or not np.isfinite(T).all():
        raise ValueError(f"T_place_session or covariance of {name}")
    first, count = int(record["first_scan"]), int(record["scans"])
    if first < 0 or count < 1:
        raise ValueError(f"scans of {name}")
    scans = slice(first, first + count)
    return PlaceSession(name, path, True, "", T, covariance, float(record["overlap"]), scans)


def read_session_changes(folder: Path) -> list[SessionChange]:
    """The changes between the sessions of a place, in the order of time.

    Raises:
        InputError: `changes.json` or `states.npz` is missing or damaged.
    """
    _, names = read_states(folder)
    return [_to_change(one, names) for one in read_changes(folder, names)]


def _to_change(one: ChangeRecord, names: Sequence[str]) -> SessionChange:
    box, *before = (
        (*low[:2].tolist(), *high[:2].tolist(), *low[2:].tolist(), *high[2:].tolist())
        for low, high in one.boxes
    )
    between = names[one.before], names[one.after]
    return SessionChange(
        one.id, one.kind, box, before[0] if before else None, between, one.probability
    )
