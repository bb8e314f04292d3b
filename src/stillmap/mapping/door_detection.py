"""Doors among the changes: one entry each, with the two positions of the leaf and its states."""

import dataclasses
import itertools
import math
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Cells
from stillmap.core.square_box import cell_keys
from stillmap.mapping.change_detection import Change, make_change
from stillmap.mapping.door_states import is_passage_observed, observe_states
from stillmap.mapping.doors import Door, Sector, fit_sector
from stillmap.mapping.labelled_recording import LabelledRecording
from stillmap.mapping.resting_leaf import find_resting_leaf

_MAX_TIME_GAP = 2.0  # s between the departure from one position and the arrival in the other
_REACH = 0.5  # m between the cells of both positions, which have the hinge in common
_MIN_ON_LEAF = 0.7  # share of a change's cells that lie on the leaf, for it to be of the door
_MIN_LEAF = 0.6  # m
_MIN_SWING, _MAX_SWING = math.radians(60.0), math.radians(145.0)  # walls stop leaves
_BEYOND = 0.4  # m beyond the leaf, in which the wall goes on that it closes


def find_doors(
    changes: list[Change], lines: list[Cells], surface: Cells, known: LabelledRecording
) -> list[Change]:
    """One change of kind `door` for all changes of each door, in the order of time.

    What comes and goes lies along two lines from a hinge; or a leaf leaves one of them as it
    arrives in the other; or only one of them changes, and the leaf seemed never to leave the other
    one, because it rests there. Beams must have ended on it in both positions, in turn.

    Args:
        changes: from `detect_changes`; a leaf that swings needs nobody near it.
        lines: (K, 2) cells of each row of dynamic hits that may be a leaf (`find_leaf_lines`).
        surface: (U, 2) cells that are occupied most of the time.
        known: 2D, with the beams that show the states.
    """
    changes = [*changes, *(_as_change(line, known) for line in lines)]
    left = list(changes)
    out: list[Change] = []
    candidates = _find_candidates(changes, surface)
    doors = [_make_door(candidate, surface) for candidate in candidates]
    observed = observe_states(doors, known)
    for candidate, shape, states in zip(candidates, doors, observed, strict=True):
        if not all(_holds(left, change) for change in candidate.changes):
            continue  # of a door that was found before
        door = dataclasses.replace(shape, states=states)
        if not states or not is_passage_observed(door, known):
            continue  # nobody saw it in both positions
        mine = [
            change
            for change in left
            if _holds(candidate.changes, change) or _is_on_leaf(candidate.sector, change)
        ]
        left = [change for change in left if not _holds(mine, change)]
        out.append(_join_changes(mine, door))
    return sorted(out, key=lambda change: (change.stamp_ns, change.x, change.y))


def _as_change(line: Cells, known: LabelledRecording) -> Change:
    """A row of cells as a change at any time: its states tell when."""
    first, last = known.recording.stamp_ns[[0, -1]].tolist()
    return make_change("comes and goes", line, known.resolution, first, last, last, 1)


def join_doors(changes: list[Change], doors: list[Change]) -> list[Change]:
    """All changes with the doors in place of those of their leaves, in the order of time."""
    leaves = [
        cell_keys(np.concatenate([change.cells, change.door.shut_cells, change.door.open_cells]))
        for change in doors
        if change.door is not None
    ]
    others = [
        change
        for change in changes
        if not any(np.isin(cell_keys(change.cells), leaf).mean() >= _MIN_ON_LEAF for leaf in leaves)
    ]
    return sorted([*others, *doors], key=lambda change: (change.stamp_ns, change.x, change.y))


def _holds(changes: list[Change], change: Change) -> bool:
    return any(change is held for held in changes)


class _Candidate(NamedTuple):
    """A sector, the changes that it was fitted to, and all cells of the leaf in both positions.

    `rests`: one of them is surface that did not change.
    """

    sector: Sector
    changes: list[Change]
    cells: Cells
    rests: bool


def _find_candidates(changes: list[Change], surface: Cells) -> list[_Candidate]:
    """Candidates for doors: first those whose positions both changed, then those of most cells."""
    came = [change for change in changes if change.kind == "came"]
    gone = [change for change in changes if change.kind == "left"]
    pairs = [list(pair) for pair in itertools.product(came, gone) if _may_be_one(*pair)]
    candidates = []
    for group in [*([change] for change in changes), *pairs]:
        cells = np.unique(np.concatenate([change.cells for change in group]), axis=0)
        resolution = group[0].resolution
        sector = fit_sector(cells, resolution)
        rests = sector is None
        if rests and len(group) == 1:
            others = surface[~np.isin(cell_keys(surface), cell_keys(cells))]
            leaf = find_resting_leaf(cells, others, resolution)
            cells = np.unique(np.concatenate([cells, leaf]), axis=0)
            sector = fit_sector(cells, resolution) if len(leaf) else None
        if sector is None or sector.length * resolution < _MIN_LEAF:
            continue
        if _MIN_SWING <= sector.angle <= _MAX_SWING:
            candidates.append(_Candidate(sector, group, cells, rests))
    return sorted(candidates, key=lambda candidate: (candidate.rests, -len(candidate.cells)))


def _may_be_one(came: Change, gone: Change) -> bool:
    """True if an arrival and a departure may be of one leaf: at one time, and near each other."""
    slack = round(_MAX_TIME_GAP * 1e9)
    if max(came.before_ns, gone.before_ns) >= min(came.stamp_ns, gone.stamp_ns) + slack:
        return False
    apart = np.abs([came.x - gone.x, came.y - gone.y])
    return bool(np.all(apart <= (np.array(came.size) + np.array(gone.size)) / 2 + _REACH))


def _is_on_leaf(sector: Sector, change: Change) -> bool:
    on_leaf = sector.nearer_ends(change.cells) >= 0
    return bool(on_leaf.mean() >= _MIN_ON_LEAF)


def _make_door(candidate: _Candidate, surface: Cells) -> Door:
    sector, cells = candidate.sector, candidate.cells
    resolution = candidate.changes[0].resolution
    nearer = sector.nearer_ends(cells)
    shut = _find_shut(sector, surface, resolution)
    x, y = ((sector.hinge + 0.5) * resolution).tolist()
    return Door(
        hinge=(x, y),
        length=sector.length * resolution,
        shut=math.remainder(sector.directions[shut], 2.0 * math.pi),
        opened=math.remainder(sector.directions[1 - shut], 2.0 * math.pi),
        shut_cells=cells[nearer == shut],
        open_cells=cells[nearer == 1 - shut],
        swept_cells=np.unique(np.concatenate([cells, sector.swept_cells()]), axis=0),
    )


def _join_changes(changes: list[Change], door: Door) -> Change:
    """All changes of a door in one."""
    cells = np.unique(np.concatenate([change.cells for change in changes]), axis=0)
    before, *since = door.states
    stamps = before.until_ns, since[0].since_ns, since[-1].since_ns
    change = make_change("door", cells, changes[0].resolution, *stamps, len(since))
    return dataclasses.replace(change, door=door)


def _find_shut(sector: Sector, surface: Cells, resolution: float) -> int:
    """The end position, 0 or 1, in which the wall goes on beyond the leaf: it is shut."""
    reach = math.ceil(_BEYOND / resolution)
    counts = []
    for direction in sector.directions:
        along = np.array([math.cos(direction), math.sin(direction)])
        ahead, left = se2.along_and_across(surface - sector.hinge, along)
        aside = np.abs(left)
        # beyond the leaf, and behind the hinge
        beyond = (ahead > sector.length) & (ahead <= sector.length + reach) & (aside <= 3.0)
        behind = (ahead < 0.0) & (ahead >= -reach) & (aside <= 3.0)
        counts.append(2 * np.count_nonzero(beyond) + np.count_nonzero(behind))
    return int(np.argmax(counts))
