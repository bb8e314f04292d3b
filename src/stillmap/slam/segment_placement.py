"""Placement of a segment of the trajectory in the map of the scans before it.

Its keyframes are followed along that map one after the other, each within the covariance since the
last one that fitted: a place where odometry leads drifts as any other.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Index
from stillmap.slam import loop_verification, motion_model, scan_matching
from stillmap.slam.loop_candidates import drift_std
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.trajectory_cost import same_place_evidence
from stillmap.slam.types import LoopCandidate, LoopClosure, LoopContext

_MAX_QUERIES = 8  # keyframes of a segment that are matched
_MAX_PLACES = 8  # places that each of them is matched with
_RANGE_BINS = np.geomspace(0.3, 30.0, 25)  # m, of the range histogram that compares scans
_MAX_TESTED = 60  # keyframes of a segment that test a hypothesis
# nats of a robot that was carried: one in a million, to any of 10^8 poses; rarer than that, since
# it tears the map if it is wrong
_CARRIED_COST = 60.0
_MAX_HYPOTHESES = 12  # that are tested by all keyframes, those that explain most
_SAME_DISTANCE, _SAME_ANGLE = 0.5, 0.1  # m, rad within which two hypotheses are one


@dataclass(frozen=True, eq=False)
class Placement:
    """A hypothesis of where a segment lies.

    Attributes:
        C: (3, 3) motion of the segment from where odometry has it.
        is_matched: at least one keyframe fits there.
        gain: nats of evidence of the map of both, over that of a map of each.
        cost: nats of the motion of its scans.
        motion_cost: of the motion before it: an error of odometry, or a robot that was carried.
        is_elsewhere: odometry does not lead there.
        closures: that do.
    """

    C: Float
    is_matched: bool
    gain: float
    cost: float
    motion_cost: float = 0.0
    is_elsewhere: bool = False
    closures: list[LoopClosure] = field(default_factory=list)

    @property
    def is_likely(self) -> bool:
        """True if a keyframe fits, and the evidence outweighs the cost."""
        return self.is_matched and self.score > 0.0

    @property
    def score(self) -> float:
        """Nats by which the segment is more likely to lie there than in an unknown place."""
        return self.gain - self.cost - self.motion_cost


class Segment:
    """Scans from `first` on, before `last`, and the map of those before them.

    Args:
        context: the trajectory, with the segment where odometry leads.
        first, last: range of scans.
        covariance: (3, 3) of x, y, heading of the first scan, map axes.
    """

    def __init__(self, context: LoopContext, first: int, last: int, covariance: Float) -> None:
        keyframes = context.keyframes
        self._context, self._first, self._covariance = context, first, covariance
        self._earlier = keyframes[keyframes < first]
        self._keyframes = keyframes[(keyframes >= first) & (keyframes < last)]
        self._tested = _select_evenly(self._keyframes, _MAX_TESTED)
        scans = context.recording.iter_scans(self._earlier.tolist(), context.e)
        self._map = context.build_map(scans)
        # without end points interpolated between beams, which would count as evidence
        poses = context.poses[self._earlier]
        self._counts = context.count_beams(self._earlier, poses, everywhere=True)

    def follow_odometry(self) -> Placement:
        """The segment where odometry leads, within its covariance."""
        return self._follow(np.eye(3), self._first, self._covariance)

    def continue_motion(self) -> Placement:
        """The segment within reach of the last scan before it, if odometry failed in between."""
        context, t = self._context, self._first
        before, gap = (1e-9 * np.diff(context.recording.stamp_ns[[0, t - 1, t]])).tolist()
        reach = gap * float(context.travelled[t - 1]) / max(before, 1e-9)
        # 0.5: along an axis of a disk
        stds = max(0.5 * reach, motion_model.MIN_INCREMENT_STD[0]), motion_model.UNIFORM_ROTATION
        prior = motion_model.gaussian_prior(context.poses[t - 1], *stds)
        match = scan_matching.match_scan(self._map, context.hits(t), prior, context.explained[t])
        C = match.T_map_base @ se2.inverse(context.poses[t])
        cost = scan_matching.FAULT_COST + scan_matching.motion_cost(prior, match)
        return dataclasses.replace(self._follow(C, t, np.zeros((3, 3))), motion_cost=cost)

    def find_places(self) -> Iterator[Placement]:
        """Places at which keyframes fit, near odometry or elsewhere."""
        closures = list(self._match_places())
        for closure in self._deduplicate(closures):
            placement = self._follow(self._motion(closure), closure.later, np.zeros((3, 3)))
            motion_cost = self._odometry_cost(placement.C)
            yield dataclasses.replace(
                placement,
                motion_cost=min(motion_cost, _CARRIED_COST),
                is_elsewhere=motion_cost > _CARRIED_COST,
                closures=[same for same in closures if self._is_same(placement.C, same)],
            )

    def _follow(self, C: Float, start: int, covariance: Float) -> Placement:
        """Keyframes matched with the map one after the other, from `start` on, then backwards.

        Args:
            C: (3, 3) motion of keyframe `start` from where odometry has it.
            start: a keyframe.
            covariance: (3, 3) of its pose, map axes.
        """
        context, k = self._context, int(np.searchsorted(self._tested, start))
        C_first: Float | None = None
        cost, poses = 0.0, dict[int, Float]()
        for scans in (self._tested[k:], self._tested[:k][::-1]):
            moved, spread, previous = C, covariance, start
            for t in scans:
                spread = transfer_covariance(context, spread, previous, t, moved)
                metres = abs(float(context.travelled[t] - context.travelled[previous]))
                prior = _drifted_prior(moved @ context.poses[t], spread, metres)
                previous, scan = t, context.hits(t)
                poses[t] = prior.T_map_base
                if len(scan.points) == 0:
                    continue
                usual = float(context.explained[t])
                match = scan_matching.match_scan(self._map, scan, prior, usual)
                if match.explained >= loop_verification.MIN_EXPLAINED:
                    poses[t] = T = match.T_map_base
                    moved = T @ se2.inverse(context.poses[t])
                    spread = match.covariance + _drift_covariance(0.0)
                    if C_first is None:
                        C_first = moved
                        cost += scan_matching.motion_cost(prior, match)
                    else:  # its prior is as wide in an unknown place
                        cost += prior.cost(T)
        tested = np.array([poses[t] for t in self._tested])
        own = context.count_beams(np.array(self._tested), tested, other=self._counts)
        gain = same_place_evidence(self._counts, own)
        return Placement(C if C_first is None else C_first, C_first is not None, gain, cost)

    def _odometry_cost(self, C: Float) -> float:
        """Nats of a motion (3, 3) of the segment under odometry."""
        T_odom = self._context.poses[self._first]
        prior = _drifted_prior(T_odom, self._covariance, 0.0)
        return prior.cost(C @ T_odom)

    def _match_places(self) -> Iterator[LoopClosure]:
        """Keyframes of the segment, each matched with the earlier places that look most alike."""
        context, before = self._context, self._earlier
        length = loop_verification.SUBMAP_TRAVEL
        signatures = np.array([_range_signature(context, t) for t in before.tolist()])
        translation, rotation = context.search_distance, np.pi
        std = translation / loop_verification.SEARCH_STDS, rotation / loop_verification.SEARCH_STDS
        stretches = np.round(context.travelled[before] / length)
        submaps = {}
        for later in _select_evenly(self._keyframes, _MAX_QUERIES):
            distance = np.abs(signatures - _range_signature(context, later)).sum(axis=1)
            for stretch in _nearest_stretches(stretches, distance):
                if stretch not in submaps:
                    submaps[stretch] = loop_verification.Submap(context, stretch * length)
                same = np.flatnonzero(stretches == stretch)
                earlier = int(before[same[np.argmin(distance[same])]])
                candidate = LoopCandidate(earlier, later, np.eye(3), 0.0)
                closure = loop_verification.verify_candidate(
                    context, submaps[stretch], candidate, *std
                )
                if not closure.rejected:
                    yield closure

    def _motion(self, closure: LoopClosure) -> Float:
        """(3, 3) motion of the segment that satisfies a closure."""
        poses = self._context.poses
        C: Float = poses[closure.earlier] @ closure.T @ se2.inverse(poses[closure.later])
        return C

    def _deduplicate(self, closures: list[LoopClosure]) -> list[LoopClosure]:
        """One closure per hypothesis, those that explain most."""
        kept = list[LoopClosure]()
        for closure in sorted(closures, key=lambda closure: -closure.explained):
            if not any(self._is_same(self._motion(better), closure) for better in kept):
                kept.append(closure)
        return kept[:_MAX_HYPOTHESES]

    def _is_same(self, C: Float, closure: LoopClosure) -> bool:
        """True if a closure asks for that motion (3, 3) of the segment."""
        later = self._context.poses[closure.later]
        d = se2.parameters(se2.inverse(C @ later) @ self._motion(closure) @ later)
        return bool(np.hypot(d[0], d[1]) < _SAME_DISTANCE and abs(d[2]) < _SAME_ANGLE)


def transfer_covariance(
    context: LoopContext, covariance: Float, i: int, j: int, C: Float | None = None
) -> Float:
    """Covariance (3, 3) of the pose of scan j from that of scan i, x, y (map axes) and heading.

    An error of the heading leads aside what follows; blind steps add theirs.

    Args:
        context: the trajectory.
        covariance: (3, 3) of scan i.
        i, j: scans, in any order.
        C: (3, 3) motion of both from where the context has them; None: none.
    """
    step = context.poses[j, :, 2] - context.poses[i, :, 2]
    x, y, _ = step if C is None else C @ step
    lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    blind = context.drift[min(i, j) + 1 : max(i, j) + 1].sum(axis=0)
    return np.asarray(lever @ covariance @ lever.T + blind)


def _drifted_prior(T_map_base: Float, covariance: Float, metres: float) -> MotionPrior:
    """The prior about a pose (3, 3) with a covariance (3, 3) and the drift of so many metres."""
    total = covariance + _drift_covariance(metres)
    information = np.asarray(np.linalg.inv(total), np.float64)
    std = float(np.sqrt(np.linalg.eigvalsh(total[:2, :2])[1])), float(np.sqrt(total[2, 2]))
    return MotionPrior(se2.normalize(T_map_base), information, *std, is_odometry=True)


def _drift_covariance(metres: float) -> Float:
    """(3, 3) of x, y, heading after so many metres of travel."""
    translation, rotation = drift_std(metres)
    return np.diag(np.square([translation, translation, rotation]))


def _nearest_stretches(stretches: Float, distance: Float) -> list[float]:
    """The stretches with the most similar scans, the best first, and the last one."""
    by_distance = dict.fromkeys(stretches[np.argsort(distance, kind="stable")].tolist())
    return list(dict.fromkeys([*list(by_distance)[:_MAX_PLACES], float(stretches[-1])]))


def _range_signature(context: LoopContext, t: int) -> Float:
    """(24,) cumulative range histogram of a scan, which is invariant to rotation."""
    recording, beams = context.recording, context.recording.beams_of(t)
    hit = recording.hit[beams]
    ranges = np.linalg.norm(context.hits(t).points, axis=1)
    total = np.histogram(ranges, _RANGE_BINS, weights=context.e[beams][hit])[0].cumsum()
    return np.asarray(total / max(float(total[-1]), 1e-9))


def _select_evenly(keyframes: Index, max_count: int) -> list[int]:
    """At most `max_count` of them, evenly spread."""
    which = np.unique(np.linspace(0, len(keyframes) - 1, max_count).round().astype(int))
    return [int(t) for t in keyframes[which]]
