"""Surfaces that fill a doorway behind the face of the wall: shut leaves, or backs of niches.

Of one that never was seen open nothing tells which. But those that were seen to swing or stood open
tell how many of the doorways have a door, and for which share of the time doors are shut.
"""

from collections.abc import Sequence

import numpy as np

from stillmap.core.array_types import Cells, Float
from stillmap.mapping.doors import Door
from stillmap.mapping.doorways import Doorway
from stillmap.mapping.lone_leaves import LoneLeaf
from stillmap.mapping.resting_leaf import SurfaceField

_RECESS = np.arange(2.0, 7.0)  # cells behind the face of the wall
_MIN_COVERED, _MIN_EXACT = 0.9, 0.5  # share of the leaf within a cell of surface, and on it
_MIN_JAMB = 0.5  # share of the edges of the wall, from its face to the leaf, that are seen
_ASIDE, _MAX_ASIDE = np.array([3.0, 4.0, 5.0]), 0.4  # cells beside the leaf; share that is surface
_HIDDEN = np.arange(5.0)  # cells of the leaf that the edge of a wall may hide, drawn too long
_PRIOR_SECONDS = 300.0  # for which doors that stand open half of the time count
_MAX_ITERATIONS = 100


def find_shut_leaf(doorway: Doorway, surface: Cells) -> LoneLeaf | None:
    """The surface that fills a doorway; None: there is none.

    Which end its hinge is at nobody knows: the first one is given.

    Args:
        doorway: a gap in a wall.
        surface: (S, 2) occupied cells.
    """
    middle, reach = doorway.ends.mean(axis=0), doorway.width + 14.0
    near = surface[(np.abs(surface - middle) < reach).all(axis=1)]
    field = SurfaceField.of_cells(near, middle, reach)
    best: tuple[float, LoneLeaf | None] = 0.0, None
    u = (doorway.ends[1] - doorway.ends[0]) / doorway.width
    for v in (np.array([-u[1], u[0]]), np.array([u[1], -u[0]])):
        for back in _RECESS.tolist():
            score, cells = _rate_leaf(field, doorway, u, back * v)
            if score > best[0]:
                hinge = doorway.ends[0] + back * v
                best = score, LoneLeaf(hinge, doorway.width, u, u, cells)
    return best[1]


def _rate_leaf(
    field: SurfaceField, doorway: Doorway, u: Float, recess: Float
) -> tuple[float, Cells]:
    """Score of the leaf so far behind a doorway along u, 0 where there is none, and its cells."""
    row = doorway.ends[0] + recess + np.arange(2.0, doorway.width - 1.0)[:, None] * u
    covered = float(field.sample(field.is_near, row).mean())
    exact = float(field.sample(field.is_surface, row).mean())
    if covered < _MIN_COVERED or exact < _MIN_EXACT:
        return 0.0, np.empty((0, 2), np.int64)
    depth = np.arange(1.0, float(np.linalg.norm(recess)))[:, None] / np.linalg.norm(recess)
    for end, outwards in zip(doorway.ends, (-u, u), strict=True):
        jamb = field.sample(field.is_near, end + depth * recess).mean()
        beside = end + recess + (_HIDDEN[:, None] + _ASIDE)[..., None] * outwards
        is_free = field.sample(field.is_surface, beside).mean(axis=1) <= _MAX_ASIDE
        if jamb < _MIN_JAMB or not is_free.any():
            return 0.0, np.empty((0, 2), np.int64)
        hidden = float(is_free.argmax())
        if hidden:
            more = np.arange(-1.0, hidden + _ASIDE[0])[:, None] * outwards
            row = np.concatenate([row, end + recess + more])
    across = recess / np.linalg.norm(recess)
    points = np.concatenate([row + k * across for k in (-1.0, 0.0, 1.0)])
    cells = np.unique(np.round(points).astype(np.int64), axis=0)
    return covered + exact, cells[field.sample(field.is_surface, cells)]


def estimate_p_door(p_shut: Float, n_doors: int) -> Float:
    """(F,) probability that each of F surfaces which fill a doorway is a door that opens at times.

    Of all doorways the share pi has such a door, and pi ~ Beta(1, 2). Its posterior mean given
    which of the filled ones are doors, and these given pi, are computed in turn.

    Args:
        p_shut: (F,) probability that a door would have been shut whenever this one was seen.
        n_doors: doorways that have one for certain: it was seen to swing, or stood open.
    """
    p_door = np.full(len(p_shut), 0.5)
    for _ in range(_MAX_ITERATIONS):
        share = (n_doors + p_door.sum() + 1.0) / (n_doors + len(p_door) + 3.0)
        p_door, before = share * p_shut / (share * p_shut + 1.0 - share), p_door
        if np.allclose(p_door, before, rtol=0.0, atol=1e-3):
            break
    return p_door


def estimate_shut_share(doors: Sequence[Door]) -> float:
    """Share of the time for which doors are shut, by those that were seen to swing."""
    seconds = {"open": 0.5 * _PRIOR_SECONDS, "shut": 0.5 * _PRIOR_SECONDS}
    for state in (state for door in doors for state in door.states):
        seconds[state.position] += 1e-9 * (state.until_ns - state.since_ns)
    return seconds["shut"] / (seconds["open"] + seconds["shut"])
