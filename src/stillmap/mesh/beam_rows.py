"""Rows of beams, as the rings and columns of lidars and the rows of depth images; strips of
triangles between one row and the next."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Float, Index, Int32

_ROW_RESET = 0.1  # rad by which the angle falls where the next row begins
_MIN_STEADY = 0.95  # share of the steps within rows that go on
_MIN_ROWS, _MIN_ROW_LENGTH = 4, 16  # rows, and median number of beams in them
_MAX_STEP = 0.05  # rad, median step within a row
_MAX_OPENING = 0.2  # rad that a full turn may lack


class Rows(NamedTuple):
    """R rows of beams.

    Attributes:
        first: (R+1,) row r has the beams first[r]:first[r + 1].
        angle: (n,) rad along the row, mostly rising within each.
        closed: whether rows go all around.
    """

    first: Index
    angle: Float
    closed: bool


def split_rows(directions: Float) -> Rows | None:
    """Splits beams into rows along which azimuth or elevation goes on; None: there are no rows.

    Args:
        directions: (n, 3) unit vectors in recorded order.
    """
    if len(directions) < _MIN_ROWS * _MIN_ROW_LENGTH:
        return None
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    for angle in (azimuth, np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))):
        turned = (np.diff(angle) + np.pi) % (2.0 * np.pi) - np.pi
        sense = 1.0 if np.median(turned) > 0.0 else -1.0
        # the recording begins with a row
        along = (sense * (angle - angle[0])) % (2.0 * np.pi) if angle is azimuth else sense * angle
        step = np.diff(along)
        breaks = np.flatnonzero(step < -_ROW_RESET) + 1
        first = np.concatenate([[0], breaks, [len(directions)]]).astype(np.intp)
        within = np.delete(step, breaks - 1)
        steady = np.mean((within > 0.0) & (within < 10.0 * _MAX_STEP)) > _MIN_STEADY
        median_step = float(np.median(np.abs(step)))
        if steady and median_step < _MAX_STEP and len(breaks) + 1 >= _MIN_ROWS:
            if np.median(np.diff(first)) < _MIN_ROW_LENGTH:
                continue
            span = float(np.median([np.ptp(along[a:b]) for a, b in pairwise(first)]))
            return Rows(first, along, span > 2.0 * np.pi - _MAX_OPENING)
    return None


def triangulate_strips(rows: Rows) -> Int32:
    """(m, 3) triangle strips between successive rows, which may differ in length.

    After the last row comes the first one, which may be far away.
    """
    parts = [np.zeros((0, 3), np.intp)]
    ordered = [_sort_row(rows, r) for r in range(len(rows.first) - 1)]
    for (one, at_one), (other, at_other) in pairwise([*ordered, ordered[0]]):
        beam = np.concatenate([one, other])
        side = np.repeat([0, 1], [len(one), len(other)])
        order = np.argsort(np.concatenate([at_one, at_other]), kind="stable")
        beam, side = beam[order], side[order]
        # the last beam of either row before each beam
        last = np.stack([_previous_beam(beam, side == k) for k in (0, 1)])
        mine, opposite = last[side, np.arange(len(beam))], last[1 - side, np.arange(len(beam))]
        known = (mine >= 0) & (opposite >= 0)
        parts.append(np.stack([mine, beam, opposite], axis=1)[known])
    return np.concatenate(parts).astype(np.int32)


def _sort_row(rows: Rows, row: int) -> tuple[Index, Float]:
    """The beams of a row by angle, and the angles; closed rows end with their first beam."""
    beam = np.arange(rows.first[row], rows.first[row + 1])
    at = rows.angle[beam]
    order = np.argsort(at, kind="stable")
    beam, at = beam[order], at[order]
    if rows.closed and len(beam):
        beam, at = np.append(beam, beam[0]), np.append(at, at[0] + 2.0 * np.pi)
    return beam, at


def _previous_beam(beam: Index, some: Bool) -> Index:
    """(n,) the last beam before each that is marked in `some` (n,); -1: none."""
    place = np.where(some, np.arange(len(beam)), -1)
    before = np.concatenate([[-1], np.maximum.accumulate(place)[:-1]]).astype(np.intp)
    return np.where(before >= 0, beam[before], -1)
