"""Tracks of whatever looks like a person, from one scan to the next."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.em.tracker import pda
from stillmap.em.tracker.features import Features
from stillmap.em.tracker.options import TrackerOptions
from stillmap.objects import kalman
from stillmap.objects.kalman import Motion

Float = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_SEEN = 0.5  # probability that one of the features was its own
_CHANGED = 0.25  # the same of features that changed: of two legs, one stands


class Places(NamedTuple):
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

    def of(self, chosen: Mask) -> "Places":
        """Some of them."""
        c = chosen
        return Places(self.track[c], self.scan[c], self.xy[c], self.seen[c], self.changed[c])


class _Alive(NamedTuple):
    """K tracks that go on.

    Attributes:
        motion: where they are.
        track: (K,) their numbers.
        last: (K,) when each was last seen, seconds.
        seen, changed: (K,) of the present scan, see Places.
    """

    motion: Motion
    track: Index
    last: Float
    seen: Mask
    changed: Mask

    def of(self, chosen: Mask) -> "_Alive":
        motion, track, last, seen, changed = self
        rest = track[chosen], last[chosen], seen[chosen], changed[chosen]
        return _Alive(motion.of(chosen), *rest)


def people(found: Features, changed: Mask, seconds: Float, options: TrackerOptions) -> Places:
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


def _followed(found: Features, changed: Mask, seconds: Float, options: TrackerOptions) -> Places:
    """All tracks, whatever they are of."""
    of_scan = np.searchsorted(found.scan, np.arange(len(seconds) + 1))
    alive = _new(np.zeros((0, 2)), np.zeros(0, bool), 0, 0.0, options)
    born, before = 0, 0.0
    out = [_places(alive, 0)]
    for t, now in enumerate(seconds.tolist()):
        here = slice(of_scan[t], of_scan[t + 1])
        at, moving = found.xy[here], changed[here]
        alive = alive.of(now - alive.last <= options.lost)
        motion = kalman.predicted(alive.motion, now - before, options.acceleration)
        others = ~pda.gated(motion, at, options).any(axis=0)
        new = _new(at[others], moving[others], born, now, options)
        alive = _joined(_seen(alive, motion, at, moving, now, options), new)
        born, before = born + len(new.track), now
        out.append(_places(alive, t))
    return Places(*(np.concatenate(parts) for parts in zip(*out, strict=True)))


def _seen(
    alive: _Alive, motion: Motion, at: Float, changed: Mask, now: float, options: TrackerOptions
) -> _Alive:
    """Tracks as predicted, after the features (F, 2) of a scan."""
    beta = pda.weights(motion, at, options)
    seen = beta.sum(axis=1) >= _SEEN
    return _Alive(
        pda.updated(motion, at, beta, options.sigma),
        alive.track,
        np.where(seen, now, alive.last),
        seen,
        (beta * changed).sum(axis=1) >= _CHANGED,
    )


def _new(at: Float, changed: Mask, born: int, now: float, options: TrackerOptions) -> _Alive:
    """A track at each (N, 2), numbered from `born`."""
    n = len(at)
    motion = kalman.still(at, options.sigma, options.sigma_speed)
    return _Alive(motion, born + np.arange(n), np.full(n, now), np.ones(n, bool), changed)


def _joined(a: _Alive, b: _Alive) -> _Alive:
    """The tracks of both."""
    rest = (np.concatenate([p, q]) for p, q in zip(a[1:], b[1:], strict=True))
    return _Alive(kalman.joined(a.motion, b.motion), *rest)


def _places(alive: _Alive, scan: int) -> Places:
    scans = np.full(len(alive.track), scan)
    return Places(alive.track, scans, alive.motion.x, alive.seen, alive.changed)
