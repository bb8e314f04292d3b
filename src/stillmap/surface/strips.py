"""Triangles between rows that differ in length: the rings of a lidar without lost beams."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_BACK = 0.1  # rad, by which the next row begins again
_STEADY = 0.95  # share of the steps within rows that go on
_FEWEST, _SHORTEST = 4, 16  # rows, and beams in half of them
_STEP = 0.05  # rad, the usual step within a row, at most
_WHOLE = 0.2  # rad that a turn lacks, at most


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


def rows_of(looking: Float) -> Rows | None:
    """Rows along which the azimuth, or the elevation, goes on, until it begins again.

    Args:
        looking: (n, 3) directions of length one, in their order.
    """
    if len(looking) < _FEWEST * _SHORTEST:
        return None
    azimuth = np.arctan2(looking[:, 1], looking[:, 0])
    for angle in (azimuth, np.arcsin(np.clip(looking[:, 2], -1.0, 1.0))):
        turned = (np.diff(angle) + np.pi) % (2.0 * np.pi) - np.pi
        sense = 1.0 if np.median(turned) > 0.0 else -1.0
        # the recording begins with a row
        along = (sense * (angle - angle[0])) % (2.0 * np.pi) if angle is azimuth else sense * angle
        step = np.diff(along)
        breaks = np.flatnonzero(step < -_BACK) + 1
        first = np.concatenate([[0], breaks, [len(looking)]]).astype(np.intp)
        within = np.delete(step, breaks - 1)
        steady = np.mean((within > 0.0) & (within < 10.0 * _STEP)) > _STEADY
        usual = float(np.median(np.abs(step)))
        if steady and usual < _STEP and len(breaks) + 1 >= _FEWEST:
            if np.median(np.diff(first)) < _SHORTEST:
                continue
            span = float(np.median([np.ptp(along[a:b]) for a, b in pairwise(first)]))
            return Rows(first, along, span > 2.0 * np.pi - _WHOLE)
    return None


def strip_faces(rows: Rows) -> NDArray[np.int32]:
    """(m, 3) triangles between each row and the next: from beam to beam on either side in turn.

    After the last row comes the first one, which may be far away.
    """
    parts = [np.zeros((0, 3), np.intp)]
    ordered = [_ordered(rows, r) for r in range(len(rows.first) - 1)]
    for (one, at_one), (other, at_other) in pairwise([*ordered, ordered[0]]):
        beam = np.concatenate([one, other])
        side = np.repeat([0, 1], [len(one), len(other)])
        order = np.argsort(np.concatenate([at_one, at_other]), kind="stable")
        beam, side = beam[order], side[order]
        # the last beam so far of either row, before each one
        last = np.stack([_last(beam, side == k) for k in (0, 1)])
        mine, opposite = last[side, np.arange(len(beam))], last[1 - side, np.arange(len(beam))]
        known = (mine >= 0) & (opposite >= 0)
        parts.append(np.stack([mine, beam, opposite], axis=1)[known])
    return np.concatenate(parts).astype(np.int32)


def _ordered(rows: Rows, row: int) -> tuple[Index, Float]:
    """The beams of a row by their angle, and these; the first one again at the end of a turn."""
    beam = np.arange(rows.first[row], rows.first[row + 1])
    at = rows.angle[beam]
    order = np.argsort(at, kind="stable")
    beam, at = beam[order], at[order]
    if rows.closed and len(beam):
        beam, at = np.append(beam, beam[0]), np.append(at, at[0] + 2.0 * np.pi)
    return beam, at


def _last(beam: Index, some: NDArray[np.bool_]) -> Index:
    """(n,) of the beams before each the last one that is of some; -1: none."""
    place = np.where(some, np.arange(len(beam)), -1)
    before = np.concatenate([[-1], np.maximum.accumulate(place)[:-1]]).astype(np.intp)
    return np.where(before >= 0, beam[before], -1)
