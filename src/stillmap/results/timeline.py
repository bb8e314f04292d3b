"""A place over its sessions, from `sessions.json`, `changes.json` and `states.npz`."""

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from stillmap.core.array_folder import parse, read_npz
from stillmap.core.array_types import Bool, Float, Index, Int64
from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.json import read_json
from stillmap.core.short_repr import ShortRepr
from stillmap.results.reader import SESSIONS, Stamp

Kind = Literal["appeared", "gone", "moved", "door"]
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]

CHANGES, STATES = "changes.json", "states.npz"
HINT = "merge the sessions anew"
_MAX_JSON = 64 << 20  # bytes
_MAX_ARRAY = 1 << 31  # bytes of an array when it is unpacked
_MAX_CELL = 2**30  # of either axis
_FIRST_DATE = 315_532_800 * 10**9  # ns, 1980: earlier stamps count from when a robot was started
_WHOLE_CELL = 1.0  # cells around a box that belong to the change: corners are rounded


@dataclass(frozen=True, eq=False)
class PlaceSession(ShortRepr):
    """A session that was given to a merge; a result of one recording has one.

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
        first_ns, last_ns: stamps of its first and last scan.
    """

    name: str
    input: str | None
    accepted: bool
    why: str = ""
    T_place_session: Float | None = None
    covariance: Float | None = None
    overlap: float = 1.0
    scans: slice = field(default_factory=lambda: slice(0, 0))
    first_ns: int = 0
    last_ns: int = 0


@dataclass(frozen=True)
class SessionChange:
    """Something that is otherwise from one session to the next that observed it.

    Attributes:
        id: its number.
        kind: "appeared", "gone", "moved" or "door".
        box: m, x0, y0, x1, y1 and in 3D z0, z1: where it is now, or was.
        between: the last session before and the first one after.
        probability: that it changed.
        from_box: of where it was before it moved; None of other kinds.
    """

    id: int
    kind: Kind
    box: tuple[float, ...]
    between: tuple[str, str]
    probability: Probability
    from_box: tuple[float, ...] | None = None

    @property
    def label(self) -> str:
        """The letter of its kind and its number, e.g. `M7`."""
        return f"{self.kind[0].upper()}{self.id}"

    @property
    def boxes(self) -> list[tuple[Float, Float]]:
        """Corners (D,) of the box where it is, and of that where it was before."""
        return [
            (np.array([*box[:2], *box[4:5]]), np.array([*box[2:4], *box[5:]]))
            for box in (self.box, self.from_box)
            if box is not None
        ]


@dataclass(frozen=True)
class _SessionEntry:
    """An entry of `sessions.json`."""

    name: str
    accepted: bool
    input: str | None = None
    why: str | None = None
    T_place_session: list[list[float]] | None = None
    covariance: list[list[float]] | None = None
    overlap: Probability = 1.0
    first_stamp_ns: Stamp = 0
    last_stamp_ns: Stamp = 0
    first_scan: Annotated[int, Meta(ge=0, le=2**40)] = 0
    scans: Annotated[int, Meta(ge=0, le=2**40)] = 0


def read_sessions(folder: Path) -> list[PlaceSession]:
    """The sessions of a place, accepted or not, in the order in which they were given.

    Raises:
        InputError: `sessions.json` is missing or damaged.
    """
    path = folder / SESSIONS
    entries = parse(read_json(path, _MAX_JSON, HINT), list[_SessionEntry], path, HINT)
    with explaining_damage(path, hint=HINT):
        if len({one.name for one in entries}) != len(entries):
            raise ValueError("two sessions have one name")
        return [_to_session(one) for one in entries]


def _to_session(one: _SessionEntry) -> PlaceSession:
    if not one.name or "/" in one.name or "\0" in one.name or one.name in (".", ".."):
        raise ValueError(f"a session cannot have the name {one.name!r}")
    if not one.accepted:
        return PlaceSession(one.name, one.input, False, one.why or "")
    T, covariance = np.array(one.T_place_session), np.array(one.covariance)
    if T.shape not in ((3, 3), (4, 4)) or covariance.shape != (3 * (len(T) - 2),) * 2:
        raise ValueError(f"T_place_session or covariance of {one.name}")
    if not (np.isfinite(T).all() and np.isfinite(covariance).all()):
        raise ValueError(f"T_place_session or covariance of {one.name} is not finite")
    scans = slice(one.first_scan, one.first_scan + one.scans)
    times = (one.first_stamp_ns, one.last_stamp_ns)
    return PlaceSession(one.name, one.input, True, "", T, covariance, one.overlap, scans, *times)


def read_changes(folder: Path, names: Sequence[str]) -> list[SessionChange]:
    """The entries of `changes.json`, in the order of time.

    Args:
        folder: of the place.
        names: of its sessions in the order of time.

    Raises:
        InputError: the file is missing or damaged.
    """
    path = folder / CHANGES
    changes = parse(read_json(path, _MAX_JSON, HINT), list[SessionChange], path, HINT)
    size, ids = len(changes[0].box) if changes else 4, set[int]()
    for one in changes:
        if one.id in ids or size not in (4, 6) or not _is_sound(one, size, list(names)):
            what = f"is damaged: change {one.id} has an id, sessions or boxes that cannot be"
            raise InputError(what, where=str(path), hint=HINT)
        ids.add(one.id)
    return changes


def _is_sound(change: SessionChange, size: int, names: list[str]) -> bool:
    """True if the sessions of a change are in order, and its boxes have so many numbers."""
    before, after = change.between
    if not {before, after} <= {*names} or names.index(before) >= names.index(after):
        return False
    boxes = [change.box] if change.from_box is None else [change.box, change.from_box]
    if (change.kind == "moved") != (len(boxes) == 2) or any(len(box) != size for box in boxes):
        return False
    corners = np.array(change.boxes)
    return bool(np.isfinite(corners).all() and (corners[:, 0] <= corners[:, 1]).all())


@dataclass(frozen=True, eq=False)
class ChangedCells(ShortRepr):
    """K cells of the plane that are otherwise in some of S sessions.

    Attributes:
        cells: (K, 2) column and row; the cell's lower left corner is at `resolution * cells`.
        occupied: (K, S).
        observed: (K, S).
        shown: (K,) whether the map of the place shows something there.
        resolution: m, edge of a cell.
    """

    cells: Int64
    occupied: Bool
    observed: Bool
    shown: Bool
    resolution: float

    @property
    def centers(self) -> Float:
        """(K, 2) m."""
        return np.asarray((self.cells + 0.5) * self.resolution)

    def occupied_as_of(self, session: int) -> Bool:
        """(K,) what the last session up to this one saw, else the first one after."""
        at = find_last_observation(self.observed, session)
        return np.asarray(self.occupied[np.arange(len(at)), at])

    def within(self, changes: list[SessionChange]) -> Bool:
        """(K,) whether a cell lies in the box of one of these changes."""
        out, centers = np.zeros(len(self.cells), np.bool_), self.centers
        margin = _WHOLE_CELL * self.resolution
        for low, high in (box for change in changes for box in change.boxes):
            inside = (centers > low[:2] - margin) & (centers < high[:2] + margin)
            out |= inside.all(axis=1)
        return out


def find_last_observation(observed: Bool, session: int) -> Index:
    """(K,) the last session up to this one that observed each cell (K, S), else the first after."""
    before = observed[:, : session + 1]
    last = session - np.argmax(before[:, ::-1], axis=1)
    first_after = np.argmax(observed, axis=1)
    return np.asarray(np.where(before.any(axis=1), last, first_after), np.intp)


def read_states(folder: Path) -> tuple[ChangedCells, list[str]]:
    """The cells in `states.npz`, and the names of the sessions in the order of time.

    Raises:
        InputError: the file is missing or damaged.
    """
    path, names = folder / STATES, ("cells", "occupied", "observed", "shown")
    arrays = read_npz(path, (*names, "resolution", "sessions"), _MAX_ARRAY, HINT)
    cells, occupied, observed, shown, resolution, sessions = arrays.values()
    K, S = len(cells) if cells.ndim else 0, len(sessions) if sessions.ndim else 0
    shapes = [(K, 2), (K, S), (K, S), (K,), (), (S,)]
    kinds = "".join(one.dtype.kind for one in arrays.values())
    if (
        [one.shape for one in arrays.values()] != shapes
        or (kinds != "ibbbfU" or not S)
        or not (abs(cells.astype(np.float64)) < _MAX_CELL).all()
        or not (0.0 < float(resolution) < 100.0 and observed.any(axis=1).all())
    ):
        raise InputError("is damaged: cells that cannot be", where=str(path), hint=HINT)
    changed = ChangedCells(cells.astype(np.int64), occupied, observed, shown, float(resolution))
    return changed, [str(name) for name in sessions]


@dataclass(frozen=True, eq=False)
class Timeline(ShortRepr):
    """A place over its sessions.

    Attributes:
        sessions: S in the order of time.
        refused: those that are not in the place.
        changes: in the order of time.
        cells: that changed.
    """

    sessions: list[PlaceSession]
    refused: list[PlaceSession]
    changes: list[SessionChange]
    cells: ChangedCells

    def changes_at(self, session: int) -> list[SessionChange]:
        """The changes that a session was the first to see."""
        name = self.sessions[session].name
        return [one for one in self.changes if one.between[1] == name]

    def title(self, session: int) -> str:
        """Number, name and date of a session, e.g. `session 3 of 5: wednesday, 2026-05-31`."""
        number = f"session {session + 1} of {len(self.sessions)}"
        name, date = self.sessions[session].name, self.date(session)
        return f"{number}: {name}, {date}" if date else f"{number}: {name}"

    def date(self, session: int) -> str:
        """When a session began, in UTC, with the time where the day is not enough to tell apart."""
        days = [format_date_time(one.first_ns).partition(" ")[0] for one in self.sessions]
        if days.count(days[session]) == 1:
            return days[session]
        return format_date_time(self.sessions[session].first_ns)

    def cells_as_of(self, session: int) -> tuple[Bool, Bool, Bool]:
        """(K,) cells occupied as of a session, and which of them came and left since the one
        before by a change that is listed."""
        now = self.cells.occupied_as_of(session)
        before = self.cells.occupied_as_of(max(session - 1, 0))
        listed = self.cells.within(self.changes_at(session))
        return now, now & ~before & listed, before & ~now & listed


def read_timeline(folder: Path) -> Timeline:
    """The sessions of a place, which `stillmap merge` wrote, and what changed between them.

    Raises:
        InputError: a file is missing, damaged, or was changed by hand.
    """
    sessions = read_sessions(folder)
    cells, names = read_states(folder)
    accepted = {one.name: one for one in sessions if one.accepted}
    if sorted(names) != sorted(accepted):
        what = f"is of other sessions than those in {SESSIONS}"
        raise InputError(what, where=str(folder / STATES), hint=HINT)
    refused = [one for one in sessions if not one.accepted]
    changes = read_changes(folder, names)
    return Timeline([accepted[name] for name in names], refused, changes, cells)


def format_date_time(stamp_ns: int) -> str:
    """Day and minute in UTC, e.g. `2026-05-31 14:03`; empty where stamps are no dates."""
    if stamp_ns < _FIRST_DATE:
        return ""
    date = datetime.datetime.fromtimestamp(stamp_ns // 10**9, datetime.UTC)
    return f"{date:%Y-%m-%d %H:%M}"
