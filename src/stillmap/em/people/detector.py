"""Legs and bodies in scans: narrow things that stand before something farther away.

Which features stand where shortly before or after there was nothing.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.em.observations import Chunk, iter_chunks
from stillmap.em.options import TrackerOptions

Float = NDArray[np.float64]

Index = NDArray[np.intp]

_NOTHING = 1e6  # m, range of a beam that met nothing: farther than anything


@dataclass(frozen=True, eq=False)
class Detections:
    """F narrow things, in the order of the scans.

    Attributes:
        scan: (F,) which scan shows them.
        xy: (F, 2) mean of their end points, metres in the map frame.
        width: (F,) metres across the line of sight.
    """

    scan: Index
    xy: Float
    width: Float


def detect_segments(
    recording: Recording, T_map_sensor: Float, options: TrackerOptions
) -> Detections:
    """What may be a leg or a body in any scan.

    Args:
        recording: 2D; the beams of a scan in the order of their angles, unusable ones are skipped.
        T_map_sensor: (T, 3, 3).
        options: see TrackerOptions.

    A segment runs from one jump of range to the next. It is a feature if it is neither too narrow
    nor too wide and its neighbours on both sides lie farther away: what ends where something
    nearer hides the rest has an unknown width, and so has what a scan begins or ends with.
    """
    parts = [_of_chunk(recording, chunk, options) for chunk in iter_chunks(recording)]
    if not parts:
        return Detections(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0))
    found = Detections(*(np.concatenate([getattr(p, n) for p in parts]) for n in _FIELDS))
    T = T_map_sensor[found.scan]
    xy = (T[:, :2, :2] * found.xy[:, None]).sum(axis=-1) + T[:, :2, 2]
    return Detections(found.scan, xy, found.width)


_FIELDS = ("scan", "xy", "width")


def ranges(points: Float, hit: NDArray[np.bool_]) -> Float:
    """(N,) metres to end points (N, 2); what met nothing is farther away than anything."""
    return np.where(hit, np.hypot(*points.T), _NOTHING)


def _of_chunk(recording: Recording, chunk: Chunk, options: TrackerOptions) -> Detections:
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
    return Detections(scan[first], xy, width[chosen])


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


_BEAMS = 3  # next to a place in bearing: one alone may pass a thing by

_ASIDE = 0.1  # rad by which they may miss it


def find_changed(
    recording: Recording, T_map_sensor: Float, found: Detections, look: float, behind: float
) -> NDArray[np.bool_]:
    """(F,) whether the same laser saw through a feature's place a while before, or after.

    Args:
        recording: 2D.
        T_map_sensor: (T, 3, 3).
        found: features in the map frame.
        look: seconds between the two scans at least; the nearest such scan counts.
        behind: metres behind a place at which a beam has passed it.
    """
    out = np.zeros(len(found.scan), bool)
    of_scan = np.searchsorted(found.scan, np.arange(recording.n_scans + 1))
    compared = _compared(recording, look)
    for t in recording.iter_scans(range(recording.n_scans)):
        here = slice(of_scan[t], of_scan[t + 1])
        if here.start == here.stop:
            continue
        for other in compared[t]:
            out[here] |= _seen_through(
                recording, other, T_map_sensor[other], found.xy[here], behind
            )
    return out


def _compared(recording: Recording, look: float) -> list[list[int]]:
    """The scans of the same laser before and after each scan that it is compared with."""
    out: list[list[int]] = [[] for _ in range(recording.n_scans)]
    away = round(1e9 * look)
    for sensor in np.unique(recording.sensor):
        scans = np.flatnonzero(recording.sensor == sensor)
        stamps = recording.stamp_ns[scans]
        before = np.searchsorted(stamps, stamps - away, side="right") - 1
        after = np.searchsorted(stamps, stamps + away)
        for t, i, j in zip(scans.tolist(), before.tolist(), after.tolist(), strict=True):
            out[t] = [int(scans[k]) for k in (i, j) if 0 <= k < len(scans)]
    return out


def _seen_through(
    recording: Recording, scan: int, T_map_sensor: Float, xy: Float, behind: float
) -> NDArray[np.bool_]:
    """(F,) whether all the beams of a scan nearest to places (F, 2) in bearing end behind them."""
    beams = recording.beams_of(scan)
    points = recording.points[beams].astype(np.float64)
    usable = np.isfinite(points).all(axis=1)
    if np.count_nonzero(usable) < _BEAMS:
        return np.zeros(len(xy), bool)
    points, r = points[usable], ranges(points, recording.hit[beams])[usable]
    away = xy - T_map_sensor[:2, 2]
    place = (away[:, :, None] * T_map_sensor[:2, :2]).sum(axis=1)
    angle = np.arctan2(points[:, 1], points[:, 0])
    turn = np.arctan2(place[:, 1], place[:, 0])[:, None] - angle
    aside = np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi)
    nearest = np.argsort(aside, axis=1, kind="stable")[:, :_BEAMS]
    close = np.take_along_axis(aside, nearest, axis=1).max(axis=1) <= _ASIDE
    return np.asarray(close & (r[nearest].min(axis=1) > np.hypot(*place.T) + behind))
