"""Hits that movers explain: a mover followed over several lengths moved in every detection.

Where a car occludes the road behind it whenever a place is seen, the cells alone take its side for
a wall. Its path shows that it was there at these times: only hits at other times are evidence of
the place itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.recording import Recording
from stillmap.tracking.mover_path import MoverPath

Float = NDArray[np.float64]
Index = NDArray[np.intp]
Labels = NDArray[np.float32]

_MARGIN = 0.15  # m around the box
_CELL = 0.25  # m, of a place
_STRAY = 19.0  # Beta(1, 19): share of the hits outside, of places that only movers were in
_MAX_LOG_ODDS = 50.0


def explain_hits(
    recording: Recording,
    poses: Float,
    seconds: Float,
    p_static: Labels,
    paths: Sequence[MoverPath],
    p_mover: Float,
) -> Labels:
    """(M,) P(static), lower for beams that ended on movers.

    Of the m + n hits of a place, m are explained by movers and n not. Where something static
    stands, the share n / (m + n) may be any; where only movers were, it is small: stray hits.

    Args:
        recording: 2D, M beams.
        poses: (T, 3, 3) T_map_base.
        seconds: (T,) times of the scans.
        p_static: (M,) P(c = 1).
        paths: K, of what is followed.
        p_mover: (K,) probability that each is of a mover.
    """
    if not len(paths):
        return p_static
    beam, weight = _beams_within(recording, poses, seconds, paths, p_mover)
    if not len(beam):
        return p_static
    key = _keys(recording.end_points(beam, poses))
    places, place = np.unique(key, return_inverse=True)
    explained = np.bincount(place, weight, minlength=len(places)).astype(np.float64)
    others = _static_hits(recording, poses, p_static, places)
    others -= np.bincount(place, np.nan_to_num(p_static[beam]), minlength=len(places))
    others = np.maximum(others, 0.0)
    p_place = _compute_p_static(explained, others)[place]
    out = arrays.copy(p_static, recording.scratch)
    out[beam] *= (1.0 - weight * (1.0 - p_place)).astype(np.float32)
    return out


def _compute_p_static(explained: Float, others: Float) -> Float:
    """(P,) that something static is there, given the hits within boxes and at other times."""
    from scipy.special import betaln  # slow to load

    log_static = betaln(others + 1.0, explained + 1.0)
    log_mover = betaln(others + 1.0, explained + _STRAY) - betaln(1.0, _STRAY)
    log_odds = log_static - log_mover
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -_MAX_LOG_ODDS, _MAX_LOG_ODDS))))


class _Boxes(NamedTuple):
    """Boxes of K paths in all of their scans, rising: which scan (R,), path, center, heading."""

    scan: Index
    path: Index
    xy: Float
    heading: Float


def _place_boxes(seconds: Float, paths: Sequence[MoverPath]) -> _Boxes:
    scans = [np.arange(*path.scans(seconds)) for path in paths]
    states = [path.state_at(seconds[some]) for path, some in zip(paths, scans, strict=True)]
    xy, velocity = (np.concatenate(column) for column in zip(*states, strict=True))
    scan = np.concatenate(scans)
    path = np.repeat(np.arange(len(paths)), [len(some) for some in scans])
    order = np.argsort(scan, kind="stable")
    heading = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    return _Boxes(scan[order], path[order], xy[order], heading[order])


def _beams_within(
    recording: Recording,
    poses: Float,
    seconds: Float,
    paths: Sequence[MoverPath],
    p_mover: Float,
) -> tuple[Index, Float]:
    """Hits within a box (n,), rising, and the probability of the mover."""
    boxes = _place_boxes(seconds, paths)
    half = 0.5 * np.array([(path.length, path.width) for path in paths]) + _MARGIN
    begins = np.flatnonzero(np.diff(boxes.scan, prepend=-1))
    rows = np.split(np.arange(len(boxes.scan)), begins[1:])
    beams, weights = [np.zeros(0, np.intp)], [np.zeros(0)]
    T_map_sensor = recording.T_map_sensor(poses)
    for k in recording.iter_scans(range(len(rows))):
        row, t = rows[k], int(boxes.scan[rows[k][0]])
        of_scan = recording.beams_of(t)
        beam = of_scan.start + np.flatnonzero(recording.hit[of_scan])
        xy = recording.points[beam] @ T_map_sensor[t, :2, :2].T + T_map_sensor[t, :2, 2]
        off, u, size = xy[:, None] - boxes.xy[row], boxes.heading[row], half[boxes.path[row]]
        inside = np.abs((off * u).sum(axis=-1)) <= size[:, 0]
        inside &= np.abs(off[..., 1] * u[:, 0] - off[..., 0] * u[:, 1]) <= size[:, 1]
        weight = (inside * p_mover[boxes.path[row]]).max(axis=1)
        beams.append(beam[weight > 0.0])
        weights.append(weight[weight > 0.0])
    return np.concatenate(beams), np.concatenate(weights)


def _static_hits(
    recording: Recording, poses: Float, p_static: Labels, places: NDArray[np.int64]
) -> Float:
    """(P,) expected number of static hits in each place."""
    out = np.zeros(len(places))
    for block in arrays.iter_blocks(recording.hit, p_static):
        beam = block.start + np.flatnonzero(recording.hit[block] & ~np.isnan(p_static[block]))
        key = _keys(recording.end_points(beam, poses))
        at = np.minimum(np.searchsorted(places, key), len(places) - 1)
        found = places[at] == key
        out += np.bincount(at[found], p_static[beam[found]], minlength=len(places))
    return out


def _keys(xy: Float) -> NDArray[np.int64]:
    """(n,) one key per square of the plane."""
    square = np.floor(xy / _CELL).astype(np.int64)
    return np.asarray((square[:, 0] << 32) + square[:, 1], np.int64)
