"""Tracklet stitching: merge tracks of parts of one object, join tracks across occlusions."""

from collections.abc import Iterator, Sequence

import numpy as np

from stillmap.core import arrays
from stillmap.core.array_types import Bool, Float, Index
from stillmap.core.square_box import component_labels
from stillmap.em.people_tracker import MIN_TRACK_SCANS
from stillmap.tracking import detections
from stillmap.tracking.association import HORIZON, regress_velocity
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.detections import Centroids
from stillmap.tracking.fast_movers import tracks_of_paths
from stillmap.tracking.joins import Detections, join_pieces
from stillmap.tracking.mover_path import MoverPath

NO_PIECE = -1
_NEAR = 0.6  # m between the centroids of two tracks: less than between people who pass
_MAX_DURATION = 3.0  # s: who stays together for longer keeps his track
_MAX_PAUSE = 0.41  # s within one encounter
_MAX_GAP = 0.5  # s within a piece
_CLAIM = 0.6  # m from a path to its points
_REACH = 1.0  # s by which a path extends at constant velocity
_REST_TIME = 0.3  # s, see regress_velocity


def cut_tracks(centroids: Centroids, seconds: Float, whole: Index) -> Index:
    """(L,) numbers of the pieces that centroids are of, rising; -1 in encounters.

    Args:
        centroids: of all tracks.
        seconds: (T,) times of the scans.
        whole: tracks that are not cut.
    """
    t, may_be_cut = seconds[centroids.scan], ~np.isin(centroids.track, whole)
    near = np.zeros(len(t), bool)
    near[detections.find_near_pairs(centroids.scan, centroids.xy, _NEAR).ravel()] = True
    near = _select_short_runs(np.flatnonzero(near & may_be_cut), centroids.track, t)
    begins = np.diff(centroids.track, prepend=-1) != 0
    begins |= np.diff(near, prepend=False)
    begins |= (np.diff(t, prepend=t[:1]) > _MAX_GAP) & may_be_cut
    pieces = np.cumsum(begins & ~near) - 1
    return np.where(near, NO_PIECE, pieces)


def _select_short_runs(at: Index, track: Index, t: Float) -> Bool:
    """(L,) which centroids lie within encounters; `at` (n,) are near others."""
    last = np.diff(track[at], append=-1) != 0
    last |= np.diff(t[at], append=np.inf) > _MAX_PAUSE
    first = np.roll(last, 1)
    low, high = at[first], at[last]
    short = t[high] - t[low] <= _MAX_DURATION
    steps = np.zeros(len(t) + 1, np.intp)
    steps[low[short]] += 1
    steps[high[short] + 1] -= 1
    return np.asarray(np.cumsum(steps[:-1]) > 0)


def assign_to_paths(
    points: DynamicPoints, rest: Index, centroids: Centroids, mover: Index
) -> Index:
    """(n,) the mover whose path is nearest to each of some points, -1: none.

    Args:
        points: dynamic end points.
        rest: (n,) indices of points, rising.
        centroids: (L,) centroids outside of encounters.
        mover: (L,) whose they are.
    """
    scan, out = points.scan[rest], np.full(len(rest), -1)
    best = np.full(len(rest), _CLAIM**2)
    for number, t, xy in _iterate_paths(centroids, mover, points.seconds):
        reach = np.searchsorted(points.seconds, [t[0] - _REACH, t[-1] + _REACH])
        low, high = np.searchsorted(scan, reach).tolist()
        if low == high:
            continue
        here = slice(low, high)
        squared = points.xy[rest[here]] - _locate(points.seconds[scan[here]], t, xy)
        distance = (squared**2).sum(axis=1)
        nearer = np.flatnonzero(distance < best[here]) + low
        best[nearer], out[nearer] = distance[nearer - low], number
    return out


def _iterate_paths(
    centroids: Centroids, mover: Index, seconds: Float
) -> Iterator[tuple[int, Float, Float]]:
    """Yield each mover with its times and positions."""
    order = np.lexsort((centroids.scan, mover))
    cuts = np.flatnonzero(np.diff(mover[order])) + 1
    for part in np.split(order, cuts) if len(order) else []:
        yield int(mover[part[0]]), seconds[centroids.scan[part]], centroids.xy[part]


def _locate(seconds: Float, t: Float, xy: Float) -> Float:
    """(n, 2) positions at times (n,) on the path through (L, 2) at (L,)."""
    out = np.stack([np.interp(seconds, t, column) for column in xy.T], axis=-1)
    for outside, end, near in (
        (seconds < t[0], 0, t <= t[0] + HORIZON),
        (seconds > t[-1], -1, t >= t[-1] - HORIZON),
    ):
        if outside.any():
            velocity = regress_velocity(t[near], xy[near], _REST_TIME)
            out[outside] += (seconds[outside] - t[end])[:, None] * velocity
    return out


_MIN_DURATION = 0.6  # s from the first to the last detection of a confirmed track
_PAIR_DISTANCE = 0.55  # m between two tracks that always move together: legs
_MIN_SHARED = 0.7  # share of the shorter one's scans in which they do


def stitch_tracklets(
    points: DynamicPoints, owner: Index, paths: Sequence[MoverPath] = ()
) -> tuple[Index, Float]:
    """Track numbers (N,) after stitching, -1: of no confirmed track, and P(identity) (K,) of each.

    Args:
        points: dynamic end points.
        owner: (N,) track numbers from `assign_tracks`.
        paths: of fast movers: they are not cut.
    """
    owner, p_identity = join_tracklets(points, owner, paths)
    return _confirm(points, owner), p_identity


def join_tracklets(
    points: DynamicPoints, owner: Index, paths: Sequence[MoverPath] = ()
) -> tuple[Index, Float]:
    """Track numbers (N,) after parts of one object were joined, at one time and across gaps.

    Args and the second value: see `stitch_tracklets`.
    """
    owner = _merge_pairs(points, owner)
    fast = np.array(tracks_of_paths(points, owner, list(paths)), np.intp)
    centroids = detections.collect_centroids(points, owner)
    piece = cut_tracks(centroids, points.seconds, fast)
    own = np.flatnonzero(piece >= 0)
    outside, piece_of = Centroids._make(column[own] for column in centroids), piece[own]
    n = int(piece.max(initial=-1)) + 1
    is_fast = np.zeros(n, bool)
    is_fast[piece_of] = np.isin(outside.track, fast)
    width = detections.measure_widths(points, outside)
    of_pieces = Detections(piece_of, points.seconds[outside.scan], outside.xy, width)
    mover, p_identity = join_pieces(of_pieces, is_fast, points.period)
    # who is near others all the time keeps his track
    number = n + centroids.track
    number[own] = mover[piece_of]
    out = _number_points(points, owner, centroids, number)
    parts = [np.flatnonzero(out[block] >= n) + block.start for block in arrays.iter_blocks(out)]
    rest = np.concatenate([np.zeros(0, np.intp), *parts])
    nearest = assign_to_paths(points, rest, outside, mover[piece_of])
    out[rest[nearest >= 0]] = nearest[nearest >= 0]
    return out, np.append(p_identity, np.ones(detections.count_tracks(owner)))


def _number_points(
    points: DynamicPoints, owner: Index, centroids: Centroids, number: Index
) -> Index:
    """(N,) the numbers (L,) of the centroids that points are part of."""
    out = arrays.empty(owner.shape, np.intp, points.scratch)
    scans = len(points.seconds)
    key = centroids.track * scans + centroids.scan  # rising
    for block in arrays.iter_blocks(owner, out):
        out[block] = number[np.searchsorted(key, owner[block] * scans + points.scan[block])]
    return out


def _merge_pairs(points: DynamicPoints, owner: Index) -> Index:
    """Merge tracks that always move together, nearer than people do: legs tracked apart."""
    parts, scans = list[tuple[Index, Index]](), np.zeros(detections.count_tracks(owner), np.intp)
    for here in detections.scan_blocks(points, owner):
        centroids = detections.compute_centroids(points, owner, here)
        near = detections.find_near_pairs(centroids.scan, centroids.xy, _PAIR_DISTANCE)
        pairs = np.sort(centroids.track[near], axis=1)
        parts.append(np.unique(pairs, axis=0, return_counts=True))
        scans += np.bincount(centroids.track, minlength=len(scans))
    all_pairs, counts = (np.concatenate(column) for column in zip(*parts, strict=True))
    tracks, which = np.unique(all_pairs, axis=0, return_inverse=True)
    if len(tracks) == 0:
        return owner
    count = np.zeros(len(tracks), np.intp)
    np.add.at(count, which.reshape(-1), counts)
    together = count >= _MIN_SHARED * scans[tracks].min(axis=1)
    label = component_labels(tracks[together], len(scans))
    _, first, which = np.unique(label, return_index=True, return_inverse=True)
    merged = first[which]
    return detections.renumber(points, owner, lambda old: merged[old])


def _confirm(points: DynamicPoints, owner: Index) -> Index:
    """Set the points of tracks that are too short to -1."""
    n = detections.count_tracks(owner)
    if n == 0:
        return owner
    scans, first, last = np.zeros(n, np.intp), np.full(n, np.inf), np.full(n, -np.inf)
    for here in detections.scan_blocks(points, owner):
        centroids = detections.compute_centroids(points, owner, here)
        scans += np.bincount(centroids.track, minlength=n)
        np.minimum.at(first, centroids.track, points.seconds[centroids.scan])
        np.maximum.at(last, centroids.track, points.seconds[centroids.scan])
    duration = np.subtract(last, first, out=np.zeros(n), where=scans > 0)
    confirmed = (scans >= MIN_TRACK_SCANS) & (duration >= _MIN_DURATION)
    return detections.renumber(
        points, owner, lambda old: np.where((old >= 0) & confirmed[old], old, -1)
    )
