"""Relocalization after the robot was carried elsewhere (kidnapped robot).

The trajectory is cut into segments where the robot may have been carried. A segment stays where
odometry leads, within its covariance, unless another known place fits much better.
"""

import dataclasses
import itertools
from dataclasses import dataclass
from enum import Enum

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float, Float32
from stillmap.core.recording import Recording
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.local_map import SCAN_SPACING, SPACING_PER_SECOND
from stillmap.slam.scan_hits import Scan, select_hits
from stillmap.slam.scan_matching import MAX_OCCLUDED, ScanMatch
from stillmap.slam.segment_placement import Segment, transfer_covariance
from stillmap.slam.types import LoopClosure, LoopContext


def separate_segments(travelled: Float, breaks: list[int], metres: float) -> Float:
    """(T,) m travelled with `metres` more at each break, so that no submap reaches across."""
    out = travelled.copy()
    for t in breaks:
        out[t:] += metres
    return out


@dataclass(frozen=True, eq=False)
class Relocalization:
    """Result of `relocalize_segments`.

    Attributes:
        context: the trajectory with all segments in place.
        closures: that connect them.
        breaks: first scans of segments that do not follow by odometry.
        ambiguous: first scans of segments that contradict the map where odometry leads, and fit
            nowhere else.
    """

    context: LoopContext
    closures: list[LoopClosure]
    breaks: list[int]
    ambiguous: list[int]


def relocalize_segments(context: LoopContext, candidates: list[int]) -> Relocalization:
    """Decides for each segment whether odometry leads there, or the robot was carried elsewhere.

    Odometry is believed unless the segment fits much better elsewhere.

    Args:
        context: the trajectory.
        candidates: first scans of all segments but the first.
    """
    out = Relocalization(context, [], [], [])
    poses = context.poses.copy()
    # covariance of the first scan of a segment given the map of those that are in place
    previous, covariance = 0, np.zeros((3, 3))
    for first, last in itertools.pairwise([*candidates, len(poses)]):
        context = dataclasses.replace(context, poses=poses)
        covariance = transfer_covariance(context, covariance, previous, first)
        segment = Segment(context, first, last, covariance)
        previous, by_odometry = first, segment.follow_odometry()
        best = by_odometry
        if not best.is_likely:
            best = max(best, segment.find_place() or best, key=lambda placement: placement.score)
        if best.is_likely:
            covariance = np.zeros((3, 3))
            poses[first:] = se2.normalize(best.C @ poses[first:])
            out.closures.extend(best.closures)
            if best.is_elsewhere:
                out.breaks.append(first)
        elif by_odometry.gain < 0.0:
            out.ambiguous.append(first)
    return dataclasses.replace(out, context=dataclasses.replace(context, poses=poses))


_MAX_SCANS = 300  # ahead
# a decision needs so many contradicting scans; so many that agree or contradict over so many m of
# travel are enough
_MIN_CONTRADICTING_SCANS, _ENOUGH_DECISIVE, _MIN_TRAVEL = 6, 20, 3.0
_CONTRADICTION_RATIO = 4.0  # contradicting scans for each one that agrees
_AGREE_SHARE, _CONTRADICT_SHARE = 0.6, 0.4  # explained, of the usual share
_DRIFT, _MIN_STD = 0.04, 0.05  # m and rad of odometry error per m or rad, and at least


# s without a scan, and times the usual ones, in which the robot may have been carried elsewhere; or
# in which it may have driven metres from where odometry leads: m, std
_GAP, _GAP_RATIO, _GAP_RATIO_DRIVEN, _DRIVEN_STD = 5.0, 20.0, 4.0, 0.5


def is_gap(seconds: float, usual: float, translation_std: float) -> bool:
    """True if the time between two scans is a gap, after which the robot may be anywhere near.

    Args:
        seconds: between them.
        usual: s between scans.
        translation_std: m, of the motion prior.
    """
    ratio = _GAP_RATIO if translation_std <= _DRIVEN_STD else _GAP_RATIO_DRIVEN
    return seconds > max(_GAP, ratio * usual)


class Evidence(Enum):
    """Relation of a matched scan to the map."""

    AGREES = "agrees"
    CONTRADICTS = "contradicts"
    UNKNOWN = "unknown"


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
    e: Float32,
    grid: _core.OccupancyGrid2D,
    increments: Float,
    t: int,
    T_map_base: Float,
    usual: float,
) -> tuple[bool, int]:
    """Whether spaced scans from t on contradict the map, at poses by odometry, and the last one.

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
            x, y, theta = se2.parameters(increments[k - 1])
            step, turn = float(np.hypot(x, y)), abs(float(theta))
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
    least = max(_MIN_CONTRADICTING_SCANS, _CONTRADICTION_RATIO * counts[Evidence.AGREES])
    return counts[Evidence.CONTRADICTS] >= least, k
