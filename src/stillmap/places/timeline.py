"""A place over its sessions: when each was, what changed since the one before, and which cells."""

import datetime
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.places.place_change import Kind

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FIRST_DATE = 315_532_800 * 10**9  # ns, 1980: earlier stamps count from when a robot was started
_WHOLE_CELL = 1.0  # cells around a box that belong to the change: corners are rounded


@dataclass(frozen=True, eq=False)
class SessionRecord(ShortRepr):
    """A session of the place.

    Attributes:
        name: unique in the place.
        source: the input; None where it is unknown.
        first_ns, last_ns: stamps of its first and last scan.
        overlap: share of its hits in known area.
        T: (D+1, D+1) T_place_session.
    """

    name: str
    source: str | None
    first_ns: int
    last_ns: int
    overlap: float
    T: Float


@dataclass(frozen=True)
class RefusedRecord:
    """A session that is not in the place, and why."""

    name: str
    source: str | None
    why: str


@dataclass(frozen=True, eq=False)
class ChangeRecord(ShortRepr):
    """A change between two sessions.

    Attributes:
        id: its number in `changes.json`.
        kind: see `PlaceChange`.
        low, high: (D,) m, corners of the box where it is now, or was.
        from_low, from_high: (D,) m, of where it was before it moved; None otherwise.
        before, after: indices of the last session before and the first one after.
        probability: that it changed.
    """

    id: int
    kind: Kind
    low: Float
    high: Float
    before: int
    after: int
    probability: float
    from_low: Float | None = None
    from_high: Float | None = None

    @property
    def label(self) -> str:
        """The letter of its kind and its number, e.g. `M7`."""
        return f"{self.kind[0].upper()}{self.id}"

    @property
    def boxes(self) -> list[tuple[Float, Float]]:
        """Corners of the box where it is, and of that where it was before."""
        out = [(self.low, self.high)]
        if self.from_low is not None and self.from_high is not None:
            out.append((self.from_low, self.from_high))
        return out


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

    cells: NDArray[np.int64]
    occupied: Mask
    observed: Mask
    shown: Mask
    resolution: float

    @property
    def centers(self) -> Float:
        """(K, 2) m."""
        return np.asarray((self.cells + 0.5) * self.resolution)

    def occupied_as_of(self, session: int) -> Mask:
        """(K,) what the last session up to this one saw, else the first one after."""
        before = self.observed[:, : session + 1]
        last = session - np.argmax(before[:, ::-1], axis=1)
        first_after = np.argmax(self.observed, axis=1)
        at = np.where(before.any(axis=1), last, first_after)
        return np.asarray(self.occupied[np.arange(len(at)), at])

    def within(self, changes: list[ChangeRecord]) -> Mask:
        """(K,) whether a cell lies in the box of one of these changes."""
        out, centers = np.zeros(len(self.cells), np.bool_), self.centers
        margin = _WHOLE_CELL * self.resolution
        for low, high in (box for change in changes for box in change.boxes):
            inside = (centers > low[:2] - margin) & (centers < high[:2] + margin)
            out |= inside.all(axis=1)
        return out


@dataclass(frozen=True, eq=False)
class Timeline(ShortRepr):
    """A place over its sessions.

    Attributes:
        sessions: S in the order of time.
        refused: those that are not in the place.
        changes: in the order of time.
        cells: that changed.
        map_state: which state the map shows: `last`, `majority`, a session or a date.
    """

    sessions: list[SessionRecord]
    refused: list[RefusedRecord]
    changes: list[ChangeRecord]
    cells: ChangedCells
    map_state: str

    def changes_at(self, session: int) -> list[ChangeRecord]:
        """The changes that a session was the first to see."""
        return [one for one in self.changes if one.after == session]

    def title(self, session: int) -> str:
        """Number, name and date of a session, e.g. `session 3 of 5: wednesday, 2026-05-31`."""
        number = f"session {session + 1} of {len(self.sessions)}"
        name, date = self.sessions[session].name, self.date(session)
        return f"{number}: {name}, {date}" if date else f"{number}: {name}"

    def date(self, session: int) -> str:
        """When a session began, in UTC, with the time where the day is not enough to tell apart."""
        days = [format_date(one.first_ns) for one in self.sessions]
        if days.count(days[session]) == 1:
            return days[session]
        return format_date_time(self.sessions[session].first_ns)

    def cells_as_of(self, session: int) -> tuple[Mask, Mask, Mask]:
        """(K,) cells occupied as of a session, and which of them came and left since the one
        before by a change that is listed."""
        now = self.cells.occupied_as_of(session)
        before = self.cells.occupied_as_of(max(session - 1, 0))
        listed = self.cells.within(self.changes_at(session))
        return now, now & ~before & listed, before & ~now & listed


def format_date(stamp_ns: int) -> str:
    """Day of a stamp in UTC, e.g. `2026-05-31`; empty where stamps are no dates."""
    return format_date_time(stamp_ns).partition(" ")[0]


def format_date_time(stamp_ns: int) -> str:
    """Day and minute in UTC, e.g. `2026-05-31 14:03`; empty where stamps are no dates."""
    if stamp_ns < _FIRST_DATE:
        return ""
    date = datetime.datetime.fromtimestamp(stamp_ns // 10**9, datetime.UTC)
    return f"{date:%Y-%m-%d %H:%M}"
