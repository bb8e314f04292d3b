"""Legs and bodies in scans: narrow things that stand before something farther away."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.em.chunks import Chunk, chunks
from stillmap.em.tracker.options import TrackerOptions
from stillmap.recording.model import Recording

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_NOTHING = 1e6  # m, range of a beam that met nothing: farther than anything


@dataclass(frozen=True, eq=False)
class Features:
    """F narrow things, in the order of the scans.

    Attributes:
        scan: (F,) which scan shows them.
        xy: (F, 2) mean of their end points, metres in the map frame.
        width: (F,) metres across the line of sight.
    """

    scan: Index
    xy: Float
    width: Float


def features(recording: Recording, T_map_sensor: Float, options: TrackerOptions) -> Features:
    """What may be a leg or a body in any scan.

    Args:
        recording: 2D; the beams of a scan in the order of their angles, unusable ones are skipped.
        T_map_sensor: (T, 3, 3).
        options: see TrackerOptions.

    A segment runs from one jump of range to the next. It is a feature if it is neither too narrow
    nor too wide and its neighbours on both sides lie farther away: what ends where something
    nearer hides the rest has an unknown width, and so has what a scan begins or ends with.
    """
    parts = [_of_chunk(recording, chunk, options) for chunk in chunks(recording)]
    if not parts:
        return Features(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0))
    found = Features(*(np.concatenate([getattr(p, n) for p in parts]) for n in _FIELDS))
    T = T_map_sensor[found.scan]
    xy = (T[:, :2, :2] * found.xy[:, None]).sum(axis=-1) + T[:, :2, 2]
    return Features(found.scan, xy, found.width)


_FIELDS = ("scan", "xy", "width")


def ranges(points: Float, hit: NDArray[np.bool_]) -> Float:
    """(N,) metres to end points (N, 2); what met nothing is farther away than anything."""
    return np.where(hit, np.hypot(*points.T), _NOTHING)


def _of_chunk(recording: Recording, chunk: Chunk, options: TrackerOptions) -> Features:
    """The features of some scans, still in the frame of the sensor."""
    scan = np.repeat(np.arange(chunk.scans.start, chunk.scans.stop), np.diff(chunk.offset))
    points = recording.points[chunk.beams].astype(np.float64)
    usable = np.isfinite(points).all(axis=1)
    scan, points, hit = scan[usable], points[usable], recording.hit[chunk.beams][usable]
    r = ranges(points, hit)
    first, last = _segments(r, options.jump)
    inner = (first > 0) & (last < len(r) - 1) & hit[first]
    first, last = first[inner], last[inner]
    before, after = first - 1, last + 1
    whole = (scan[before] == scan[first]) & (scan[after] == scan[first])
    nearer = (r[before] > r[first]) & (r[after] > r[last])
    width, extent = _width(points, r, first, last), np.hypot(*(points[last] - points[first]).T)
    narrow = (width >= options.narrowest) & (np.maximum(width, extent) <= options.widest)
    chosen = whole & nearer & narrow
    first, last = first[chosen], last[chosen]
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(points, axis=0)])
    xy = (sums[last + 1] - sums[first]) / (last + 1 - first)[:, None]
    return Features(scan[first], xy, width[chosen])


def _segments(r: Float, jump: float) -> tuple[Index, Index]:
    """First and last beam of every run without a jump of range, from scan to scan if need be."""
    cut = np.flatnonzero(np.abs(np.diff(r)) > jump)
    ends = np.append(cut, np.arange(len(r))[-1:])  # none without beams
    return np.append(np.zeros(len(ends), np.intp)[:1], cut + 1), ends


def _width(points: Float, r: Float, first: Index, last: Index) -> Float:
    """Metres across the line of sight; the edges lie halfway to the neighbouring beams."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    inner = np.abs(se2.wrap(angle[last] - angle[first]))
    outer = np.abs(se2.wrap(angle[last + 1] - angle[first - 1]))
    return np.asarray(0.5 * (inner + outer) * 0.5 * (r[first] + r[last]))
