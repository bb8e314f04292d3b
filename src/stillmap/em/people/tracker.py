"""Tracks of whatever looks like a person, from one scan to the next.

The beams that end in the boxes around people.

Probabilistic data association of many tracks at once.

Bar-Shalom and Fortmann, *Tracking and Data Association* (1988), for one track. Where tracks compete
for a feature its weight is shared as in R. J. Fitzgerald, *Development of practical PDA logic for
multitarget tracking by microprocessor* (ACC 1986), instead of by joint events over all tracks.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import kalman
from stillmap.core.arrays import iter_blocks
from stillmap.core.kalman import TrackStates
from stillmap.core.recording import Recording
from stillmap.em.options import TrackerOptions
from stillmap.em.people.detector import Detections, detect_segments, find_changed

Index = NDArray[np.intp]

Mask = NDArray[np.bool_]

Float = NDArray[np.float64]


def gate(motion: TrackStates, at: Float, options: TrackerOptions) -> NDArray[np.bool_]:
    """(K, F) which features at (F, 2) may be of which track."""
    away = at[None] - motion.x[:, None]
    S = motion.P[:, 0] + options.sigma**2
    return np.asarray((away**2).sum(axis=-1) <= options.gate**2 * S[:, None])


def association_probabilities(motion: TrackStates, at: Float, options: TrackerOptions) -> Float:
    """(K, F) probability that a feature is the one of a track; the rest of a row: none is.

    Args:
        motion: K tracks as predicted.
        at: (F, 2) features, metres in the map frame.
        options: see TrackerOptions.
    """
    away = at[None] - motion.x[:, None]
    S = (motion.P[:, 0] + options.sigma**2)[:, None]
    density = np.exp(-0.5 * (away**2).sum(axis=-1) / S) / (2.0 * np.pi * S)
    G = np.where(gate(motion, at, options), options.detection * density, 0.0)
    in_gate = 1.0 - np.exp(-0.5 * options.gate**2)
    none = options.clutter * (1.0 - options.detection * in_gate)
    return np.asarray(G / (G.sum(axis=1, keepdims=True) + G.sum(axis=0) - G + none))


def update_pda(motion: TrackStates, at: Float, beta: Float, sigma: float) -> TrackStates:
    """After a scan: moved by the mean innovation, less sure by how far innovations spread.

    Args:
        motion: K tracks as predicted.
        at: (F, 2) features.
        beta: (K, F) of `weights`.
        sigma: metres, of a feature beside its person.
    """
    away = at[None] - motion.x[:, None]
    xx, xv, vv = motion.P.T
    S = xx + sigma**2
    gain_x, gain_v = xx / S, xv / S
    mean = (beta[..., None] * away).sum(axis=1)
    squares = (beta * (away**2).sum(axis=-1)).sum(axis=1) - (mean**2).sum(axis=-1)
    # both axes share one covariance, so the spread is that of the mean axis
    less = beta.sum(axis=1) * S - 0.5 * squares
    P = np.stack(
        [xx - gain_x**2 * less, xv - gain_x * gain_v * less, vv - gain_v**2 * less], axis=-1
    )
    return TrackStates(motion.x + gain_x[:, None] * mean, motion.v + gain_v[:, None] * mean, P)


_SEEN = 0.5  # probability that one of the features was its own

_CHANGED = 0.25  # the same of features that changed: of two legs, one stands


class Tracks(NamedTuple):
    """Where tracks were, in the order of the scans; L entries.

    Attributes:
        track: (L,) numbers from 0.
        scan: (L,) when.
        xy: (L, 2) metres in the map frame.
        seen: (L,) whether the scan showed it.
        changed: (L,) whether it showed it where shortly there was nothing.
    """

    track: Index
    scan: Index
    xy: Float
    seen: Mask
    changed: Mask

    def of(self, chosen: Mask) -> "Tracks":
        """Some of them."""
        c = chosen
        return Tracks(self.track[c], self.scan[c], self.xy[c], self.seen[c], self.changed[c])


class _Alive(NamedTuple):
    """K tracks that go on.

    Attributes:
        motion: where they are.
        track: (K,) their numbers.
        last: (K,) when each was last seen, seconds.
        seen, changed: (K,) of the present scan, see Places.
    """

    motion: TrackStates
    track: Index
    last: Float
    seen: Mask
    changed: Mask

    def of(self, chosen: Mask) -> "_Alive":
        motion, track, last, seen, changed = self
        rest = track[chosen], last[chosen], seen[chosen], changed[chosen]
        return _Alive(motion.select(chosen), *rest)


def track_people(
    found: Detections, changed: Mask, seconds: Float, options: TrackerOptions
) -> Tracks:
    """The tracks that turned out to be of people, over all of their life.

    Args:
        found: F features in the map frame.
        changed: (F,) which of them stand where shortly there was nothing.
        seconds: (T,) when each scan was taken, not falling.
        options: see TrackerOptions.

    Whether a track is a person's is known from how far it went, looking back over its life: what
    an online filter drops only from then on is dropped from the start. A track ends where it was
    last seen.
    """
    places = _followed(found, changed, seconds, options)
    n = int(places.track.max(initial=-1)) + 1
    start, way, last = np.zeros((n, 2)), np.zeros(n), np.full(n, -1)
    start[places.track[::-1]] = places.xy[::-1]  # the first of each wins
    at = places.of(places.seen)
    np.maximum.at(way, at.track, np.hypot(*(at.xy - start[at.track]).T))
    np.maximum.at(last, at.track, at.scan)
    scans = np.bincount(at.track, minlength=n)
    moving = np.bincount(at.track, at.changed, n) >= options.changed * scans
    person = (way >= options.moved) & (scans >= options.least) & moving
    return places.of(person[places.track] & (places.scan <= last[places.track]))


def _followed(found: Detections, changed: Mask, seconds: Float, options: TrackerOptions) -> Tracks:
    """All tracks, whatever they are of."""
    of_scan = np.searchsorted(found.scan, np.arange(len(seconds) + 1))
    alive = _new(np.zeros((0, 2)), np.zeros(0, bool), 0, 0.0, options)
    born, before = 0, 0.0
    out = [_places(alive, 0)]
    for t, now in enumerate(seconds.tolist()):
        here = slice(of_scan[t], of_scan[t + 1])
        at, moving = found.xy[here], changed[here]
        alive = alive.of(now - alive.last <= options.lost)
        motion = kalman.predict(alive.motion, now - before, options.acceleration)
        others = ~gate(motion, at, options).any(axis=0)
        new = _new(at[others], moving[others], born, now, options)
        alive = _joined(_seen(alive, motion, at, moving, now, options), new)
        born, before = born + len(new.track), now
        out.append(_places(alive, t))
    return Tracks(*(np.concatenate(parts) for parts in zip(*out, strict=True)))


def _seen(
    alive: _Alive,
    motion: TrackStates,
    at: Float,
    changed: Mask,
    now: float,
    options: TrackerOptions,
) -> _Alive:
    """Tracks as predicted, after the features (F, 2) of a scan."""
    beta = association_probabilities(motion, at, options)
    seen = beta.sum(axis=1) >= _SEEN
    return _Alive(
        update_pda(motion, at, beta, options.sigma),
        alive.track,
        np.where(seen, now, alive.last),
        seen,
        (beta * changed).sum(axis=1) >= _CHANGED,
    )


def _new(at: Float, changed: Mask, born: int, now: float, options: TrackerOptions) -> _Alive:
    """A track at each (N, 2), numbered from `born`."""
    n = len(at)
    motion = kalman.initialize(at, options.sigma, options.sigma_speed)
    return _Alive(motion, born + np.arange(n), np.full(n, now), np.ones(n, bool), changed)


def _joined(a: _Alive, b: _Alive) -> _Alive:
    """The tracks of both."""
    rest = (np.concatenate([p, q]) for p, q in zip(a[1:], b[1:], strict=True))
    return _Alive(kalman.concatenate(a.motion, b.motion), *rest)


def _places(alive: _Alive, scan: int) -> Tracks:
    scans = np.full(len(alive.track), scan)
    return Tracks(alive.track, scans, alive.motion.x, alive.seen, alive.changed)


def label_people(recording: Recording, poses: Float, options: TrackerOptions) -> NDArray[np.bool_]:
    """(M,) which hits lie in the box of somebody who is tracked.

    Args:
        recording: 2D.
        poses: (T, 3, 3) T_map_base.
        options: see TrackerOptions.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    seconds = np.asarray(1e-9 * (recording.stamp_ns - recording.stamp_ns[:1]), np.float64)
    found = detect_segments(recording, T_map_sensor, options)
    moving = find_changed(recording, T_map_sensor, found, options.look, options.jump)
    somebody = track_people(found, moving, seconds, options)
    return find_beams_in_boxes(recording, T_map_sensor, somebody, options.box)


def find_beams_in_boxes(
    recording: Recording, T_map_sensor: Float, somebody: Tracks, half: float
) -> NDArray[np.bool_]:
    """(M,) which hits lie in boxes, along the axes of the map, `half` m to each side of people."""
    inside = recording.allocate_per_beam(np.bool_)
    for block in iter_blocks(inside):
        inside[block] = False
    scans, first = np.unique(somebody.scan, return_index=True)
    bounds = np.append(first, len(somebody.scan))
    for n, t in enumerate(recording.iter_scans(scans.tolist(), inside)):
        begin, end = bounds[n : n + 2]
        beams = recording.beams_of(t)
        T = T_map_sensor[t]
        xy = (T[:2, :2] * recording.points[beams][:, None]).sum(axis=-1) + T[:2, 2]
        away = np.abs(xy[:, None] - somebody.xy[begin:end]).max(axis=-1)
        inside[beams] = (away <= half).any(axis=1) & recording.hit[beams]
    return inside
