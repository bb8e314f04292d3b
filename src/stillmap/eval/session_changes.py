"""Scores of the changes that `stillmap merge` found between sessions, per cell and per change."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.eval.labels import Scores
from stillmap.eval.session_cells import MIN_BEAMS, ChangeTruth, Seen
from stillmap.eval.session_events import Event, list_events
from stillmap.eval.session_found import FoundChange
from stillmap.eval.session_truth import SessionTruth

Bool = NDArray[np.bool_]

_COVERED = 0.5  # share of these that a change that was found must hold


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
