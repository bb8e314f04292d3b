"""Visibility of given places in scans: hidden behind something, reached, or passed by the beams."""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em.shape_evidence import find_lost_beams

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_DEPTH = 0.3  # m in front of and behind the place that count as the place
_HALF_WIDTH = 0.08  # m to either side, of a leg
_MAX_BEARING = 0.06  # rad to the nearest beam: farther off is out of view


class Look(IntEnum):
    """Outcome of the beams in the direction of a place."""

    HIDDEN = -1  # they end before it, or there are none
    REACHED = 0  # they end there, or disagree
    PASSED = 1  # they end behind it


def classify_looks(recording: Recording, T_map_sensor: Float, scan: Index, xy: Float) -> Index:
    """(Q,) the Look of scans `scan` (Q,) at places `xy` (Q, 2), metres in the map frame.

    The beam nearest in direction decides with those on either side of it that are less than 8 cm
    off: most of them pass the place, or end before it. A beam without a return passes if more of
    them are beside it.

    Args:
        recording: 2D.
        T_map_sensor: (T, 3, 3) sensor poses.
    """
    out = np.full(len(scan), Look.HIDDEN, np.intp)
    order = np.argsort(scan, kind="stable")
    cuts = np.flatnonzero(np.diff(scan[order])) + 1
    groups = np.split(order, cuts) if len(order) else []
    for g in recording.iter_scans(range(len(groups))):
        here = groups[g]
        t = int(scan[here[0]])
        R, origin = T_map_sensor[t, :2, :2], T_map_sensor[t, :2, 2]
        beams = recording.beams_of(t)
        points, hit = recording.points[beams], recording.hit[beams]
        lost = find_lost_beams(hit, points, np.zeros(len(hit), np.intp))
        out[here] = _look_at(points[~lost], (xy[here] - origin) @ R)
    return out


def _look_at(points: NDArray[np.float32], place: Float) -> Index:
    """(n,) the Look of a scan with end points (N, 2) at places (n, 2), in the sensor frame."""
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.full(len(place), Look.HIDDEN, np.intp)
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
    look = np.where(past, Look.PASSED, np.where(before, Look.HIDDEN, Look.REACHED))
    return np.where(nearest > _MAX_BEARING, Look.HIDDEN, look).astype(np.intp)
