"""Tracking of people by probabilistic data association (PDA), and the beams on them: a baseline.

After D. Haehnel, D. Schulz, W. Burgard, *Map Building with Mobile Robots in Populated
Environments*, IROS 2002; docs/estimator.md has it in short.

Bar-Shalom and Fortmann, *Tracking and Data Association* (1988), for one track. Where tracks compete
for a detection its weight is shared as in R. J. Fitzgerald, *Development of practical PDA logic for
multitarget tracking by microprocessor* (ACC 1986), instead of by joint events over all tracks.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stillmap.core import kalman, se2
from stillmap.core.array_types import Bool, Float, Index
from stillmap.core.arrays import iter_blocks
from stillmap.core.chunks import Chunk, iter_chunks
from stillmap.core.kalman import TrackStates
from stillmap.core.recording import Recording

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
    none = (np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0))
    scan, xy, width = (np.concatenate(column) for column in zip(none, *parts, strict=True))
    T = T_map_sensor[scan]
    xy = (T[:, :2, :2] * xy[:, None]).sum(axis=-1) + T[:, :2, 2]
    return Detections(scan, xy, width)


def _ranges(points: Float, hit: Bool) -> Float:
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


def find_changed(recording: Recording, T_map_sensor: Float, detections: Detections) -> Bool:
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
        for scan in compared[t]:
            out[here] |= _is_free(recording, scan, T_map_sensor[scan], detections.xy[here])
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


def _is_free(recording: Recording, scan: int, T_map_sensor: Float, xy: Float) -> Bool:
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


_DETECTION_STD = 0.1  # m, of a detection from the middle of its person: legs swing
_ACCELERATION = 0.5  # m2/s3, spectral density of random acceleration
_GATE = 2.5  # standard deviations within which detections may belong to a track
_P_DETECTION = 0.9  # of a person in sight
_CLUTTER = 0.05  # false detections per m2
_MAX_MISSED = 1.0  # s without a detection after which a track is terminated

_MIN_P_OBSERVED = 0.5  # probability that one of the detections belongs to the track
_MIN_P_CHANGED = 0.25  # the same of changed detections: of two legs, one stands

_MIN_DISPLACEMENT = 0.5  # m from its start that confirms a track as a person
_MIN_CHANGED_SHARE = 0.2  # of the scans, in which a person's position was free shortly before
MIN_TRACK_SCANS = 4  # with detections
_HALF_BOX = 0.4  # m to each side of a person within which beams are dynamic


class Tracks(NamedTuple):
    """Positions of tracks, in the order of the scans; L entries.

    Attributes:
        track: (L,) numbers from 0.
        scan: (L,) index of the scan.
        xy: (L, 2) metres in the map frame.
        observed: (L,) whether the scan has a detection of it.
        changed: (L,) whether it has one where shortly before or after the position was free.
    """

    track: Index
    scan: Index
    xy: Float
    observed: Bool
    changed: Bool

    def select(self, chosen: Bool) -> "Tracks":
        """Some of the entries."""
        return Tracks._make(column[chosen] for column in self)


class _ActiveTracks(NamedTuple):
    """K tracks that go on.

    Attributes:
        states: filtered states.
        track: (K,) numbers.
        last_seconds: (K,) when each was last observed.
        observed, changed: (K,) in the present scan, see Tracks.
    """

    states: TrackStates
    track: Index
    last_seconds: Float
    observed: Bool
    changed: Bool

    def select(self, chosen: Bool) -> "_ActiveTracks":
        rest = (column[chosen] for column in self[1:])
        return _ActiveTracks._make([self.states.select(chosen), *rest])


def gate(states: TrackStates, xy: Float) -> Bool:
    """(K, F) detections (F, 2) within the gate of each predicted track."""
    innovation = xy[None] - states.x[:, None]
    S = states.P[:, 0] + _DETECTION_STD**2
    return np.asarray((innovation**2).sum(axis=-1) <= _GATE**2 * S[:, None])


def association_probabilities(states: TrackStates, xy: Float) -> Float:
    """(K, F) probability that a detection belongs to a track; the rest of a row: none does.

    Args:
        states: K predicted tracks.
        xy: (F, 2) detections, metres in the map frame.
    """
    innovation = xy[None] - states.x[:, None]
    S = (states.P[:, 0] + _DETECTION_STD**2)[:, None]
    density = np.exp(-0.5 * (innovation**2).sum(axis=-1) / S) / (2.0 * np.pi * S)
    G = np.where(gate(states, xy), _P_DETECTION * density, 0.0)
    p_gate = 1.0 - np.exp(-0.5 * _GATE**2)
    none = _CLUTTER * (1.0 - _P_DETECTION * p_gate)
    return np.asarray(G / (G.sum(axis=1, keepdims=True) + G.sum(axis=0) - G + none))


def update_pda(states: TrackStates, xy: Float, beta: Float) -> TrackStates:
    """PDA update: the mean innovation moves a track, the spread of innovations widens it.

    Args:
        states: K predicted tracks.
        xy: (F, 2) detections.
        beta: (K, F) association probabilities.
    """
    innovation = xy[None] - states.x[:, None]
    xx, xv, vv = states.P.T
    S = xx + _DETECTION_STD**2
    gain_x, gain_v = xx / S, xv / S
    mean = (beta[..., None] * innovation).sum(axis=1)
    spread = (beta * (innovation**2).sum(axis=-1)).sum(axis=1) - (mean**2).sum(axis=-1)
    # both axes share one covariance, so the spread is that of the mean axis
    less = beta.sum(axis=1) * S - 0.5 * spread
    columns = xx - gain_x**2 * less, xv - gain_x * gain_v * less, vv - gain_v**2 * less
    P = np.stack(columns, axis=-1)
    return TrackStates(states.x + gain_x[:, None] * mean, states.v + gain_v[:, None] * mean, P)


def track_people(detections: Detections, changed: Bool, seconds: Float) -> Tracks:
    """The tracks of people, each from its start to its last detection.

    Args:
        detections: F in the map frame.
        changed: (F,) those where shortly before or after the position was free.
        seconds: (T,) time of each scan, not falling.

    A track is a person's if it moves away from its start. It is confirmed looking back: what an
    online filter drops only from then on is dropped from the start.
    """
    tracks = _track_all(detections, changed, seconds)
    n = int(tracks.track.max(initial=-1)) + 1
    start, displacement, last = np.zeros((n, 2)), np.zeros(n), np.full(n, -1)
    start[tracks.track[::-1]] = tracks.xy[::-1]  # the first of each wins
    at = tracks.select(tracks.observed)
    np.maximum.at(displacement, at.track, np.hypot(*(at.xy - start[at.track]).T))
    np.maximum.at(last, at.track, at.scan)
    scans = np.bincount(at.track, minlength=n)
    moving = np.bincount(at.track, at.changed, n) >= _MIN_CHANGED_SHARE * scans
    person = (displacement >= _MIN_DISPLACEMENT) & (scans >= MIN_TRACK_SCANS) & moving
    return tracks.select(person[tracks.track] & (tracks.scan <= last[tracks.track]))


def _track_all(detections: Detections, changed: Bool, seconds: Float) -> Tracks:
    """All tracks, of people or not."""
    of_scan = np.searchsorted(detections.scan, np.arange(len(seconds) + 1))
    active = _start_tracks(np.zeros((0, 2)), np.zeros(0, bool), 0, 0.0)
    n_tracks, before = 0, 0.0
    out = [_entries(active, 0)]
    for t, now in enumerate(seconds.tolist()):
        here = slice(of_scan[t], of_scan[t + 1])
        xy, is_changed = detections.xy[here], changed[here]
        active = active.select(now - active.last_seconds <= _MAX_MISSED)
        predicted = kalman.predict(active.states, now - before, _ACCELERATION)
        unassigned = ~gate(predicted, xy).any(axis=0)
        new = _start_tracks(xy[unassigned], is_changed[unassigned], n_tracks, now)
        active = _concatenate(_update_tracks(active, predicted, xy, is_changed, now), new)
        n_tracks, before = n_tracks + len(new.track), now
        out.append(_entries(active, t))
    return Tracks(*(np.concatenate(columns) for columns in zip(*out, strict=True)))


def _update_tracks(
    active: _ActiveTracks, predicted: TrackStates, xy: Float, changed: Bool, now: float
) -> _ActiveTracks:
    """Predicted tracks after the detections (F, 2) of a scan."""
    beta = association_probabilities(predicted, xy)
    observed = beta.sum(axis=1) >= _MIN_P_OBSERVED
    return _ActiveTracks(
        update_pda(predicted, xy, beta),
        active.track,
        np.where(observed, now, active.last_seconds),
        observed,
        (beta * changed).sum(axis=1) >= _MIN_P_CHANGED,
    )


def _start_tracks(xy: Float, changed: Bool, first_number: int, now: float) -> _ActiveTracks:
    """A new track at each detection (N, 2)."""
    n = len(xy)
    states = kalman.initialize(xy, _DETECTION_STD)
    numbers = first_number + np.arange(n)
    return _ActiveTracks(states, numbers, np.full(n, now), np.ones(n, bool), changed)


def _concatenate(a: _ActiveTracks, b: _ActiveTracks) -> _ActiveTracks:
    rest = (np.concatenate([p, q]) for p, q in zip(a[1:], b[1:], strict=True))
    return _ActiveTracks(kalman.concatenate(a.states, b.states), *rest)


def _entries(active: _ActiveTracks, scan: int) -> Tracks:
    scans = np.full(len(active.track), scan)
    return Tracks(active.track, scans, active.states.x, active.observed, active.changed)


def label_people(recording: Recording, poses: Float) -> Bool:
    """(M,) hits within the box of a tracked person.

    Args:
        recording: 2D.
        poses: (T, 3, 3) T_map_base.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    seconds = np.asarray(1e-9 * (recording.stamp_ns - recording.stamp_ns[:1]), np.float64)
    detections = detect_segments(recording, T_map_sensor)
    changed = find_changed(recording, T_map_sensor, detections)
    return find_beams_in_boxes(recording, T_map_sensor, track_people(detections, changed, seconds))


def find_beams_in_boxes(recording: Recording, T_map_sensor: Float, tracks: Tracks) -> Bool:
    """(M,) hits within boxes around tracks, along the axes of the map."""
    inside = recording.allocate_per_beam(np.bool_)
    for block in iter_blocks(inside):
        inside[block] = False
    scans, first = np.unique(tracks.scan, return_index=True)
    bounds = np.append(first, len(tracks.scan))
    for n, t in enumerate(recording.iter_scans(scans.tolist(), inside)):
        begin, end = bounds[n : n + 2]
        beams = recording.beams_of(t)
        T = T_map_sensor[t]
        xy = (T[:2, :2] * recording.points[beams][:, None]).sum(axis=-1) + T[:2, 2]
        distance = np.abs(xy[:, None] - tracks.xy[begin:end]).max(axis=-1)
        inside[beams] = (distance <= _HALF_BOX).any(axis=1) & recording.hit[beams]
    return inside
