"""Detection of people in 2D scans: narrow segments in front of something farther away."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.chunks import Chunk, iter_chunks
from stillmap.core.recording import Recording
from stillmap.em.types import Float

Index = NDArray[np.intp]

_NO_RETURN_RANGE = 1e6  # m, farther than any return
_RANGE_JUMP = 0.3  # m between neighbouring beams that separates segments
_MIN_SEGMENT_WIDTH, _MAX_SEGMENT_WIDTH = 0.05, 0.65  # m, from a leg to a body
_BACKGROUND_INTERVAL = 2.0  # s between scans in which a person has left its place
_NEAREST_BEAMS = 3  # next to a position in bearing: one alone may pass a thing by
_MAX_BEARING_ERROR = 0.1  # rad between these and the position


@dataclass(frozen=True, eq=False)
class Detections:
    """F segments that may be legs or bodies, in the order of the scans.

    Attributes:
        scan: (F,) index of the scan.
        xy: (F, 2) mean of the end points, metres in the map frame.
        width: (F,) metres across the line of sight.
    """

    scan: Index
    xy: Float
    width: Float


def detect_segments(recording: Recording, T_map_sensor: Float) -> Detections:
    """Detects segments that may be legs or bodies.

    Args:
        recording: 2D; beams of a scan in the order of their angles, unusable ones are skipped.
        T_map_sensor: (T, 3, 3).

    A segment runs from one jump of range to the next. It is kept if its width is that of a leg or
    a body and its neighbours on both sides lie farther away: the width of what is partly occluded,
    or cut by the field of view, is unknown.
    """
    parts = [_detect_in_chunk(recording, chunk) for chunk in iter_chunks(recording)]
    scan, xy, width = (
        np.concatenate(column)
        for column in zip(
            (np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0)), *parts, strict=True
        )
    )
    T = T_map_sensor[scan]
    xy = (T[:, :2, :2] * xy[:, None]).sum(axis=-1) + T[:, :2, 2]
    return Detections(scan, xy, width)


def _ranges(points: Float, hit: NDArray[np.bool_]) -> Float:
    """(N,) metres to end points (N, 2); beams without a return are farther than all others."""
    return np.where(hit, np.hypot(*points.T), _NO_RETURN_RANGE)


def _detect_in_chunk(recording: Recording, chunk: Chunk) -> tuple[Index, Float, Float]:
    """Scans, positions in the sensor frame, and widths of the segments of some scans."""
    scan = np.repeat(np.arange(chunk.scans.start, chunk.scans.stop), np.diff(chunk.offset))
    points = recording.points[chunk.beams].astype(np.float64)
    usable = np.isfinite(points).all(axis=1)
    scan, points, hit = scan[usable], points[usable], recording.hit[chunk.beams][usable]
    r = _ranges(points, hit)
    first, last = _segments(r)
    inner = (first > 0) & (last < len(r) - 1) & hit[first]
    first, last = first[inner], last[inner]
    before, after = first - 1, last + 1
    whole = (scan[before] == scan[first]) & (scan[after] == scan[first])
    nearer = (r[before] > r[first]) & (r[after] > r[last])
    width, extent = _widths(points, r, first, last), np.hypot(*(points[last] - points[first]).T)
    narrow = (width >= _MIN_SEGMENT_WIDTH) & (np.maximum(width, extent) <= _MAX_SEGMENT_WIDTH)
    chosen = whole & nearer & narrow
    first, last = first[chosen], last[chosen]
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(points, axis=0)])
    xy = (sums[last + 1] - sums[first]) / (last + 1 - first)[:, None]
    return scan[first], xy, width[chosen]


def _segments(r: Float) -> tuple[Index, Index]:
    """First and last beam of every run without a jump of range; runs may span scans."""
    cut = np.flatnonzero(np.abs(np.diff(r)) > _RANGE_JUMP)
    ends = np.append(cut, np.arange(len(r))[-1:])  # none without beams
    return np.append(np.zeros(len(ends), np.intp)[:1], cut + 1), ends


def _widths(points: Float, r: Float, first: Index, last: Index) -> Float:
    """Metres across the line of sight; the edges lie halfway to the neighbouring beams."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    inner = np.abs(se2.wrap(angle[last] - angle[first]))
    outer = np.abs(se2.wrap(angle[last + 1] - angle[first - 1]))
    return np.asarray(0.5 * (inner + outer) * 0.5 * (r[first] + r[last]))


def find_changed(
    recording: Recording, T_map_sensor: Float, detections: Detections
) -> NDArray[np.bool_]:
    """(F,) detections whose position the same laser saw free two seconds before or after.

    Args:
        recording: 2D.
        T_map_sensor: (T, 3, 3).
        detections: F, in the map frame.
    """
    out = np.zeros(len(detections.scan), bool)
    of_scan = np.searchsorted(detections.scan, np.arange(recording.n_scans + 1))
    compared = _compared_scans(recording)
    for t in recording.iter_scans(range(recording.n_scans)):
        here = slice(of_scan[t], of_scan[t + 1])
        if here.start == here.stop:
            continue
        for other in compared[t]:
            out[here] |= _is_free(recording, other, T_map_sensor[other], detections.xy[here])
    return out


def _compared_scans(recording: Recording) -> list[list[int]]:
    """For each scan the scans of the same laser that it is compared with."""
    out: list[list[int]] = [[] for _ in range(recording.n_scans)]
    interval = round(1e9 * _BACKGROUND_INTERVAL)
    for sensor in np.unique(recording.sensor):
        scans = np.flatnonzero(recording.sensor == sensor)
        stamps = recording.stamp_ns[scans]
        before = np.searchsorted(stamps, stamps - interval, side="right") - 1
        after = np.searchsorted(stamps, stamps + interval)
        for t, i, j in zip(scans.tolist(), before.tolist(), after.tolist(), strict=True):
            out[t] = [int(scans[k]) for k in (i, j) if 0 <= k < len(scans)]
    return out


def _is_free(recording: Recording, scan: int, T_map_sensor: Float, xy: Float) -> NDArray[np.bool_]:
    """(F,) whether all beams of a scan nearest to positions (F, 2) in bearing end behind them."""
    beams = recording.beams_of(scan)
    points = recording.points[beams].astype(np.float64)
    usable = np.isfinite(points).all(axis=1)
    if np.count_nonzero(usable) < _NEAREST_BEAMS:
        return np.zeros(len(xy), bool)
    points, r = points[usable], _ranges(points, recording.hit[beams])[usable]
    offset = xy - T_map_sensor[:2, 2]
    position = (offset[:, :, None] * T_map_sensor[:2, :2]).sum(axis=1)
    angle = np.arctan2(points[:, 1], points[:, 0])
    turn = np.arctan2(position[:, 1], position[:, 0])[:, None] - angle
    error = np.abs(se2.wrap(turn))
    nearest = np.argsort(error, axis=1, kind="stable")[:, :_NEAREST_BEAMS]
    close = np.take_along_axis(error, nearest, axis=1).max(axis=1) <= _MAX_BEARING_ERROR
    return np.asarray(close & (r[nearest].min(axis=1) > np.hypot(*position.T) + _RANGE_JUMP))
