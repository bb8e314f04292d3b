"""The state that a map of a place shows: labels of beams, and the map in the plane."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import bound_box
from stillmap.core.tiles import TILE, TiledArray, compact, crop
from stillmap.em import OccupancyMap
from stillmap.places.changes import PlaceChange
from stillmap.places.evidence import BeamCells, Evidence, to_sums
from stillmap.places.place_states import MIN_HITS, PlaceStates, Tile, are_near, iter_tiles
from stillmap.results.timeline import find_last_observation

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


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
    support: Float32
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
        p_shown = occupied[np.arange(len(occupied)), find_last_observation(observed, limit)]
    unchanged = states.p_changing <= 0.5
    p_shown = np.where(unchanged, np.maximum(p_shown, states.p_static), p_shown)
    stands, gone = _settle_unlisted(place, changes)
    p_shown[stands], p_shown[gone] = 1.0, 0.0
    total = place.evidence.sum(axis=1, keepdims=True) - place.evidence
    is_static = states.p_static[:, None] > _MIN_P_STATIC
    support = np.where(is_static, np.clip(total, 0.0, _MAX_SUPPORT), 0.0)
    return ShownState(place, p_shown, support.astype(np.float32), np.concatenate([stands, gone]))


def _settle_unlisted(place: PlaceStates, changes: list[PlaceChange]) -> tuple[Index, Index]:
    """Cells that change by themselves, unlisted: those that stand, and those that do not.

    Beside static surface they are noise of its poses, elsewhere what movers left.
    """
    listed = np.zeros(len(place.cells), np.bool_)
    for change in changes:
        listed[change.cells] = True
    alone = np.flatnonzero((place.states.p_changing > 0.5) & ~listed)
    static = place.cells[place.states.p_static > 0.5]
    near = are_near(place.cells[alone], static, _STATIC_DISTANCE)
    return alone[near], alone[~near]


def label_session(shown: ShownState, beams: BeamCells, centres: Float, session: int) -> Float32:
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


def changed_cell_table(shown: ShownState, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The changed cells in the plane and their states in every session, for report and viewer.

    Args:
        shown: the state of the place in the plane.
        names: of the sessions, in the order of time.
    """
    states = shown.place.states
    changed = np.setdiff1d(np.flatnonzero(states.p_changing > 0.5), shown.noise)
    return {
        "cells": shown.place.cells[changed].astype(np.int32),
        "occupied": states.path[changed],
        "observed": states.observed[changed],
        "shown": shown.p_shown[changed] > 0.5,
        "resolution": np.array(shown.place.resolution),
        "sessions": np.array(names, np.str_),
    }


Image = Float32

# blocks of the box around the evidence: up to which it is always whole, and at most
_LEAST_BLOCKS, _MOST_BLOCKS = 1 << 17, 1 << 21

_FREE_PRIOR = 0.2  # occupancy of a cell that no beam passed; as of single recordings
# share of the hits of the most-hit cell, one and two cells around, below which it is its noise
_MIN_PROMINENCE, _MIN_FAR_PROMINENCE, _REACH = 0.25, 0.08, 2


def make_place_map(sessions: Sequence[Evidence], shown: ShownState) -> OccupancyMap:
    """The map of a place, in the plane, without what is far from most of it: see `bound_box`.

    Args:
        sessions: evidence of each in the plane.
        shown: the state that the map shows, of planar cells.
    """
    corners = np.concatenate([session.corner for session in sessions]).astype(np.int64)
    edge = sessions[0].edge
    box = bound_box(corners // edge, _LEAST_BLOCKS, _MOST_BLOCKS)
    corners = corners[box.contains(corners // edge)]
    low = corners.min(axis=0) // TILE * TILE
    width, height = ((corners.max(axis=0) - low) // TILE * TILE + TILE).tolist()
    layers = [TiledArray((height, width), np.float32, fill) for fill in (np.nan, 0.0, 0.0)]
    order, starts = _split_by_tile(shown)
    for tile in iter_tiles(sessions):
        if (tile.low < low).any() or (tile.low >= low + np.array([width, height])).any():
            continue
        cells = order[starts.get(tuple((tile.low // TILE).tolist()), slice(0, 0))]
        j, i = ((tile.low - low) // TILE).tolist()
        for layer, part in zip(layers, _draw_tile(sessions, tile, shown, cells), strict=True):
            layer.set_tile(i, j, part.T)
    first = corners.min(axis=0) - low
    last = corners.max(axis=0) + edge - low
    block = slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))
    resolution = sessions[0].resolution
    x, y = ((low + first) * resolution).tolist()
    p_occupied, alpha, beta = (crop(compact(layer), block) for layer in layers)
    return OccupancyMap(p_occupied, (x, y, 0.0), resolution, alpha, beta)


def _split_by_tile(shown: ShownState) -> tuple[Index, dict[tuple[int, ...], slice]]:
    """Indices of the cells sorted by tile, and the slice of each tile."""
    tiles = shown.place.cells // TILE
    order = np.lexsort(tiles.T[::-1])
    keys, first = np.unique(tiles[order], axis=0, return_index=True)
    ends = np.append(first[1:], len(order))
    return order, {
        tuple(key): slice(int(a), int(b))
        for key, a, b in zip(keys.tolist(), first, ends, strict=True)
    }


def _draw_tile(
    sessions: Sequence[Evidence], tile: Tile, shown: ShownState, cells: Index
) -> tuple[Image, Image, Image]:
    """p_occupied, alpha and beta of a tile, x along the first axis."""
    from scipy import ndimage  # slow to load

    low, shape = tile.low - _REACH, tuple(n + 2 * _REACH for n in tile.shape)
    units = np.zeros((2, *shape), np.uint32)
    for session in sessions:
        for total, of_session in zip(units, session.crop(low, shape), strict=True):
            total += of_session
    hits, passes = to_sums(units)
    at = tuple((shown.place.cells[cells] - low).T)
    stands = np.zeros(shape, np.float32)
    stands[at] = shown.p_shown[cells]
    candidate = np.zeros(shape, np.bool_)
    candidate[at] = True
    # hits below the limit of a candidate may still be all that was seen of a far wall
    stands = np.where(candidate, stands, hits / (hits + passes + MIN_HITS))
    limit = np.full(shape, 1e-6, np.float32)
    for share, radius in ((_MIN_PROMINENCE, 1), (_MIN_FAR_PROMINENCE, _REACH)):
        strongest = ndimage.maximum_filter(hits * stands, 2 * radius + 1, mode="constant")
        limit = np.maximum(limit, share * strongest)
    prominence = hits / limit
    surface = stands * np.minimum(prominence, 1.0)
    odds = _FREE_PRIOR / (1.0 - _FREE_PRIOR) * np.exp(-passes)
    p_passed = odds / (1.0 + odds)
    p = np.where(hits + passes > 0.0, surface + (1.0 - surface) * p_passed, np.float32(np.nan))
    inner = (slice(_REACH, -_REACH),) * 2
    alpha = hits * stands
    return p[inner].astype(np.float32), alpha[inner], (passes + hits - alpha)[inner]
