"""Hits that movers explain: a mover followed over several lengths moved in every detection.

Where a car occludes the road behind it whenever a place is seen, the cells alone take its side for
a wall. Its path shows that it was there at these times: only hits at other times are evidence of
the place itself. Walkers explain hits as well if their tracks certainly are of movers.
"""

from collections.abc import Container, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.recording import Recording
from stillmap.core.square_box import cell_keys
from stillmap.em.mixture import log_beta
from stillmap.mapping.labelled_recording import LabelledRecording
from stillmap.tracking.association import ACCELERATION
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.detections import compute_centroids, iterate_tracks
from stillmap.tracking.mover_path import MoverPath, smooth_track
from stillmap.tracking.objects import SMOOTHER_STD, estimate_center_offset

_ROUNDS = 100  # of EM at most
_TOLERANCE = 1e-6  # of the share, at which EM ends
_MIN_SHARE = 1e-4  # of either class
_MAX_LOG_ODDS = 50.0


def fit_share(log_ratio: Float, weight: Float) -> Float:
    """(K,) probability of the first class, its share fitted by EM.

    Args:
        log_ratio: (K,) nats, log likelihood ratio of the first class to the second.
        weight: (K,) of each member in the share.
    """
    share, p = 0.5, np.full(len(log_ratio), 0.5)
    for _ in range(_ROUNDS):
        p = compute_probability(log_ratio + np.log(share / (1.0 - share)))
        last, share = share, float((np.sum(weight * p) + 1.0) / (np.sum(weight) + 2.0))
        share = min(max(share, _MIN_SHARE), 1.0 - _MIN_SHARE)
        if abs(share - last) < _TOLERANCE:
            break
    return p


def compute_probability(log_odds: Float) -> Float:
    """(K,) 1 / (1 + e^-x)."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -_MAX_LOG_ODDS, _MAX_LOG_ODDS))))


_MARGIN, _MARGIN_OF_WALKERS = 0.15, 0.1  # m around the box, the circle: chairs are near walkers
PLACE = 0.25  # m, of a place
_STRAY = 19.0  # Beta(1, 19): share of the hits outside, of places that only movers were in


class MoverHits(NamedTuple):
    """Hits within the boxes of vehicles and the circles of walkers.

    Attributes:
        beam: (n,) rising.
        path: (n,) whose box it is.
        p_mover: (n,) probability that this is a mover.
    """

    beam: Index
    path: Index
    p_mover: Float


def explain_hits(known: LabelledRecording, on_movers: MoverHits, is_vehicle: Bool) -> Float32:
    """(M,) P(static), lower for beams that ended on movers.

    Of the m + n hits of a place, m are explained by movers and n not. Where something static
    stands, the share n / (m + n) may be any; where only movers were, it is small: stray hits. How
    much stands where vehicles drive is learned from the hits on all of them; beside people, who
    keep to chairs and walls, either is as probable before any hit.

    Args:
        known: 2D, M beams, with places as cells.
        on_movers: from `find_mover_hits`.
        is_vehicle: (K,) the paths of vehicles.
    """
    beam, path, weight = on_movers
    if not len(beam):
        return known.p_static
    places, place = np.unique(cell_keys(known.end_cells(beam)), return_inverse=True)
    explained = np.bincount(place, weight, minlength=len(places)).astype(np.float64)
    others = _static_hits(known, places)
    others -= np.bincount(place, np.nan_to_num(known.p_static[beam]), minlength=len(places))
    log_ratio = compute_log_ratio(explained, np.maximum(others, 0.0))
    on_vehicle = is_vehicle[path]
    by_vehicles = np.bincount(place, weight * on_vehicle, minlength=len(places)).astype(np.float64)
    of_vehicles, of_walkers = fit_share(log_ratio, by_vehicles), compute_probability(log_ratio)
    p_place = np.where(on_vehicle, of_vehicles[place], of_walkers[place])
    out = known.copy_labels()
    out[beam] *= (1.0 - weight * (1.0 - p_place)).astype(np.float32)
    return out


def compute_log_ratio(explained: Float, others: Float) -> Float:
    """(P,) nats, log likelihood ratio of something static in a place to movers alone.

    Args:
        explained, others: (P,) hits within boxes and at other times.
    """
    log_mover = log_beta(others + 1.0, explained + _STRAY) - log_beta(1.0, _STRAY)
    return log_beta(others + 1.0, explained + 1.0) - log_mover


def _place_boxes(seconds: Float, paths: Sequence[MoverPath]) -> tuple[Index, Index, Float, Float]:
    """Boxes of K paths in all of their scans, rising: which scan (R,), path, center, heading."""
    scans = [np.arange(*path.scans(seconds)) for path in paths]
    states = [path.state_at(seconds[some]) for path, some in zip(paths, scans, strict=True)]
    xy, velocity = (np.concatenate(column) for column in zip(*states, strict=True))
    scan = np.concatenate(scans)
    path = np.repeat(np.arange(len(paths)), [len(some) for some in scans])
    order = np.argsort(scan, kind="stable")
    heading = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    heading[~heading.any(axis=1)] = (1.0, 0.0)  # of what stands, any
    return scan[order], path[order], xy[order], heading[order]


def find_mover_hits(
    recording: Recording, poses: Float, seconds: Float, paths: Sequence[MoverPath], p_mover: Float
) -> MoverHits:
    """The hits within the boxes of what is followed.

    Args:
        recording: 2D, M beams.
        poses: (T, 3, 3) T_map_base.
        seconds: (T,) times of the scans.
        paths: K, of what is followed.
        p_mover: (K,) probability that each is of a mover.
    """
    if not len(paths):
        return MoverHits(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0))
    scan, number, center, heading = _place_boxes(seconds, paths)
    is_round = np.array([path.is_round for path in paths])
    half = 0.5 * np.array([(path.length, path.width) for path in paths])
    half += np.where(is_round, _MARGIN_OF_WALKERS, _MARGIN)[:, None]
    begins = np.flatnonzero(np.diff(scan, prepend=-1))
    rows = np.split(np.arange(len(scan)), begins[1:])
    hits = []
    T_map_sensor = recording.T_map_sensor(poses)
    for k in recording.iter_scans(range(len(rows))):
        row, t = rows[k], int(scan[rows[k][0]])
        of_scan = recording.beams_of(t)
        beam = of_scan.start + np.flatnonzero(recording.hit[of_scan])
        xy = recording.points[beam] @ T_map_sensor[t, :2, :2].T + T_map_sensor[t, :2, 2]
        off, u, size = xy[:, None] - center[row], heading[row], half[number[row]]
        inside = np.abs((off * u).sum(axis=-1)) <= size[:, 0]
        inside &= np.abs(off[..., 1] * u[:, 0] - off[..., 0] * u[:, 1]) <= size[:, 1]
        inside &= ~is_round[number[row]] | ((off**2).sum(axis=-1) <= size[:, 0] ** 2)
        weights = inside * p_mover[number[row]]
        likeliest = weights.argmax(axis=1)
        weight = weights[np.arange(len(beam)), likeliest]
        kept = weight > 0.0
        hits.append((beam[kept], number[row[likeliest[kept]]], weight[kept]))
    return MoverHits(*(np.concatenate(column) for column in zip(*hits, strict=True)))


def _static_hits(known: LabelledRecording, places: Int64) -> Float:
    """(P,) expected number of static hits in each place."""
    out = np.zeros(len(places))
    for hits in known.iter_hits():
        beam = hits[~np.isnan(known.p_static[hits])]
        key = cell_keys(known.end_cells(beam))
        at = np.minimum(np.searchsorted(places, key), len(places) - 1)
        is_at = places[at] == key
        out += np.bincount(at[is_at], known.p_static[beam[is_at]], minlength=len(places))
    return out


_MIN_P_MOVER = 0.99  # what explains hits must be certain: clutter would make more of itself
_WIDTH = 0.5  # m, of a person
_MIN_TRAVEL, _MIN_DETECTIONS = 1.5, 5  # m, several times that; detections


def iterate_walker_paths(
    points: DynamicPoints, owner: Index, p_mover: Float, others: Container[int]
) -> Iterator[tuple[int, MoverPath]]:
    """Yield tracks that are certainly movers and went somewhere, and their paths.

    Args:
        points: dynamic end points.
        owner: (N,) their tracks.
        p_mover: (K,) by track.
        others: tracks that are left out.
    """
    for track, here in iterate_tracks(points, owner):
        if track in others or p_mover[track] <= _MIN_P_MOVER:
            continue
        centroids = compute_centroids(points, owner, here)
        scan, xy = centroids.scan, centroids.xy
        if len(scan) < _MIN_DETECTIONS or np.linalg.norm(np.ptp(xy, axis=0)) < _MIN_TRAVEL:
            continue
        at = np.searchsorted(scan, points.scan[here])
        center = xy + estimate_center_offset(xy, points.sensor[scan], points.xy[here], at)
        t = points.seconds[scan]
        smooth = smooth_track(t, center, SMOOTHER_STD, ACCELERATION)
        yield track, MoverPath(t, *smooth, _WIDTH, _WIDTH, is_round=True)
