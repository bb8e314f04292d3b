"""Which features stand where shortly before or after there was nothing."""

import numpy as np
from numpy.typing import NDArray

from stillmap.em.tracker.features import Features, ranges
from stillmap.recording.model import Recording

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_BEAMS = 3  # next to a place in bearing: one alone may pass a thing by
_ASIDE = 0.1  # rad by which they may miss it


def changed(
    recording: Recording, T_map_sensor: Float, found: Features, look: float, behind: float
) -> NDArray[np.bool_]:
    """(F,) whether the same laser saw through a feature's place a while before, or after.

    Args:
        recording: 2D.
        T_map_sensor: (T, 3, 3).
        found: features in the map frame.
        look: seconds between the two scans at least; the nearest such scan counts.
        behind: metres behind a place at which a beam has passed it.
    """
    out = np.zeros(len(found.scan), bool)
    of_scan = np.searchsorted(found.scan, np.arange(recording.n_scans + 1))
    compared = _compared(recording, look)
    for t in recording.in_turn(range(recording.n_scans)):
        here = slice(of_scan[t], of_scan[t + 1])
        if here.start == here.stop:
            continue
        for other in compared[t]:
            out[here] |= _seen_through(
                recording, other, T_map_sensor[other], found.xy[here], behind
            )
    return out


def _compared(recording: Recording, look: float) -> list[list[int]]:
    """The scans of the same laser before and after each scan that it is compared with."""
    out: list[list[int]] = [[] for _ in range(recording.n_scans)]
    away = round(1e9 * look)
    for sensor in np.unique(recording.sensor):
        scans = np.flatnonzero(recording.sensor == sensor)
        stamps = recording.stamp_ns[scans]
        before = np.searchsorted(stamps, stamps - away, side="right") - 1
        after = np.searchsorted(stamps, stamps + away)
        for t, i, j in zip(scans.tolist(), before.tolist(), after.tolist(), strict=True):
            out[t] = [int(scans[k]) for k in (i, j) if 0 <= k < len(scans)]
    return out


def _seen_through(
    recording: Recording, scan: int, T_map_sensor: Float, xy: Float, behind: float
) -> NDArray[np.bool_]:
    """(F,) whether all the beams of a scan nearest to places (F, 2) in bearing end behind them."""
    beams = recording.beams_of(scan)
    points = recording.points[beams].astype(np.float64)
    usable = np.isfinite(points).all(axis=1)
    if np.count_nonzero(usable) < _BEAMS:
        return np.zeros(len(xy), bool)
    points, r = points[usable], ranges(points, recording.hit[beams])[usable]
    away = xy - T_map_sensor[:2, 2]
    place = (away[:, :, None] * T_map_sensor[:2, :2]).sum(axis=1)
    angle = np.arctan2(points[:, 1], points[:, 0])
    turn = np.arctan2(place[:, 1], place[:, 0])[:, None] - angle
    aside = np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi)
    nearest = np.argsort(aside, axis=1, kind="stable")[:, :_BEAMS]
    close = np.take_along_axis(aside, nearest, axis=1).max(axis=1) <= _ASIDE
    return np.asarray(close & (r[nearest].min(axis=1) > np.hypot(*place.T) + behind))
