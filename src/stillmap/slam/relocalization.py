"""Relocalization after the robot was carried elsewhere (kidnapped robot).

The trajectory is cut into segments where the robot may have been carried. A segment stays where
odometry leads, within its covariance, unless another known place fits much better.
"""

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.slam.segment_placement import Placement, Segment, transfer_covariance
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
        ambiguous: first scans of segments that contradict the map where they lie, and fit
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
        previous = first
        best = by_odometry = segment.follow_odometry()
        if not best.is_likely:
            best = _most_likely(by_odometry, *segment.find_places())
            if not best.is_likely:  # nothing proves that the robot was carried
                continued = segment.continue_motion()
                # where no keyframe fits, the cost of fitting is not paid: no rival of where some do
                is_rival = continued.is_matched or not by_odometry.is_matched
                best = _most_likely(by_odometry, continued) if is_rival else by_odometry
        if best.is_likely or best is not by_odometry:
            covariance = np.zeros((3, 3))
            poses[first:] = se2.normalize(best.C @ poses[first:])
            out.closures.extend(best.closures)
            if best.is_elsewhere:
                out.breaks.append(first)
        if not best.is_likely and best.gain < 0.0:
            out.ambiguous.append(first)
    return dataclasses.replace(out, context=dataclasses.replace(context, poses=poses))


def _most_likely(*placements: Placement) -> Placement:
    return max(placements, key=lambda placement: placement.score)


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
