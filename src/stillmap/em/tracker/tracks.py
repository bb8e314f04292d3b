"""Tracks of whatever looks like a person, from one scan to the next."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillmap.em.tracker import pda
from stillmap.em.tracker.features import Features
from stillmap.em.tracker.options import TrackerOptions
from stillmap.objects import kalman
from stillmap.objects.kalman import Motion

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_SEEN = 0.5  # probability that one of the features was its own


@dataclass(frozen=True, eq=False)
class Places:
    """Where tracks were, in the order of the scans; L entries.

    Attributes:
        track: (L,) numbers from 0.
        scan: (L,) when.
        xy: (L, 2) metres in the map frame.
        sigma: (L,) standard deviation of that on either axis, metres.
        seen: (L,) whether the scan showed it.
    """

    track: Index
    scan: Index
    xy: Float
    sigma: Float
    seen: NDArray[np.bool_]

    def of(self, chosen: NDArray[np.bool_]) -> "Places":
        """Some of them."""
        return Places(*(getattr(self, name)[chosen] for name in _FIELDS))


_FIELDS = ("track", "scan", "xy", "sigma", "seen")


@dataclass(frozen=True, eq=False)
class _Alive:
    """K tracks that go on, with their numbers and the time in s when each was last seen."""

    motion: Motion
    track: Index
    last: Float

    def of(self, chosen: NDArray[np.bool_]) -> "_Alive":
        return _Alive(self.motion.of(chosen), self.track[chosen], self.last[chosen])


def people(found: Features, seconds: Float, options: TrackerOptions) -> Places:
    """The tracks that turned out to be of people, over all of their life.

    Args:
        found: features in the map frame.
        seconds: (T,) when each scan was taken, not falling.
        options: see TrackerOptions.

    Whether a track is a person's is known from how far it went, looking back over its life: what
    an online filter drops only from then on is dropped from the start. A track ends where it was
    last seen.
    """
    places = _followed(found, seconds, options)
    n = int(places.track.max(initial=-1)) + 1
    start, way = np.zeros((n, 2)), np.zeros(n)
    start[places.track[::-1]] = places.xy[::-1]  # the first of each wins
    at = places.of(places.seen)
    np.maximum.at(way, at.track, np.hypot(*(at.xy - start[at.track]).T))
    last = np.full(n, -1)
    np.maximum.at(last, at.track, at.scan)
    person = (way >= options.moved) & (np.bincount(at.track, minlength=n) >= options.least)
    return places.of(person[places.track] & (places.scan <= last[places.track]))


def _followed(found: Features, seconds: Float, options: TrackerOptions) -> Places:
    """All tracks, whatever they are of."""
    nobody = np.zeros(0)
    alive = _Alive(kalman.still(np.zeros((0, 2)), 1.0, 1.0), nobody.astype(np.intp), nobody)
    of_scan = np.searchsorted(found.scan, np.arange(len(seconds) + 1))
    born, out = 0, []
    for t, now in enumerate(seconds):
        at = found.xy[of_scan[t] : of_scan[t + 1]]
        alive, seen = _stepped(alive, at, seconds[t - 1] if t else now, now, options)
        born_here = at[~seen.of_tracks]
        alive = _joined(alive, born_here, born, now, options)
        born += len(born_here)
        if len(alive.track):
            seen_now = np.append(seen.tracks, np.ones(len(born_here), bool))
            scan = np.full(len(alive.track), t)
            out.append(Places(alive.track, scan, alive.motion.x, alive.motion.sigma, seen_now))
    if not out:
        whole = np.zeros(0, np.intp)
        return Places(whole, whole, np.zeros((0, 2)), nobody, np.zeros(0, bool))
    return Places(*(np.concatenate([getattr(p, name) for p in out]) for name in _FIELDS))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Which tracks (K,) a scan shows, and which features (F,) lie in the gate of any."""

    tracks: NDArray[np.bool_]
    of_tracks: NDArray[np.bool_]


def _stepped(
    alive: _Alive, at: Float, before: float, now: float, options: TrackerOptions
) -> tuple[_Alive, _Seen]:
    """Tracks after the features (F, 2) of a scan, without those that nobody has seen for long."""
    alive = alive.of(now - alive.last <= options.lost)
    motion = kalman.predicted(alive.motion, now - before, options.acceleration)
    beta = pda.weights(motion, at, options)
    seen = beta.sum(axis=1) >= _SEEN
    after = pda.updated(motion, at, beta, options.sigma)
    of_tracks = np.asarray(pda.gated(motion, at, options).any(axis=0))
    last = np.where(seen, now, alive.last)
    return replace(alive, motion=after, last=last), _Seen(seen, of_tracks)


def _joined(alive: _Alive, at: Float, born: int, now: float, options: TrackerOptions) -> _Alive:
    """With a new track at each (N, 2), numbered from `born`."""
    new = kalman.still(at, options.sigma, options.sigma_speed)
    numbers = born + np.arange(len(at))
    return _Alive(
        kalman.joined(alive.motion, new),
        np.append(alive.track, numbers),
        np.append(alive.last, np.full(len(at), now)),
    )
