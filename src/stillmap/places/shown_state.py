"""The state of changed cells that a map shows, and with it the labels of beams."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.local_frame import LocalFrame
from stillmap.core.short_repr import ShortRepr
from stillmap.places.beam_cells import BeamCells
from stillmap.places.place_change import PlaceChange
from stillmap.places.place_states import PlaceStates

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_STATIC_DISTANCE = 2.5  # cells: unlisted changes nearer to static surface are noise of poses
_NEIGHBOUR_DISTANCE = 1.5  # cells between the end cell of a beam and the one that labels it
_MIN_P_STATIC, _MAX_SUPPORT = 0.9, 2.0  # of a cell; nats that other sessions add to a label there


@dataclass(frozen=True, eq=False)
class ShownState(ShortRepr):
    """The state of a place that its map shows.

    Attributes:
        place: K cells.
        p_shown: (K,) probability that the map shows something in the cell.
        support: (K, S) nats by which the other sessions make a label of each session static.
        noise: cells that change by themselves, unlisted: beside static surface the map shows them
            as static, elsewhere not at all.
    """

    place: PlaceStates
    p_shown: Float
    support: NDArray[np.float32]
    noise: Index

    def find_cells(self, centres: Float) -> Index:
        """(C,) the cell at or beside each centre (C, D) in metres; -1: none."""
        if not len(self.place.cells) or not len(centres):
            return np.full(len(centres), -1)
        limit = _NEIGHBOUR_DISTANCE * self.place.resolution
        distance, at = self._tree.query(centres, distance_upper_bound=limit)
        return np.where(np.isfinite(distance), at, -1).astype(np.intp)

    @cached_property
    def _tree(self) -> "cKDTree":
        from scipy.spatial import cKDTree  # slow to load

        return cKDTree((self.place.cells + 0.5) * self.place.resolution)


def show_state(place: PlaceStates, changes: list[PlaceChange], limit: int | None) -> ShownState:
    """The state of a place as of a session.

    Args:
        place: K cells over S sessions.
        changes: that are listed.
        limit: index of the session in the order of time; None: the state that most sessions saw.
    """
    states = place.states
    observed, occupied = states.observed, states.p_occupied
    if limit is None:
        share = (observed * occupied).sum(axis=1) / np.maximum(observed.sum(axis=1), 1)
        p_shown = (share > 0.5).astype(np.float64)
    else:
        p_shown = occupied[np.arange(len(occupied)), _last_observed(observed, limit)]
    unchanged = states.p_changing <= 0.5
    p_shown = np.where(unchanged, np.maximum(p_shown, states.p_static), p_shown)
    stands, gone = _settle_unlisted(place, changes)
    p_shown[stands], p_shown[gone] = 1.0, 0.0
    total = place.evidence.sum(axis=1, keepdims=True) - place.evidence
    support = np.where(
        states.p_static[:, None] > _MIN_P_STATIC, np.clip(total, 0.0, _MAX_SUPPORT), 0.0
    )
    return ShownState(place, p_shown, support.astype(np.float32), np.concatenate([stands, gone]))


def _last_observed(observed: NDArray[np.bool_], limit: int) -> Index:
    """(K,) the last session up to `limit` that observed each cell, else the first one after."""
    before = observed[:, : limit + 1]
    last = limit - np.argmax(before[:, ::-1], axis=1)
    first_after = np.argmax(observed, axis=1)
    return np.asarray(np.where(before.any(axis=1), last, first_after), np.intp)


def _settle_unlisted(place: PlaceStates, changes: list[PlaceChange]) -> tuple[Index, Index]:
    """Cells that change by themselves, unlisted: those that stand, and those that do not.

    Beside static surface they are noise of its poses, elsewhere what movers left.
    """
    listed = np.zeros(len(place.cells), np.bool_)
    for change in changes:
        listed[change.cells] = True
    alone = np.flatnonzero((place.states.p_changing > 0.5) & ~listed)
    static = place.cells[place.states.p_static > 0.5]
    if not len(alone) or not len(static):
        return np.zeros(0, np.intp), alone
    from scipy.spatial import cKDTree  # slow to load

    limit = _STATIC_DISTANCE
    distance, _ = cKDTree(static).query(place.cells[alone], distance_upper_bound=limit + 1.0)
    return alone[distance <= limit], alone[distance > limit]


def label_session(
    shown: ShownState, beams: BeamCells, centres: Float, session: int
) -> NDArray[np.float32]:
    """(M,) P(static) of the beams of a session, by what all sessions saw.

    The probability that the map shows what reflected the beam: that it did not move during the
    session, and stands there in the state that the map shows.

    Args:
        shown: the state of the place.
        beams: M beams that ended in C cells.
        centres: (C, D) of the cells in the frame of the place, metres.
        session: its index in the order of time.
    """
    of = shown.find_cells(centres)
    known = of >= 0
    p_shown = np.where(known, shown.p_shown[of], 1.0).astype(np.float32)
    support = np.where(known, shown.support[of, session], 0.0).astype(np.float32)
    p_shown, support = np.append(p_shown, np.float32(1.0)), np.append(support, np.float32(0.0))
    out = np.empty(len(beams.of_beam), np.float32)
    for block in arrays.iter_blocks(out):
        cell = beams.of_beam[block]
        own = beams.p_static[block].astype(np.float32)
        odds = own * np.exp(support[cell])
        out[block] = odds / (odds + (1.0 - own)) * p_shown[cell]
    return out


def changed_cell_table(
    shown: ShownState, names: Sequence[str], frame: LocalFrame
) -> dict[str, NDArray[np.generic]]:
    """The changed cells in the plane and their states in every session, for report and viewer.

    Args:
        shown: the state of the place in the plane.
        names: of the sessions, in the order of time.
        frame: of the place, in its map frame.
    """
    by = np.round(frame.origin[:2] / shown.place.resolution).astype(np.int64)
    states = shown.place.states
    changed = np.setdiff1d(np.flatnonzero(states.p_changing > 0.5), shown.noise)
    return {
        "cells": (shown.place.cells[changed] + by).astype(np.int32),
        "occupied": states.path[changed],
        "observed": states.observed[changed],
        "shown": shown.p_shown[changed] > 0.5,
        "resolution": np.array(shown.place.resolution),
        "sessions": np.array(names, np.str_),
    }
