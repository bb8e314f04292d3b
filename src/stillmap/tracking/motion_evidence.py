"""Motion evidence: the probability that what a track follows is a mover, not clutter.

Furniture that some views hit and others pass (legs of chairs, edges, thin stands, under a scan
plane that tilts) resembles a mover in each of its cells. Over a track it does not: it goes nowhere,
beams pass its place between two detections, it appears and vanishes in plain view. The share of
movers among the tracks is learned from each recording by EM: where many people walk, one that
stands is believed to be another; where nobody walks, it is not. Then movers explain all hits on
them (`explained_hits.py`). See `docs/objects.md`.
"""

import itertools
from collections.abc import Iterator, Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from stillmap.core import arrays
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.core.square_box import group_indices
from stillmap.em.mixture import log_beta
from stillmap.em.shape_evidence import find_lost_beams
from stillmap.mapping import MoverPoints
from stillmap.mapping.labelled_recording import LabelledRecording
from stillmap.tracking import explained_hits
from stillmap.tracking.association import MAX_GAP, assign_tracks, regress_velocity
from stillmap.tracking.clustering import DynamicPoints, extract_dynamic_points
from stillmap.tracking.detections import compute_centroids, count_steady_windows, iterate_tracks
from stillmap.tracking.fast_movers import find_fast_movers, tracks_of_paths
from stillmap.tracking.mover_path import MoverPath
from stillmap.tracking.tracklets import join_tracklets

Places = tuple[Index, Float]  # scans (n,) and positions (n, 2) of one track

_MIN_P_DYNAMIC = 0.5  # of the beams that are judged
_VIEW_TIME = 0.1  # s: views nearer in time say the same
_MAX_JUMP = 1.0  # m between two detections at one place
_EDGE_TIME, _EDGE_VIEWS = 1.0, 8  # s before the first and after the last detection; views there
_OPEN_SHARE = 0.28  # of these views that pass: the end lies in plain view
_REST_TIME = 0.3  # s, see regress_velocity
_FAST_TRAVEL = 3.0  # m along the path of a fast mover that count as a window of steady motion
_MAX_LINE_SPREAD = 1.25  # times the noise, across a straight surface
_MIN_LINE, _MAX_SLIDE_SPEED = 0.75, 0.25  # m of it: people are less wide; m/s: they walk faster
_P_WALKS_ON_LINE = 0.01  # that end points on who walks spread as little: 4 tracks of nine runs
_BATCH = 1 << 12  # tracks whose places are classified at once
_DEPTH = 0.3  # m in front of and behind the place that count as the place
_HALF_WIDTH = 0.08  # m to either side, of a leg
_MAX_BEARING = 0.06  # rad to the nearest beam: farther off is out of view

# Beta(1, 15): share of the windows in which clutter seems to move; also of half of the movers
_STILL_WINDOWS = 15.0
_SEEN_SHARE = 19.0  # Beta(19, 1): share of the views that detect a mover in view
_THIN_HITS, _THIN = 3.0, (5.0, 3.0)  # hits per view below which half of the movers are thin: Beta
_CLUTTER = (1.0, 1.0)  # Beta: share of the views that detect clutter
_OPEN = 0.5  # nats against a mover, for each end in plain view


class TrackEvidence(NamedTuple):
    """Features of K tracks for the likelihood ratio of mover to clutter, each (K,).

    Attributes:
        detections: detections, at most one per 0.1 s.
        hits: end points per detection.
        missed: views between detections in which beams passed.
        windows, moving: windows of 1.5 s, one after the other, and those of steady motion.
        open_ends: 0 to 2, how many of its ends lie in plain view.
        slides: 1 if its end points lie on a line that is longer than a person is wide, along which
            it moves slower than people walk: the part of a wall that is labelled dynamic does so as
            the robot drives by; else 0.
    """

    detections: Float
    hits: Float
    missed: Float
    windows: Float
    moving: Float
    open_ends: Float
    slides: Float


def apply_motion_evidence(
    recording: Recording, poses: Float, p_static: Float32, noise_std: float
) -> tuple[Float32, MoverPoints]:
    """Labels of the beams, given what the tracks of the dynamic ones say.

    A beam is dynamic if its cell says so and its track does: 1 - e becomes (1 - e) P(mover). One
    that ended on somebody who is followed is dynamic as well, whatever its cell says, unless
    something static is there at other times.

    Args:
        recording: 2D, M beams, deskewed.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1) from the cells alone.
        noise_std: m, of end points from the surface that they are on.

    Returns:
        (M,) P(c = 1); the end points of tracks that are more probably movers, thinned.
    """
    points = extract_dynamic_points(recording, poses, p_static, _MIN_P_DYNAMIC)
    if not len(points.scan):
        return p_static, MoverPoints.none()
    owner, paths = find_fast_movers(points, assign_tracks(points, MAX_GAP))
    owner, _ = join_tracklets(points, owner, paths)
    fast = tracks_of_paths(points, owner, paths)
    of_fast = dict(zip(fast, paths, strict=True))
    p_mover, sliding = weigh_tracks(recording, poses, points, owner, noise_std, of_fast)
    out, movers = arrays.copy(p_static, recording.scratch), list[MoverPoints]()
    for block in arrays.iter_blocks(points.beam, points.xy, points.scan):
        p, beam = p_mover[owner[block]].astype(np.float32), points.beam[block]
        out[beam] = 1.0 - (1.0 - out[beam]) * p
        xy, stamp_ns = points.xy[block], recording.stamp_ns[points.scan[block]]
        movers.append(MoverPoints(xy[p > 0.5], stamp_ns[p > 0.5]).thin())
    walkers = dict(explained_hits.iterate_walker_paths(points, owner, p_mover, {*fast, *sliding}))
    tracks = np.array([*fast, *walkers], np.intp)
    of_path = np.where(tracks >= 0, p_mover[tracks], 0.0)
    followed = [*paths, *walkers.values()]
    on_movers = explained_hits.find_mover_hits(recording, poses, points.seconds, followed, of_path)
    is_vehicle = np.arange(len(followed)) < len(paths)
    known = LabelledRecording(recording, poses, out, explained_hits.PLACE)
    out = explained_hits.explain_hits(known, on_movers, is_vehicle)
    return out, MoverPoints.concatenate(movers)


def weigh_tracks(
    recording: Recording,
    poses: Float,
    points: DynamicPoints,
    owner: Index,
    noise_std: float,
    paths: Mapping[int, MoverPath] = MappingProxyType({}),
) -> tuple[Float, list[int]]:
    """(K,) P(mover) by track number, 0 where no track has that number; the tracks that slide.

    Args:
        recording, poses: see `apply_motion_evidence`.
        points: dynamic end points.
        owner: (N,) their tracks, from 0 to K - 1.
        noise_std: see `apply_motion_evidence`.
        paths: by track number, of fast movers.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    tracks, evidence = collect_evidence(recording, T_map_sensor, points, owner, noise_std)
    for k in np.flatnonzero(np.isin(tracks, list(paths))).tolist():
        moving = paths[int(tracks[k])].travel / _FAST_TRAVEL
        evidence.windows[k] = max(evidence.windows[k], moving)
        evidence.moving[k] = max(evidence.moving[k], moving)
        evidence.slides[k] = 0.0  # the side of a car is as straight
    out = np.zeros(int(tracks.max()) + 1)
    out[tracks] = explained_hits.fit_share(compute_log_ratio(evidence), evidence.detections)
    return out, tracks[evidence.slides > 0.0].tolist()


def compute_log_ratio(e: TrackEvidence) -> Float:
    """(K,) log likelihood ratio of mover to clutter, nats: motion + detection + open ends."""
    rest = e.windows - e.moving
    still = _log_mean_power(e.moving, rest, 1.0, _STILL_WINDOWS)
    motion = np.logaddexp(_log_mean_power(e.moving, rest, 1.0, 1.0), still) - np.log(2.0) - still
    motion = np.where(e.slides > 0.0, np.log(_P_WALKS_ON_LINE), motion)
    # the first detection began the track: it says nothing
    seen = np.maximum(e.detections - 1.0, 0.0)
    thick = _log_mean_power(seen, e.missed, _SEEN_SHARE, 1.0)
    thin = np.logaddexp(thick, _log_mean_power(seen, e.missed, *_THIN)) - np.log(2.0)
    detection = np.where(e.hits < _THIN_HITS, thin, thick)
    detection -= _log_mean_power(seen, e.missed, *_CLUTTER)
    return np.asarray(motion + detection - _OPEN * e.open_ends)


def _log_mean_power(successes: Float, failures: Float, a: float, b: float) -> Float:
    """(K,) ln of the mean of q^successes (1 - q)^failures over q from Beta(a, b)."""
    return log_beta(successes + a, failures + b) - log_beta(a, b)


def collect_evidence(
    recording: Recording, T_map_sensor: Float, points: DynamicPoints, owner: Index, noise_std: float
) -> tuple[Index, TrackEvidence]:
    """Track numbers (K,), rising, and what is known of each.

    Args:
        recording: 2D.
        T_map_sensor: (T, 3, 3) sensor poses.
        points, owner, noise_std: see `weigh_tracks`.
    """
    period = float(np.median(np.diff(points.seconds))) if len(points.seconds) > 1 else _VIEW_TIME
    stride = max(1, round(_VIEW_TIME / max(period, 1e-3)))
    parts, tracks = [], list[int]()
    pairs = iterate_tracks(points, owner)
    while batch := list(itertools.islice(pairs, _BATCH)):
        tracks += [track for track, _ in batch]
        rows, gaps, ends = [], list[Places](), list[Places]()
        for _, here in batch:
            centroids = compute_centroids(points, owner, here)
            detections, t = len(centroids.scan), points.seconds[centroids.scan]
            steady = count_steady_windows(t, centroids.xy, period)
            most = _MAX_SLIDE_SPEED * float(t[-1] - t[0])
            slides = lies_on_line(points.xy[here], noise_std, _MIN_LINE, most)
            rows.append((max(1.0, detections / stride), len(here) / detections, *steady, slides))
            gaps.append(_interpolate_gaps(points.seconds, centroids.scan, centroids.xy, stride))
            ends += _extrapolate_ends(points.seconds, centroids.scan, centroids.xy)
        missed = _count_passes(recording, T_map_sensor, gaps)
        sampled = np.array([len(scan) for scan, _ in ends])
        passed = _count_passes(recording, T_map_sensor, ends)
        is_open = (sampled > 1) & (passed >= _OPEN_SHARE * sampled)
        parts.append(np.column_stack([np.array(rows), missed, is_open.reshape(-1, 2).sum(axis=1)]))
    detections_, hits, windows, moving, slides, missed, open_ends = np.concatenate(parts).T
    evidence = TrackEvidence(detections_, hits, missed, windows, moving, open_ends, slides)
    return np.array(tracks), evidence


def lies_on_line(xy: Float, noise_std: float, least: float, most: float) -> bool:
    """True if points (n, 2) lie on a line, up to noise, that is from `least` to `most` m long."""
    off = xy - xy.mean(axis=0)
    _, axes = np.linalg.eigh(off.T @ off)
    across, along = (off @ axes).T
    is_thin = float(across.std()) <= _MAX_LINE_SPREAD * noise_std
    return is_thin and least <= float(np.ptp(along)) <= most


def _count_passes(recording: Recording, T_map_sensor: Float, places: list[Places]) -> Float:
    """(L,) views that passed, of L lists of places."""
    of = np.repeat(np.arange(len(places)), [len(scan) for scan, _ in places])
    scan, xy = (np.concatenate(column) for column in zip(*places, strict=True))
    visibility = _classify_visibility(recording, T_map_sensor, scan, xy)
    passed = (visibility == Visibility.PASSED).astype(np.float64)
    return np.asarray(np.bincount(of, passed, minlength=len(places)), np.float64)


def _interpolate_gaps(seconds: Float, scan: Index, xy: Float, stride: int) -> Places:
    """Scans without a detection between those with one (L,), every `stride`-th, and the places.

    Only between two detections at one place: of a track that has jumped the place is not known.
    """
    between = np.setdiff1d(np.arange(scan[0], scan[-1]), scan)[::stride]
    after = np.searchsorted(scan, between)
    between = between[np.linalg.norm(xy[after] - xy[after - 1], axis=1) < _MAX_JUMP]
    t, at = seconds[scan], seconds[between]
    return between, np.column_stack([np.interp(at, t, xy[:, 0]), np.interp(at, t, xy[:, 1])])


def _extrapolate_ends(seconds: Float, scan: Index, xy: Float) -> Iterator[Places]:
    """Scans of the second before the first detection and after the last, and the places then."""
    t = seconds[scan]
    first, last = np.searchsorted(seconds, [t[0] - _EDGE_TIME, t[-1] + _EDGE_TIME])
    for at, end, scans in (
        (0, t <= t[0] + _EDGE_TIME, np.arange(first, scan[0])),
        (-1, t >= t[-1] - _EDGE_TIME, np.arange(scan[-1] + 1, last)),
    ):
        some = scans[:: max(1, -(-len(scans) // _EDGE_VIEWS))]
        velocity = regress_velocity(t[end], xy[end], _REST_TIME)
        yield some, xy[at] + (seconds[some] - t[at])[:, None] * velocity


class Visibility(IntEnum):
    """Outcome of the beams in the direction of a place."""

    HIDDEN = -1  # they end before it, or there are none
    REACHED = 0  # they end there, or disagree
    PASSED = 1  # they end behind it


def _classify_visibility(
    recording: Recording, T_map_sensor: Float, scan: Index, xy: Float
) -> Index:
    """(Q,) the Visibility, in scans `scan` (Q,), of places `xy` (Q, 2), metres in the map frame.

    The beam nearest in direction decides with those on either side of it that are less than 8 cm
    off: most of them pass the place, or end before it. A beam without a return passes if more of
    them are beside it.

    Args:
        recording: 2D.
        T_map_sensor: (T, 3, 3) sensor poses.
    """
    out = np.full(len(scan), Visibility.HIDDEN, np.intp)
    groups = group_indices(scan)
    for g in recording.iter_scans(range(len(groups))):
        here = groups[g]
        t = int(scan[here[0]])
        R, origin = T_map_sensor[t, :2, :2], T_map_sensor[t, :2, 2]
        beams = recording.beams_of(t)
        points, hit = recording.points[beams], recording.hit[beams]
        lost = find_lost_beams(hit, points, np.zeros(len(hit), np.intp))
        out[here] = _classify_places(points[~lost], (xy[here] - origin) @ R)
    return out


def _classify_places(points: Float32, place: Float) -> Index:
    """(n,) the Visibility of places (n, 2) in one scan, end points (N, 2), in the sensor frame."""
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.full(len(place), Visibility.HIDDEN, np.intp)
    bearing = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearing)
    bearing, distance = bearing[order], np.hypot(points[order, 0], points[order, 1])
    wanted, far = np.arctan2(place[:, 1], place[:, 0]), np.hypot(place[:, 0], place[:, 1])
    after = np.searchsorted(bearing, wanted)
    beams = (after[:, None] + np.arange(-2, 2)) % len(bearing)
    off = np.abs((bearing[beams] - wanted[:, None] + np.pi) % (2.0 * np.pi) - np.pi)
    nearest = off.min(axis=1)
    width = np.maximum(_HALF_WIDTH / np.maximum(far, _DEPTH), nearest)
    near = off <= width[:, None]
    count = near.sum(axis=1)
    past = 2 * (near & (distance[beams] > far[:, None] + _DEPTH)).sum(axis=1) > count
    before = 2 * (near & (distance[beams] < far[:, None] - _DEPTH)).sum(axis=1) > count
    not_past = np.where(before, Visibility.HIDDEN, Visibility.REACHED)
    visibility = np.where(past, Visibility.PASSED, not_past)
    return np.where(nearest > _MAX_BEARING, Visibility.HIDDEN, visibility).astype(np.intp)
