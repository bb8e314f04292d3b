"""Pieces of the way: when a robot was carried elsewhere, where it was put down.

What comes after is a piece by itself until places are seen again that were known before. Those are
looked for everywhere and in all directions, among the scans that look most alike; several scans
have to ask for the same place. A piece that nothing ties to the others is put beside them.
"""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.slam import loops
from stillmap.slam.loops import Candidate, Closure, Track
from stillmap.slam.scans import hits

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_ASKED = 12  # keyframes of a piece that are looked for
_ALIKE = 8  # places that each of them is compared with
_SAME_METRES, _SAME_RADIANS = 0.5, 0.1  # two answers are one within that
_AGREEING = 3  # keyframes that have to give it
_BINS = np.geomspace(0.3, 30.0, 25)  # m, of the ranges by which scans are compared
_BESIDE = 10.0  # m between pieces that nothing ties


def separated(travelled: Float, breaks: list[int], metres: float) -> Float:
    """(T,) metres travelled, with so many more at each break: nothing reaches across."""
    out = travelled.copy()
    for t in breaks:
        out[t:] += metres
    return out


def placed(track: Track, breaks: list[int]) -> tuple[Track, list[Closure], list[int]]:
    """Pieces where they belong, the closures that say so, and breaks after which nothing did."""
    ties, apart = list[Closure](), list[int]()
    poses = track.poses.copy()
    for first, last in itertools.pairwise([*breaks, len(poses)]):
        track = dataclasses.replace(track, poses=poses)
        agreed = _agreed(track, list(_attempts(track, first, last)))
        if agreed:
            poses[first:last] = _correction(track, agreed[0]) @ poses[first:last]
            ties += agreed
        else:
            poses[first:last] = _beside(track, first) @ poses[first:last]
            apart.append(first)
    return dataclasses.replace(track, poses=poses), ties, apart


def _attempts(track: Track, first: int, last: int) -> Iterator[Closure]:
    """Keyframes of a piece, each laid on the places before it that look most alike."""
    frames, options = track.keyframes, track.options
    piece = frames[(frames >= first) & (frames < last)]
    before = frames[frames < first]
    asked = piece[np.unique(np.linspace(0, len(piece) - 1, _ASKED).round().astype(int))]
    known = np.array([_signature(track, t) for t in before])
    grids = {}
    for later in asked.tolist():
        unlike = np.abs(known - _signature(track, later)).sum(axis=1)
        stretches = np.round(track.travelled[before] / options.stretch)
        for stretch in _best_of_each(stretches, unlike):
            if stretch not in grids:
                grids[stretch] = loops.local_map(track, stretch * options.stretch)
            same = np.flatnonzero(stretches == stretch)
            earlier = int(before[same[np.argmin(unlike[same])]])
            here = Candidate(earlier, later, np.eye(3), 0.0)
            sigma = options.reach / options.window, np.pi / options.window
            closure = loops.laid_on(track, grids[stretch], here, *sigma)
            if not closure.refused:
                yield closure


def _best_of_each(stretches: Float, unlike: Float) -> list[float]:
    """The stretches with the scans that look most alike, the best first, and the last one."""
    found = dict.fromkeys(stretches[np.argsort(unlike, kind="stable")].tolist())
    return list(dict.fromkeys([*list(found)[:_ALIKE], float(stretches[-1])]))


def _signature(track: Track, t: int) -> Float:
    """(24,) share of a scan's beams up to each range: it does not change when the robot turns."""
    scan = hits(track.recording, track.e, t)
    ranges = np.linalg.norm(scan.points, axis=1)
    reached = np.histogram(ranges, _BINS, weights=scan.weights)[0].cumsum()
    shares: Float = reached / max(float(reached[-1]), 1e-9)
    return shares


def _correction(track: Track, closure: Closure) -> Float:
    """(3, 3) by which a piece has to be moved for a closure to hold."""
    there = track.poses[closure.earlier] @ closure.T
    C: Float = there @ se2.inverse(track.poses[closure.later])
    return C


def _agreed(track: Track, closures: list[Closure]) -> list[Closure]:
    """The closures that put a piece to one place, the best one first; none if they do not agree."""
    best = list[Closure]()
    for closure in closures:
        C = _correction(track, closure)
        same = [c for c in closures if _is_same(track, C, c)]
        if len({c.later for c in same}) > len({c.later for c in best}):
            best = [closure, *(c for c in same if c is not closure)]
    asked = len({c.later for c in closures})
    agreeing = len({c.later for c in best})
    return best if agreeing >= max(_AGREEING, (asked + 1) // 2) else []


def _is_same(track: Track, correction: Float, closure: Closure) -> bool:
    there = track.poses[closure.earlier] @ closure.T
    d = se2.parameters(se2.inverse(correction @ track.poses[closure.later]) @ there)
    return bool(np.hypot(d[0], d[1]) < _SAME_METRES and abs(d[2]) < _SAME_RADIANS)


def _beside(track: Track, first: int) -> Float:
    """(3, 3) that moves what comes from scan `first` on to the right of all that was before."""
    reach = np.array(
        [
            np.linalg.norm(hits(track.recording, track.e, t).points, axis=1).max(initial=0.0)
            for t in track.keyframes.tolist()
        ]
    )
    x, is_new = track.poses[track.keyframes, 0, 2], track.keyframes >= first
    right = (x + reach)[~is_new].max()
    left = (x - reach)[is_new].min()
    return se2.matrix(right - left + _BESIDE, 0.0, 0.0)
