"""Scores of the changes that `stillmap merge` found between simulated sessions.

True changes that could be observed, those that were found, and both on the cells of the truth.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from place_cells import MIN_BEAMS, ChangeTruth, Seen
from place_poses import PlacedSession, read_json
from place_truth import SessionTruth

from stillmap.core.array_folder import read_npz
from stillmap.core.errors import InputError
from stillmap.results.eval.labels import Scores

Bool = NDArray[np.bool_]
MIN_CELLS = 5  # of an object's surface, seen before and after: its change could be found
Float = NDArray[np.float64]
_MAX_CELLS = 1 << 31  # bytes of an array when it is unpacked
_CELLS = "changes.npz"
_KINDS = ("appeared", "gone", "moved", "door")
_COVERED = 0.5  # share of these that a change that was found must hold


class Event(NamedTuple):
    """An object that came to a place or left it.

    Attributes:
        came: to it.
        seen: the last session that saw the place before, and the first one after.
        true: the last session before and the first one after, whether they saw it or not.
        cells: (H, W), in 3D (K,), of its surface, that both of `seen` saw.
    """

    came: bool
    seen: tuple[int, int]
    true: tuple[int, int]
    cells: Bool

    def is_dated(self, before: int, after: int) -> bool:
        """Whether a change between two sessions has the right date."""
        early = self.seen[0] <= before <= self.true[0]
        return early and self.true[1] <= after <= self.seen[1]


def list_events(cells: ChangeTruth, truth: SessionTruth, sessions: list[int]) -> Iterator[Event]:
    """The true changes between the sessions that could be observed."""
    for change in truth.changes:
        one = truth.objects[change.object]
        for came, at in ((True, change.between[1]), (False, change.between[0])):
            surface = cells.draw_object(truth, change.object, at)
            if not surface.any():
                continue
            looked = [
                surface & _looked(cells, k, one.places[s] == one.places[at])
                for k, s in enumerate(sessions)
            ]
            enough = [int(mask.sum()) >= MIN_CELLS for mask in looked]
            before = [k for k, s in enumerate(sessions) if s <= change.between[0]]
            after = [k for k, s in enumerate(sessions) if s >= change.between[1]]
            seen = ([k for k in before if enough[k]][-1:], [k for k in after if enough[k]][:1])
            if not seen[0] or not seen[1]:
                continue
            first, last = seen[0][0], seen[1][0]
            states = [one.places[sessions[k]] == one.places[at] for k in (first, last)]
            both = looked[first] & looked[last]
            if states == [not came, came] and both.sum() >= MIN_CELLS:
                yield Event(came, (first, last), (before[-1], after[0]), both)


def _looked(cells: ChangeTruth, session: int, is_there: bool) -> Bool:
    """Cells in which a session saw that a surface is there, or is not."""
    seen = cells.seen[session]
    return cells.widen(seen.hits >= MIN_BEAMS) if is_there else seen.passes >= MIN_BEAMS


class FoundChange(NamedTuple):
    """A change of a place.

    Attributes:
        kind: as in `changes.json`.
        before, after: index among the accepted sessions, by date.
        came, left: cells of the truth where something is now, and where something was; of doors
            both.
    """

    kind: str
    before: int
    after: int
    came: Bool
    left: Bool

    @property
    def cells(self) -> Bool:
        """All of them."""
        return self.came | self.left


class NamedCells(NamedTuple):
    """The cells that changes name: `change` (N,) ids, `points` (N, D) centres in the world."""

    change: NDArray[np.integer]
    points: Float


def read_named_cells(place: Path, T_world_place: Float) -> NamedCells | None:
    """The cells of all changes; None: the place does not name them.

    Raises:
        InputError: the file is damaged.
    """
    path, D = place / _CELLS, len(T_world_place) - 1
    if not path.is_file():
        return None
    try:
        ids, centres = read_npz(path, ("change", "xyz"[:D]), _MAX_CELLS).values()
        centres = np.asarray(centres, np.float64)
        if centres.shape != (len(ids), D):
            raise ValueError(f"{'xyz'[:D]} is {centres.shape}")
    except (TypeError, ValueError) as error:
        raise InputError(f"is damaged: {error}", where=str(path)) from error
    return NamedCells(ids, _transform(T_world_place, centres))


def read_changes(
    place: Path,
    sessions: list[PlacedSession],
    T_world_place: Float,
    cells: ChangeTruth,
    named: NamedCells | None,
) -> list[FoundChange]:
    """The changes of a place.

    Args:
        place: the folder.
        sessions: the accepted ones, by date.
        T_world_place: (D+1, D+1).
        cells: of the truth.
        named: the cells of the changes; None: all within their boxes.

    Raises:
        InputError: a file is missing or damaged.
    """
    path = place / "changes.json"
    tree = read_json(path)
    index = {one.name: k for k, one in enumerate(sessions)}
    T_place_world = np.asarray(np.linalg.inv(T_world_place), np.float64)
    at = _transform(T_place_world, cells.centres())
    try:
        return [_read_change(one, index, at, cells, named) for one in tree]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"is damaged: {error!r}", where=str(path)) from error


def _read_change(
    one: dict[str, Any],
    index: dict[str, int],
    at: Float,
    cells: ChangeTruth,
    named: NamedCells | None,
) -> FoundChange:
    kind, (before, after) = str(one["kind"]), (index[name] for name in one["between"])
    if kind not in _KINDS:
        raise ValueError(f"kind '{kind}'")
    box = _fill(one["box"], at, cells.edge)
    was = _fill(one["from_box"], at, cells.edge) if one.get("from_box") else np.zeros_like(box)
    if named is not None:
        own = cells.mark(named.points[named.change == int(one["id"])])
        box, was = box & own, was & own
    if kind == "door":
        box = was = box | was
    elif kind == "gone":
        box, was = np.zeros_like(box), box
    return FoundChange(kind, before, after, box, was)


def _fill(box: list[float], at: Float, margin: float) -> Bool:
    """Those of the points (..., D) that lie within a box x0, y0, x1, y1, in 3D also z0, z1."""
    edges = [float(value) for value in box]
    inside = np.ones(at.shape[:-1], bool)
    for axis, (low, high) in enumerate(((0, 2), (1, 3), (4, 5))[: at.shape[-1]]):
        x = at[..., axis]
        inside &= (x >= edges[low] - margin) & (x <= edges[high] + margin)
    return inside


def _transform(T: Float, points: Float) -> Float:
    D = len(T) - 1
    return np.asarray(points @ T[:D, :D].T + T[:D, D])


@dataclass(frozen=True)
class ChangeScores(Scores):
    """NaN where a denominator is zero.

    Cells are those of 5 cm, in 3D of 20 cm, that two sessions saw, and none between them: each with
    MIN_BEAMS beams that end in it or pass it. A cell truly changed if a surface runs through it in
    one of the two only, that at least MIN_BEAMS beams hit there or in a neighbouring cell, and
    MIN_BEAMS pass in the other session. A cell that was found is right if it or one of its 8
    neighbours (26 in 3D) truly changed; a true one is found if it or a neighbour was found. Other
    cells in or beside which a surface runs in one session only count neither way.

    Attributes:
        source: "cells": `changes.npz` says which cells changed; "boxes": those
            in boxes, grown by a cell, where beams at true poses end in one session only.
        cells: pairs of sessions and cells that truly changed.
        found: those that were called changed.
        precision, recall, f1: of these.
        events: objects that came to a place, left it, or doors that turned there, with at least
            MIN_CELLS cells seen before and after.
        events_found: of these, half of whose cells one change holds.
        dates_right: share of these that begin with the last session before that saw the place, or
            a later one before, and end likewise.
        changes: that were reported.
        spurious: of these, without one cell that truly changed in that time.
    """

    source: str
    cells: int
    found: int
    precision: float
    recall: float
    f1: float
    events: int
    events_found: int
    dates_right: float
    changes: int
    spurious: int


def score_changes(
    found: list[FoundChange],
    source: str,
    cells: ChangeTruth,
    truth: SessionTruth,
    sessions: list[int],
) -> ChangeScores:
    """Score changes.

    Args:
        found: from `read_changes`.
        source: "cells" or "boxes", see `ChangeScores`.
        cells: the truth about S sessions, by date.
        truth: of all sessions.
        sessions: (S,) their numbers in it.
    """
    true, called, right, recalled = 0, 0, 0, 0
    real = [np.zeros(cells.fixed.shape, bool) for _ in found]
    for i, j, both in _pairs(cells):
        changed, either = _true_changes(cells, i, j)
        changed &= both
        flips = _flips(cells.seen[i], cells.seen[j]) if source == "boxes" else both
        meanwhile = [k for k, one in enumerate(found) if one.before < j and one.after > i]
        for k in meanwhile:
            real[k] |= found[k].cells & changed
        mask = _net_cells([found[k] for k in meanwhile], cells) & flips & both
        near = cells.widen(changed)
        mask &= near | ~cells.widen(either)
        true, called = true + int(changed.sum()), called + int(mask.sum())
        right += int((mask & near).sum())
        recalled += int((changed & cells.widen(mask)).sum())
    precision, recall = _ratio(right, called), _ratio(recalled, true)
    events = list(list_events(cells, truth, sessions))
    dates = [_match(event, found) for event in events]
    dated = sum(
        any(event.is_dated(*date) for date in own) for event, own in zip(events, dates, strict=True)
    )
    matched = sum(len(own) > 0 for own in dates)
    return ChangeScores(
        source=source,
        cells=true,
        found=recalled,
        precision=precision,
        recall=recall,
        f1=_ratio(2 * precision * recall, precision + recall),
        events=len(events),
        events_found=matched,
        dates_right=_ratio(dated, matched),
        changes=len(found),
        spurious=sum(not one.any() for one in real),
    )


def _net_cells(changes: list[FoundChange], cells: ChangeTruth) -> Bool:
    """Cells of changes, but those to which something came before it left again, or it left
    before something came."""
    mask, undone = (np.zeros(cells.fixed.shape, bool) for _ in range(2))
    for one in changes:
        mask |= one.cells
        earlier = [other for other in changes if other.after <= one.before]
        for other in earlier if one.kind != "door" else ():
            if other.kind != "door":
                undone |= (one.left & other.came) | (one.came & other.left)
    return mask & ~undone


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")


def _pairs(cells: ChangeTruth) -> Iterator[tuple[int, int, Bool]]:
    """Two sessions each, and the cells that both saw, and none between them."""
    seen = [one.seen for one in cells.seen]
    for i in range(len(seen)):
        left = seen[i].copy()
        for j in range(i + 1, len(seen)):
            yield i, j, left & seen[j]
            left &= ~seen[j]


def _true_changes(cells: ChangeTruth, i: int, j: int) -> tuple[Bool, Bool]:
    """Cells that changed and were looked at, and all through which a surface ran once."""
    a, b = cells.surfaces[i], cells.surfaces[j]
    hit = [cells.widen(one.hits >= MIN_BEAMS) for one in (cells.seen[i], cells.seen[j])]
    free = [one.passes >= MIN_BEAMS for one in (cells.seen[i], cells.seen[j])]
    return (a & ~b & hit[0] & free[1]) | (b & ~a & hit[1] & free[0]), a != b


def _flips(one: Seen, other: Seen) -> Bool:
    """(H, W) cells with hits in one session, and none nearby and beams through in the other."""
    hit = [seen.on_surface for seen in (one, other)]
    free = [(seen.hits == 0) & (seen.passes >= MIN_BEAMS) for seen in (one, other)]
    return np.asarray((hit[0] & free[1]) | (hit[1] & free[0]))


def _match(event: Event, found: list[FoundChange]) -> list[tuple[int, int]]:
    """When the changes that hold most of an event's cells took place."""
    dates = []
    for one in found:
        own = one.came if event.came else one.left
        if (event.cells & own).sum() >= _COVERED * event.cells.sum():
            dates.append((one.before, one.after))
    return dates
