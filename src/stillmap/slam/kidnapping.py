"""Detection of a kidnapped robot: the scans ahead are compared with the map so far.

One scan that contradicts the map says little: it may show the floor, or a crowd. If the robot was
carried elsewhere, the scans after it contradict the map too, over metres of travel.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.local_map import SCAN_SPACING, SPACING_PER_SECOND
from stillmap.slam.scan_hits import Scan, select_hits
from stillmap.slam.scan_matching import MAX_OCCLUDED, ScanMatch

Float = NDArray[np.float64]

_MAX_SCANS = 300  # ahead
# a decision needs so many contradicting scans; so many that agree or contradict over so many m of
# travel are enough
_MIN_CONTRADICTING, _ENOUGH_DECISIVE, _MIN_TRAVEL = 6, 20, 3.0
_CONTRADICTION_RATIO = 4.0  # contradicting scans for each one that agrees
_AGREE_SHARE, _CONTRADICT_SHARE = 0.6, 0.4  # explained, of the usual share
# s without a scan, and times the usual ones, in which the robot may have been carried elsewhere
_GAP, _GAP_RATIO = 5.0, 20.0
_DRIFT, _MIN_STD = 0.04, 0.05  # m and rad of odometry error per m or rad, and at least


class Evidence(Enum):
    """Relation of a matched scan to the map."""

    AGREES = "agrees"
    CONTRADICTS = "contradicts"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class LookAhead:
    """Result of `look_ahead`.

    Attributes:
        contradicts: whether the scans ahead contradict the map.
        last: the last scan that was compared.
    """

    contradicts: bool
    last: int


def is_gap(seconds: float, usual: float) -> bool:
    """True if the time between two scans is a gap, in which the robot may have been carried.

    Args:
        seconds: between them.
        usual: s between scans.
    """
    return seconds > max(_GAP, _GAP_RATIO * usual)


def judge_scan(grid: _core.OccupancyGrid2D, scan: Scan, match: ScanMatch, usual: float) -> Evidence:
    """Compare a matched scan with a map: it agrees, contradicts it, or sees another part of it.

    A scan of a new place is explained as little as one elsewhere, but its beams do not pass
    through walls.
    """
    if len(scan.points) == 0:
        return Evidence.UNKNOWN
    occluded = scan_matching.occluded_share(grid, scan, match.T_map_base)
    if occluded <= MAX_OCCLUDED:
        return Evidence.AGREES if match.explained >= _AGREE_SHARE * usual else Evidence.UNKNOWN
    return Evidence.CONTRADICTS if match.explained < _CONTRADICT_SHARE * usual else Evidence.UNKNOWN


def look_ahead(
    recording: Recording,
    e: NDArray[np.float32],
    grid: _core.OccupancyGrid2D,
    increments: Float,
    t: int,
    T_map_base: Float,
    usual: float,
) -> LookAhead:
    """Compares spaced scans from t on with the map, at poses by odometry.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        grid: the map so far.
        increments: (T - 1, 3, 3) of odometry.
        t: a scan that contradicts the map.
        T_map_base: (3, 3) its pose by odometry.
        usual: explained share of scans that fit.
    """
    counts = dict.fromkeys(Evidence, 0)
    pose, since, travelled, metres, k = T_map_base, np.inf, 0.0, 0.0, t
    for k in range(t, min(t + _MAX_SCANS, recording.n_scans)):
        if k > t:
            pose = pose @ increments[k - 1]
            step, turn = _size(increments[k - 1])
            seconds = 1e-9 * float(recording.stamp_ns[k] - recording.stamp_ns[k - 1])
            since += step + turn + SPACING_PER_SECOND * seconds
            travelled, metres = travelled + step + turn, metres + step
        if since < SCAN_SPACING:
            continue
        since, std = 0.0, max(_DRIFT * travelled, _MIN_STD)
        scan, prior = select_hits(recording, e, k), motion_model.gaussian_prior(pose, std, std)
        match = scan_matching.refine_pose(grid, scan, prior, pose)
        if k > t and match.explained < _AGREE_SHARE * usual:
            match = scan_matching.search_pose(grid, scan, prior, 2.0 * std, 2.0 * std)
        counts[judge_scan(grid, scan, match, usual)] += 1
        n_decisive = counts[Evidence.AGREES] + counts[Evidence.CONTRADICTS]
        if n_decisive >= _ENOUGH_DECISIVE and metres >= _MIN_TRAVEL:
            break
    least = max(_MIN_CONTRADICTING, _CONTRADICTION_RATIO * counts[Evidence.AGREES])
    return LookAhead(counts[Evidence.CONTRADICTS] >= least, k)


def _size(increment: Float) -> tuple[float, float]:
    """m and rad."""
    x, y, theta = se2.parameters(increment)
    return float(np.hypot(x, y)), abs(float(theta))
