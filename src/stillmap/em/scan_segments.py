"""Segments of a 2D scan: neighbouring beams without a jump in depth, by width and depth order."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import finite_rows
from stillmap.core.chunks import ScanBeams

Index = NDArray[np.intp]

_LINK, _LINK_PER_METRE = 0.35, 0.02  # m between neighbours of one segment; more per metre of range
_WIDTHS = np.array([0.15, 0.35, 0.6, 0.9, 1.5])  # m: a leg, two, a person, a desk, a car
_MIN_WITHOUT_RETURN = 3  # neighbouring beams; fewer may have been lost
# what lies beside the two ends of a segment
_BOTH_FARTHER, _ONE_FARTHER, _BOTH_NEARER, _UNKNOWN = range(4)
N_SEGMENT_TYPES = 4 * (len(_WIDTHS) + 1)


def find_lost_beams(
    hit: NDArray[np.bool_], points: NDArray[np.float32], scan: Index
) -> NDArray[np.bool_]:
    """(M,) beams without a return, fewer than three side by side: they may have been lost.

    Args:
        hit, points: M beams in the order of their bearings; NaN points are unusable.
        scan: (M,) of each.
    """
    without = ~hit & finite_rows(points)
    if not without.any():
        return without
    begins = np.flatnonzero(np.append(True, (np.diff(without) != 0) | (np.diff(scan) > 0)))
    length = np.diff(np.append(begins, len(hit)))
    return without & np.repeat(length < _MIN_WITHOUT_RETURN, length)


def classify_segments(data: ScanBeams) -> NDArray[np.int8]:
    """(M,) type of the segment that each beam belongs to; -1 without a return.

    A type is one of six widths and one of four depth orders: what is hit beside the two ends lies
    farther away than these, or three or more beams without a return pass; it does at one end only;
    something nearer hides both; or one end is that of the scan.

    Args:
        data: M beams of 2D scans, in the order of their bearings.
    """
    scan = np.repeat(np.arange(len(data.offset) - 1), np.diff(data.offset))
    usable = np.flatnonzero(
        finite_rows(data.points) & ~find_lost_beams(data.hit, data.points, scan)
    )
    types = np.full(len(data.hit), -1, np.int8)
    if len(usable) == 0:
        return types
    scan = scan[usable]
    hit, xy = data.hit[usable], data.points[usable].astype(np.float64)
    distance = np.hypot(*xy.T)
    step = np.hypot(*np.diff(xy, axis=0).T)
    max_step = _LINK + _LINK_PER_METRE * np.minimum(distance[1:], distance[:-1])
    is_cut = (np.diff(scan) > 0) | ~hit[1:] | ~hit[:-1] | (step > max_step)
    segment = np.append(0, np.cumsum(is_cut))
    first = np.flatnonzero(np.append(True, is_cut))
    last = np.append(first[1:], len(usable)) - 1
    width = np.hypot(*(xy[last] - xy[first]).T)
    depth = np.where(hit, distance, np.inf)
    order = _depth_order(scan, depth, first, last)
    of_segment = 4 * np.searchsorted(_WIDTHS, width, side="right") + order
    types[usable] = np.where(hit, of_segment[segment], -1)
    return types


def _depth_order(
    scan: Index, depth: NDArray[np.float64], first: Index, last: Index
) -> NDArray[np.intp]:
    """(S,) what is beside the ends of S segments, from beam `first` to beam `last` of all."""
    farther, known = np.zeros((2, 2, len(first)), np.bool_)
    for side, (end, beside) in enumerate(((first, first - 1), (last, last + 1))):
        inside = np.clip(beside, 0, len(scan) - 1)
        known[side] = (inside == beside) & (scan[inside] == scan[end])
        farther[side] = depth[inside] > depth[end]
    order = _BOTH_NEARER - farther.sum(axis=0)
    return np.where(known.all(axis=0), order, _UNKNOWN)
