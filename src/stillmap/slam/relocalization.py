"""Pieces of the way: when a robot was carried elsewhere, where it was put down.

What comes after is a piece by itself until places are seen again that were known before. Those are
looked for everywhere and in all directions, among the scans that look most alike; then the whole
piece has to fit there. A piece that nothing ties to the others is put beside them.
"""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.slam import loop_verification, motion_model, scan_matching
from stillmap.slam.loop_types import LoopCandidate, LoopClosure, LoopContext
from stillmap.slam.scan_matching import add_scan, select_hits

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_ASKED = 20  # keyframes of a piece that are looked for
_HEARD = 60  # keyframes of it that are asked whether they fit where it would be
_OUTWEIGH = 4  # keyframes that fit, for each that contradicts
_ALIKE = 8  # places that each of them is compared with
_SAME_METRES, _SAME_RADIANS = 0.5, 0.1  # two answers are one within that
_AGREEING = 3  # keyframes that have to fit
_BINS = np.geomspace(0.3, 30.0, 25)  # m, of the ranges by which scans are compared
_BESIDE = 10.0  # m between pieces that nothing ties


def separate_segments(travelled: Float, breaks: list[int], metres: float) -> Float:
    """(T,) metres travelled, with so many more at each break: nothing reaches across."""
    out = travelled.copy()
    for t in breaks:
        out[t:] += metres
    return out


def relocalize_segments(
    track: LoopContext, breaks: list[int], nowhere: list[int]
) -> tuple[LoopContext, list[LoopClosure], list[int]]:
    """Pieces where they belong, the closures that say so, and breaks after which nothing did.

    Args:
        track: where loops are looked for.
        breaks: first scans of the pieces but for the first.
        nowhere: those of them that fit nowhere around; the others stay where they fit if nothing
            else is found.
    """
    ties, apart = list[LoopClosure](), list[int]()
    poses = track.poses.copy()
    for first, last in itertools.pairwise([*breaks, len(poses)]):
        track = dataclasses.replace(track, poses=poses)
        agreed = _agreed(track, list(_attempts(track, first, last)), first, last)
        if agreed:
            poses[first:last] = _correction(track, agreed[0]) @ poses[first:last]
            ties += agreed
        elif first in nowhere:
            poses[first:last] = _beside(track, first) @ poses[first:last]
            apart.append(first)
    return dataclasses.replace(track, poses=poses), ties, apart


def _attempts(track: LoopContext, first: int, last: int) -> Iterator[LoopClosure]:
    """Keyframes of a piece, each laid on the places before it that look most alike."""
    frames, options = track.keyframes, track.options
    piece = frames[(frames >= first) & (frames < last)]
    before = frames[frames < first]
    known = np.array([_signature(track, t) for t in before])
    grids = {}
    for later in _evenly(piece, _ASKED):
        unlike = np.abs(known - _signature(track, later)).sum(axis=1)
        stretches = np.round(track.travelled[before] / options.stretch)
        for stretch in _best_of_each(stretches, unlike):
            if stretch not in grids:
                grids[stretch] = loop_verification.build_submap(track, stretch * options.stretch)
            same = np.flatnonzero(stretches == stretch)
            earlier = int(before[same[np.argmin(unlike[same])]])
            here = LoopCandidate(earlier, later, np.eye(3), 0.0)
            sigma = options.reach / options.window, np.pi / options.window
            closure = loop_verification.verify_candidate(track, grids[stretch], here, *sigma)
            if not closure.refused:
                yield closure


def _best_of_each(stretches: Float, unlike: Float) -> list[float]:
    """The stretches with the scans that look most alike, the best first, and the last one."""
    found = dict.fromkeys(stretches[np.argsort(unlike, kind="stable")].tolist())
    return list(dict.fromkeys([*list(found)[:_ALIKE], float(stretches[-1])]))


def _signature(track: LoopContext, t: int) -> Float:
    """(24,) share of a scan's beams up to each range: it does not change when the robot turns."""
    scan = select_hits(track.recording, track.e, t)
    ranges = np.linalg.norm(scan.points, axis=1)
    reached = np.histogram(ranges, _BINS, weights=scan.weights)[0].cumsum()
    shares: Float = reached / max(float(reached[-1]), 1e-9)
    return shares


def _correction(track: LoopContext, closure: LoopClosure) -> Float:
    """(3, 3) by which a piece has to be moved for a closure to hold."""
    there = track.poses[closure.earlier] @ closure.T
    C: Float = there @ se2.inverse(track.poses[closure.later])
    return C


def _agreed(
    track: LoopContext, closures: list[LoopClosure], first: int, last: int
) -> list[LoopClosure]:
    """The closures that put a piece where most of it fits what was seen before; or none.

    Rooms look alike: what a place says counts only if the rest of the piece does not contradict it.
    """
    best, most = list[LoopClosure](), 0
    before = _map_before(track, first)
    for closure in _one_of_each(track, closures):
        C = _correction(track, closure)
        fitting, contradicting = _support(track, before, C, first, last)
        if fitting >= max(_AGREEING, _OUTWEIGH * contradicting) and fitting > most:
            best, most = [c for c in closures if _is_same(track, C, c)], fitting
    return best


def _one_of_each(track: LoopContext, closures: list[LoopClosure]) -> list[LoopClosure]:
    """One closure for each place that a piece may be at."""
    kept = list[LoopClosure]()
    for closure in closures:
        if not any(_is_same(track, _correction(track, other), closure) for other in kept):
            kept.append(closure)
    return kept


def _map_before(track: LoopContext, first: int) -> _core.OccupancyGrid2D:
    grid = _core.OccupancyGrid2D(track.resolution, track.registration.approach)
    before = track.keyframes[track.keyframes < first].tolist()
    for t in track.recording.iter_scans(before, track.e):
        add_scan(grid, track.recording, track.e, t, track.poses[t], track.surface)
    return grid


def _support(
    track: LoopContext, before: _core.OccupancyGrid2D, C: Float, first: int, last: int
) -> tuple[int, int]:
    """Keyframes of a piece that fit a map when it is moved by C (3, 3), and that contradict it."""
    frames = track.keyframes[(track.keyframes >= first) & (track.keyframes < last)]
    fitting = contradicting = 0
    for t in _evenly(frames, _HEARD):
        scan = select_hits(track.recording, track.e, t)
        prior = motion_model.gaussian_prior(C @ track.poses[t], _SAME_METRES, _SAME_RADIANS)
        start = prior.T_map_base
        found = scan_matching.search_pose(before, scan, prior, track.registration, 0.0, 0.0, start)
        if scan_matching.occluded_share(before, scan, found) > track.registration.through:
            contradicting += 1
        elif found.explained >= track.options.accept_above:
            fitting += 1
    return fitting, contradicting


def _evenly(frames: Index, most: int) -> list[int]:
    """At most so many of them, evenly spread."""
    which = np.unique(np.linspace(0, len(frames) - 1, most).round().astype(int))
    out: list[int] = frames[which].tolist()
    return out


def _is_same(track: LoopContext, correction: Float, closure: LoopClosure) -> bool:
    there = track.poses[closure.earlier] @ closure.T
    d = se2.parameters(se2.inverse(correction @ track.poses[closure.later]) @ there)
    return bool(np.hypot(d[0], d[1]) < _SAME_METRES and abs(d[2]) < _SAME_RADIANS)


def _beside(track: LoopContext, first: int) -> Float:
    """(3, 3) that moves what comes from scan `first` on to the right of all that was before."""
    reach = np.array(
        [
            np.linalg.norm(select_hits(track.recording, track.e, t).points, axis=1).max(initial=0.0)
            for t in track.keyframes.tolist()
        ]
    )
    x, is_new = track.poses[track.keyframes, 0, 2], track.keyframes >= first
    right = (x + reach)[~is_new].max()
    left = (x - reach)[is_new].min()
    return se2.matrix(right - left + _BESIDE, 0.0, 0.0)
