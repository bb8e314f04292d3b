"""Relocalization after the robot was carried elsewhere (kidnapped robot).

The trajectory is cut into segments where the robot may have been carried. A segment stays where
odometry leads if its keyframes fit there. Otherwise they are matched, over all headings, with the
most similar earlier places. It is placed beside the others only if it contradicts odometry.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import local_map, loop_verification, motion_model, scan_matching
from stillmap.slam.local_map import SCAN_SPACING, SPACING_PER_SECOND
from stillmap.slam.scan_hits import Scan, select_hits
from stillmap.slam.scan_matching import MAX_OCCLUDED, ScanMatch
from stillmap.slam.types import LoopCandidate, LoopClosure, LoopContext

_MAX_QUERIES = 20  # keyframes of a segment that are matched
_MAX_PLACES = 8  # places that each of them is matched with
_RANGE_BINS = np.geomspace(0.3, 30.0, 25)  # m, of the range histogram that compares scans
_MAX_TESTED = 60  # keyframes of a segment that test a hypothesis
# keyframes that must fit, how many one that contradicts outweighs, and by how many a place among
# the many that are tried must be better than that of odometry
_MIN_SUPPORT, _CONTRADICTION_WEIGHT, _MARGIN, _MARGIN_SHARE = 3, 4, 8, 0.3
_MAX_HYPOTHESES = 12  # that are tested by all keyframes, those that explain most
# keyframes that must contradict the place of odometry, in all and as a share, or it is believed
_MIN_CONTRADICTING, _MIN_CONTRADICTING_SHARE = 5, 0.5
_SAME_DISTANCE, _SAME_ANGLE = 0.5, 0.1  # m, rad within which two hypotheses are one
_DRIFT_DISTANCE = 1.5  # m: smaller displacements are drift of odometry
_STALL_TIME = 5.0  # s for which odometry may stand still unnoticed while the robot drives on
_SEGMENT_SPACING = 10.0  # m between unconnected segments


def separate_segments(travelled: Float, breaks: list[int], metres: float) -> Float:
    """(T,) m travelled with `metres` more at each break, so that no submap reaches across."""
    out = travelled.copy()
    for t in breaks:
        out[t:] += metres
    return out


@dataclass(frozen=True, eq=False)
class Placement:
    """A hypothesis of where a segment lies.

    Attributes:
        C: (3, 3) motion of the segment from where odometry has it.
        fitting, contradicting: keyframes that fit the map before it, and that contradict it.
        tested: keyframes, those that see other places included.
        closures: that lead there.
    """

    C: Float
    fitting: int
    contradicting: int
    tested: int
    closures: list[LoopClosure] = field(default_factory=list)

    @property
    def score(self) -> float:
        """Keyframes in favour; each one that contradicts outweighs several."""
        return self.fitting - _CONTRADICTION_WEIGHT * self.contradicting

    @property
    def is_supported(self) -> bool:
        """True if enough keyframes fit."""
        return self.fitting >= _MIN_SUPPORT and self.score >= 0

    def is_contradicted(self, min_share: float) -> bool:
        """True if enough keyframes contradict it: in number, as a share, against those that fit."""
        least = max(_MIN_CONTRADICTING, min_share * self.tested)
        return self.contradicting >= max(least, _CONTRADICTION_WEIGHT * self.fitting)

    def is_better(self, other: "Placement") -> bool:
        """True if its score exceeds another's by the margin for testing many places."""
        margin = max(_MARGIN, _MARGIN_SHARE * self.tested)
        return self.score >= max(other.score, 0) + margin


@dataclass(frozen=True, eq=False)
class Relocalization:
    """Result of `relocalize_segments`.

    Attributes:
        context: the trajectory with all segments in place.
        closures: that connect them.
        breaks: first scans of segments that do not follow by odometry.
        unconnected: those of them without a known place.
        ambiguous: first scans of segments that would fit elsewhere about as well.
    """

    context: LoopContext
    closures: list[LoopClosure]
    breaks: list[int]
    unconnected: list[int]
    ambiguous: list[int]


def relocalize_segments(context: LoopContext, candidates: list[int]) -> Relocalization:
    """Decides for each segment whether odometry leads there, or the robot was carried elsewhere.

    Odometry is believed unless the segment contradicts the map before it there, or fits much better
    elsewhere.

    Args:
        context: the trajectory.
        candidates: first scans of all segments but the first.
    """
    out = Relocalization(context, [], [], [], [])
    poses = context.poses.copy()
    for first, last in itertools.pairwise([*candidates, len(poses)]):
        context = dataclasses.replace(context, poses=poses)
        earlier = context.keyframes[context.keyframes < first].tolist()
        before = context.build_map(context.recording.iter_scans(earlier, context.e))
        here = Placement(np.eye(3), *_count_support(context, before, np.eye(3), first, last))
        if here.is_supported:
            continue
        there = _find_placement(context, before, first, last)
        if there is not None and there.is_better(here):
            if _exceeds_odometry_error(context, there.C, first):
                out.breaks.append(first)
            poses[first:last] = there.C @ poses[first:last]
            out.closures.extend(there.closures)
        elif here.is_contradicted(_MIN_CONTRADICTING_SHARE):
            poses[first:last] = _offset_beside(context, first) @ poses[first:last]
            out.breaks.append(first)
            out.unconnected.append(first)
        elif there is not None or here.contradicting > here.fitting:
            out.ambiguous.append(first)
    return dataclasses.replace(out, context=dataclasses.replace(context, poses=poses))


def _exceeds_odometry_error(context: LoopContext, C: Float, first: int) -> bool:
    """True if a segment is displaced by C (3, 3) farther than odometry drifts or a stall hides."""
    x, y, _ = se2.parameters(se2.inverse(context.poses[first]) @ C @ context.poses[first])
    seconds = 1e-9 * float(context.recording.stamp_ns[-1] - context.recording.stamp_ns[0])
    speed = float(local_map.travelled_distance(context.poses)[-1]) / max(seconds, 1e-9)
    return float(np.hypot(x, y)) > max(_DRIFT_DISTANCE, _STALL_TIME * speed)


def _match_segment(context: LoopContext, first: int, last: int) -> Iterator[LoopClosure]:
    """Keyframes of a segment, each matched with the earlier places that look most alike."""
    keyframes, length = context.keyframes, loop_verification.SUBMAP_TRAVEL
    segment = keyframes[(keyframes >= first) & (keyframes < last)]
    before = keyframes[keyframes < first]
    signatures = np.array([_range_signature(context, t) for t in before])
    translation, rotation = context.search_distance, np.pi
    std = translation / loop_verification.SEARCH_STDS, rotation / loop_verification.SEARCH_STDS
    submaps = {}
    for later in _select_evenly(segment, _MAX_QUERIES):
        distance = np.abs(signatures - _range_signature(context, later)).sum(axis=1)
        stretches = np.round(context.travelled[before] / length)
        for stretch in _nearest_stretches(stretches, distance):
            if stretch not in submaps:
                submaps[stretch] = loop_verification.build_submap(context, stretch * length)
            same = np.flatnonzero(stretches == stretch)
            earlier = int(before[same[np.argmin(distance[same])]])
            candidate = LoopCandidate(earlier, later, np.eye(3), 0.0)
            closure = loop_verification.verify_candidate(
                context, submaps[stretch], candidate, *std, loop_verification.MIN_EXPLAINED
            )
            if not closure.rejected:
                yield closure


def _nearest_stretches(stretches: Float, distance: Float) -> list[float]:
    """The stretches with the most similar scans, the best first, and the last one."""
    found = dict.fromkeys(stretches[np.argsort(distance, kind="stable")].tolist())
    return list(dict.fromkeys([*list(found)[:_MAX_PLACES], float(stretches[-1])]))


def _range_signature(context: LoopContext, t: int) -> Float:
    """(24,) cumulative range histogram of a scan, which is invariant to rotation."""
    scan = context.hits(t)
    ranges = np.linalg.norm(scan.points, axis=1)
    total = np.histogram(ranges, _RANGE_BINS, weights=scan.weights)[0].cumsum()
    shares: Float = total / max(float(total[-1]), 1e-9)
    return shares


def _correction(context: LoopContext, closure: LoopClosure) -> Float:
    """(3, 3) motion of a segment that satisfies a closure."""
    there = context.poses[closure.earlier] @ closure.T
    C: Float = there @ se2.inverse(context.poses[closure.later])
    return C


def _find_placement(
    context: LoopContext, before: _core.OccupancyGrid2D, first: int, last: int
) -> Placement | None:
    """The place at which most keyframes of the segment fit.

    Rooms look alike: a place counts only if the rest of the segment does not contradict it.
    """
    best: Placement | None = None
    closures = list(_match_segment(context, first, last))
    for closure in _deduplicate(context, closures):
        C = _correction(context, closure)
        placement = Placement(C, *_count_support(context, before, C, first, last))
        if placement.is_supported and (best is None or placement.score > best.score):
            best = placement
    if best is None:
        return None
    return dataclasses.replace(best, closures=[c for c in closures if _is_same(context, best.C, c)])


def _deduplicate(context: LoopContext, closures: list[LoopClosure]) -> list[LoopClosure]:
    """One closure per hypothesis, those that explain most."""
    kept = list[LoopClosure]()
    for closure in sorted(closures, key=lambda closure: -closure.explained):
        if len(kept) == _MAX_HYPOTHESES:
            break
        if not any(_is_same(context, _correction(context, other), closure) for other in kept):
            kept.append(closure)
    return kept


def _count_support(
    context: LoopContext, before: _core.OccupancyGrid2D, C: Float, first: int, last: int
) -> tuple[int, int, int]:
    """Keyframes of a segment moved by C (3, 3) that fit a map, that contradict it, and all."""
    keyframes = context.keyframes[(context.keyframes >= first) & (context.keyframes < last)]
    fitting = contradicting = 0
    tested = _select_evenly(keyframes, _MAX_TESTED)
    for t in tested:
        scan = context.hits(t)
        prior = motion_model.gaussian_prior(C @ context.poses[t], _SAME_DISTANCE, _SAME_ANGLE)
        match = scan_matching.refine_pose(before, scan, prior, prior.T_map_base)
        occluded = scan_matching.occluded_share(before, scan, match.T_map_base)
        if occluded > scan_matching.MAX_OCCLUDED:
            contradicting += 1
        elif match.explained >= loop_verification.MIN_EXPLAINED:
            fitting += 1
    return fitting, contradicting, len(tested)


def _select_evenly(keyframes: Index, max_count: int) -> list[int]:
    """At most `max_count` of them, evenly spread."""
    which = np.unique(np.linspace(0, len(keyframes) - 1, max_count).round().astype(int))
    out: list[int] = keyframes[which].tolist()
    return out


def _is_same(context: LoopContext, correction: Float, closure: LoopClosure) -> bool:
    """True if a closure asks for that correction (3, 3) of its segment."""
    there = context.poses[closure.earlier] @ closure.T
    d = se2.parameters(se2.inverse(correction @ context.poses[closure.later]) @ there)
    return bool(np.hypot(d[0], d[1]) < _SAME_DISTANCE and abs(d[2]) < _SAME_ANGLE)


def _offset_beside(context: LoopContext, first: int) -> Float:
    """(3, 3) that moves the scans from `first` on to the right of all earlier ones."""
    points = [context.hits(t).points for t in context.keyframes.tolist()]
    max_range = np.array([np.linalg.norm(of_scan, axis=1).max(initial=0.0) for of_scan in points])
    x, is_new = context.poses[context.keyframes, 0, 2], context.keyframes >= first
    right = (x + max_range)[~is_new].max()
    left = (x - max_range)[is_new].min()
    return se2.matrix(right - left + _SEGMENT_SPACING, 0.0, 0.0)


_MAX_SCANS = 300  # ahead
# a decision needs so many contradicting scans; so many that agree or contradict over so many m of
# travel are enough
_MIN_CONTRADICTING_SCANS, _ENOUGH_DECISIVE, _MIN_TRAVEL = 6, 20, 3.0
_CONTRADICTION_RATIO = 4.0  # contradicting scans for each one that agrees
_AGREE_SHARE, _CONTRADICT_SHARE = 0.6, 0.4  # explained, of the usual share
_DRIFT, _MIN_STD = 0.04, 0.05  # m and rad of odometry error per m or rad, and at least


# s without a scan, and times the usual ones, in which the robot may have been carried elsewhere
_GAP, _GAP_RATIO = 5.0, 20.0


def is_gap(seconds: float, usual: float) -> bool:
    """True if the time between two scans is a gap, in which the robot may have been carried.

    Args:
        seconds: between them.
        usual: s between scans.
    """
    return seconds > max(_GAP, _GAP_RATIO * usual)


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
