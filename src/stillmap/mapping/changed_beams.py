"""Beams of changed places: their labels, and those that ended on objects which came or left."""

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np

from stillmap import em
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Bool, Float32, Index, Int64
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.mapping.change_detection import Change
from stillmap.mapping.changed_objects import find_shown_cells, is_same_place
from stillmap.mapping.doors import Door, fit_sector
from stillmap.mapping.labelled_recording import LabelledRecording

_EVER = (int(np.iinfo(np.int64).min), int(np.iinfo(np.int64).max))  # stamps


def relabel_changes(
    known: LabelledRecording,
    occupied: em.CellProbabilities,
    histories: em.CellHistories,
    changes: list[Change],
    state: em.MapState,
) -> tuple[Float32, em.CellProbabilities]:
    """Labels (M,) and map cells, taken from the cell histories within the listed changes.

    There p_static of a beam is the probability that the map in this state shows the object that
    reflected it, and that this is not the leaf of a door. Cells of one object decide together.
    Changes of cells that are not listed are noise.

    Args:
        known: M beams, with the labels of the final E-step.
        occupied, histories: from the same.
        changes: from `detect_changes`.
        state: state of changed places that the map shows.
    """
    if not changes:
        return known.p_static, occupied
    if not np.array_equal(occupied.cells, histories.cells):
        raise ValueError("occupied: expected the cells of the final E-step")
    listed, p_in_map, p_leaf = find_shown_cells(histories, changes, state)
    # a leaf that swings is no static object, wherever the map shows it
    label = p_in_map * (1.0 - p_leaf)
    out = known.copy_labels()
    for beams, surfel in known.iter_surfels(histories, out):
        ended = np.flatnonzero(surfel >= 0)
        ended = ended[listed[surfel[ended]]]
        out[beams][ended] = label[surfel[ended]]
    p_occupied = np.where(listed, p_in_map * histories.p_in_cell, occupied.p_occupied)
    return out, dataclasses.replace(occupied, p_occupied=p_occupied)


def find_changed_object_beams(
    known: LabelledRecording, changes: list[Change], doors: list[Door]
) -> Index:
    """(n,) dynamic beams, rising, that ended on an object while it stood in a changed place.

    Or on the leaf of a door that was not seen in its other position. Recurring changes other than
    doors are left out: they may be people who wait there.
    """
    stays = [
        _Stay.around_cells(change.cells, _stay_span(change, changes))
        for change in changes
        if change.kind != "comes and goes"
        or fit_sector(change.cells, change.resolution) is not None
    ]
    for door in doors:  # whose leaf is elsewhere is among the changes
        if not (len(door.shut_cells) and len(door.open_cells)):
            stays.append(_Stay.around_cells(door.swept_cells, _EVER))
    recording = known.recording
    on_objects = ArrayBuilder(np.intp, (), recording.scratch)
    for beam in known.iter_hits(dynamic=True) if stays else ():
        cells, stamp = known.end_cells(beam), recording.stamp_ns[recording.scans_of(beam)]
        on_object = np.zeros(len(beam), bool)
        for stay in stays:
            inside = np.flatnonzero(stay.bounds(cells, stamp))
            on_object[inside] |= stay.mask[tuple((cells[inside] - stay.low).T)]
        on_objects.append(beam[on_object])
    return on_objects.finish()


class _Stay(NamedTuple):
    """An object at rest: after `since` and until `until` (ns), in a mask of cells from `low` on."""

    since: int
    until: int
    low: Int64
    mask: Bool

    @classmethod
    def around_cells(cls, cells: Int64, span: tuple[int, int]) -> "_Stay":
        """In cells (K, 2) and those around them, in a span of stamps."""
        low, high = cells.min(axis=0) - 1, cells.max(axis=0) + 2
        mask = np.zeros(tuple((high - low).tolist()), bool)
        for i, j in itertools.product((-1, 0, 1), repeat=2):
            mask[tuple((cells - low + (i, j)).T)] = True
        return cls(*span, low, mask)

    def bounds(self, cells: Int64, stamp: Int64) -> Bool:
        """(n,) whether cells (n, 2) at stamps (n,) lie within the mask's box during the stay."""
        inside = ((cells >= self.low) & (cells < self.low + self.mask.shape)).all(axis=1)
        return np.asarray(inside & (stamp > self.since) & (stamp <= self.until))


def _stay_span(change: Change, changes: list[Change]) -> tuple[int, int]:
    """The stamps after which and until which an object stood there, as far as is known."""
    since, until = _EVER
    here = [near for near in changes if is_same_place(near, change)]
    if change.kind == "came":
        since = change.before_ns
        left = [near.before_ns for near in here if near.kind == "left"]
        until = min((stamp for stamp in left if stamp > since), default=until)
    elif change.kind == "left":
        until = change.before_ns
        came = [near.before_ns for near in here if near.kind == "came"]
        since = max((stamp for stamp in came if stamp < until), default=since)
    return since, until


_STRAY_SHARE = 0.15  # of the time, of readings where nothing stands


def update_occupancy(
    known: LabelledRecording,
    after: Float32,
    histories: em.CellHistories,
    occupied: em.CellProbabilities,
) -> em.CellProbabilities:
    """Occupancy of cells in which P(dynamic) or P(static) of the beams became less.

    P(dynamic) of a cell becomes less by the same factor as that of the beams that ended in it
    together: it belongs to the movers among them. The rest is clutter, which is an obstacle where
    it was there for much of the time: a stray reading of the floor is none. So does P(static).

    Args:
        known: M beams, with the labels before.
        after: (M,) P(c = 1) of each beam.
        histories: with the surfels of the same cells.
        occupied: with the labels before.
    """
    if not np.array_equal(occupied.cells, histories.cells):
        raise ValueError("occupied: expected the cells of the final E-step")
    sums, static = np.zeros((2, 2, len(occupied.cells)))
    for beams, surfel in known.iter_surfels(histories, known.p_static, after):
        old, new = known.p_static[beams], after[beams]
        ended = np.flatnonzero((surfel >= 0) & (old < DYNAMIC_BELOW))
        for row, p_static in zip(sums, (old, new), strict=True):
            row += np.bincount(surfel[ended], 1.0 - p_static[ended], minlength=len(row))
        ended = np.flatnonzero((surfel >= 0) & ~np.isnan(old))
        for row, p_static in zip(static, (old, np.minimum(old, new)), strict=True):
            row += np.bincount(surfel[ended], p_static[ended], minlength=len(row))
    factor, kept = (
        np.divide(new, old, out=np.ones(len(old)), where=old > 0.0) for old, new in (sums, static)
    )
    share = histories.occupied_share
    p_clutter = histories.p_in_cell * share / (share + _STRAY_SHARE)
    factor = np.minimum(factor, 1.0)
    p = kept * (factor * occupied.p_occupied + (1.0 - factor) * p_clutter)
    return dataclasses.replace(occupied, p_occupied=p.astype(np.float32))
