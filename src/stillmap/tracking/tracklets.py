"""Tracklet stitching: merge tracks of parts of one object, join tracks across occlusions."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.components import component_labels
from stillmap.em.people_tracker import MIN_TRACK_SCANS
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.detections import (
    Centroids,
    collect_centroids,
    compute_centroids,
    count_tracks,
    find_near_pairs,
    measure_widths,
    renumber,
    scan_blocks,
)
from stillmap.tracking.encounters import assign_to_paths, cut_tracks
from stillmap.tracking.fast_movers import tracks_of_paths
from stillmap.tracking.joins import Looks, join_pieces
from stillmap.tracking.mover_path import MoverPath

Float = NDArray[np.float64]
Index = NDArray[np.intp]

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
    found = collect_centroids(points, owner)
    piece = cut_tracks(found, points.seconds, fast)
    own = np.flatnonzero(piece >= 0)
    outside, piece_of = Centroids._make(column[own] for column in found), piece[own]
    n = int(piece.max(initial=-1)) + 1
    is_fast = np.zeros(n, bool)
    is_fast[piece_of] = np.isin(outside.track, fast)
    width = measure_widths(points, outside)
    looks = Looks(piece_of, points.seconds[outside.scan], outside.xy, width)
    mover, p_identity = join_pieces(looks, is_fast, points.period)
    # who is near others all the time keeps his track
    number = n + found.track
    number[own] = mover[piece_of]
    out = _number_points(points, owner, found, number)
    parts = [np.flatnonzero(out[block] >= n) + block.start for block in arrays.iter_blocks(out)]
    rest = np.concatenate([np.zeros(0, np.intp), *parts])
    nearest = assign_to_paths(points, rest, outside, mover[piece_of])
    out[rest[nearest >= 0]] = nearest[nearest >= 0]
    return out, np.append(p_identity, np.ones(count_tracks(owner)))


def _number_points(points: DynamicPoints, owner: Index, found: Centroids, number: Index) -> Index:
    """(N,) the numbers (L,) of the centroids that points are part of."""
    out = arrays.empty(owner.shape, np.intp, points.scratch)
    scans = len(points.seconds)
    key = found.track * scans + found.scan  # rising
    for block in arrays.iter_blocks(owner, out):
        out[block] = number[np.searchsorted(key, owner[block] * scans + points.scan[block])]
    return out


def _merge_pairs(points: DynamicPoints, owner: Index) -> Index:
    """Merge tracks that always move together, nearer than people do: legs tracked apart."""
    parts, scans = list[tuple[Index, Index]](), np.zeros(count_tracks(owner), np.intp)
    for here in scan_blocks(points, owner):
        found = compute_centroids(points, owner, here)
        pairs = np.sort(found.track[find_near_pairs(found.scan, found.xy, _PAIR_DISTANCE)], axis=1)
        parts.append(np.unique(pairs, axis=0, return_counts=True))
        scans += np.bincount(found.track, minlength=len(scans))
    tracks, which = np.unique(
        np.concatenate([pairs for pairs, _ in parts]), axis=0, return_inverse=True
    )
    if len(tracks) == 0:
        return owner
    count = np.zeros(len(tracks), np.intp)
    np.add.at(count, which.reshape(-1), np.concatenate([count for _, count in parts]))
    together = count >= _MIN_SHARED * scans[tracks].min(axis=1)
    label = component_labels(tracks[together], len(scans))
    _, first, which = np.unique(label, return_index=True, return_inverse=True)
    merged = first[which]
    return renumber(points, owner, lambda old: merged[old])


def _confirm(points: DynamicPoints, owner: Index) -> Index:
    """Set the points of tracks that are too short to -1."""
    n = count_tracks(owner)
    if n == 0:
        return owner
    scans, first, last = np.zeros(n, np.intp), np.full(n, np.inf), np.full(n, -np.inf)
    for here in scan_blocks(points, owner):
        found = compute_centroids(points, owner, here)
        scans += np.bincount(found.track, minlength=n)
        np.minimum.at(first, found.track, points.seconds[found.scan])
        np.maximum.at(last, found.track, points.seconds[found.scan])
    duration = np.subtract(last, first, out=np.zeros(n), where=scans > 0)
    confirmed = (scans >= MIN_TRACK_SCANS) & (duration >= _MIN_DURATION)
    return renumber(points, owner, lambda old: np.where((old >= 0) & confirmed[old], old, -1))
