"""Alternatives to steps of incremental scan matching, compared by the evidence of their maps.

Scan matching decides at each scan, before it sees where that leads. Where odometry failed there, or
may have, three hypotheses may explain the scans around it better: that it was right, that it failed
at these scans only, or that it failed throughout. And odometry alone may be better than all of
them. The one is taken whose map has the higher marginal likelihood.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import local_map, scan_hits
from stillmap.slam.options import SlamOptions
from stillmap.slam.trajectory_cost import OdometryCost, map_evidence
from stillmap.slam.types import Diagnostics, MStepResult

# m of travel and scans on both sides, at least: that are matched again, and that are compared, as
# far as the local map reaches
_MATCHED_AGAIN, _COMPARED = (10.0, 8), (25.0, 10)
# scans over which two motions are compared; m and rad from which they differ
_SPAN, _SAME = 3, np.array([0.1, 0.05])


class PoseMethods(NamedTuple):
    """How trajectories are estimated.

    Attributes:
        match_part: scan matching of a part of the recording given its e, with or without a wider
            search, and scans at which odometry fails.
        close_loops: closes the loops of a trajectory of the whole recording.
        close_part: the same of a part, given its e.
    """

    match_part: Callable[[Recording, Float32, bool, Index], MStepResult]
    close_loops: Callable[[MStepResult], MStepResult]
    close_part: Callable[[Recording, Float32, MStepResult], MStepResult]


@dataclass(frozen=True, eq=False)
class _Alternative:
    """Other steps to the scans from a to b - 1.

    Attributes:
        steps: of the scans from `offset` on.
        gain: nats by which they are more likely, as the scans around them show.
    """

    steps: MStepResult
    offset: int
    a: int
    b: int
    gain: float = 0.0

    def replace_in(self, matched: MStepResult) -> MStepResult:
        """The trajectory with these steps; what follows moves along as a whole."""
        inside, after = slice(self.a, self.b), slice(self.b, None)
        of_steps = slice(self.a - self.offset, self.b - self.offset)
        P, Q, last = matched.poses, self.steps.poses, self.b - 1
        C = P[self.a - 1] @ se2.inverse(Q[of_steps.start - 1])
        poses = P.copy()
        poses[inside] = C @ Q[of_steps]
        C_after = poses[last] @ se2.inverse(P[last])
        poses[after] = C_after @ P[after]
        arrays = {}
        for name in ("covariance", "drift"):
            values = getattr(matched, name).copy()
            values[inside] = se2.rotate_covariance(getattr(self.steps, name)[of_steps], C)
            values[after] = se2.rotate_covariance(values[after], C_after)
            arrays[name] = values
        explained = matched.explained.copy()
        explained[inside] = self.steps.explained[of_steps]
        diagnostics = dataclasses.replace(
            matched.diagnostics,
            widened=self._replace_scans(matched, "widened"),
            odometry_faults=self._replace_scans(matched, "odometry_faults"),
            possible_faults=self._replace_scans(matched, "possible_faults"),
        )
        return dataclasses.replace(
            matched,
            poses=se2.normalize(poses),
            explained=explained,
            diagnostics=diagnostics,
            **arrays,
        )

    def _replace_scans(self, matched: MStepResult, name: str) -> list[int]:
        kept = [t for t in getattr(matched.diagnostics, name) if not self.a <= t < self.b]
        of_steps = [t + self.offset for t in getattr(self.steps.diagnostics, name)]
        return sorted(kept + [t for t in of_steps if self.a <= t < self.b])

    def overlaps(self, other: "_Alternative") -> bool:
        """True if both replace the same step."""
        return self.a < other.b and other.a < self.b


class _Choice(NamedTuple):
    """A trajectory, the same with loops closed, and its cost in nats."""

    matched: MStepResult
    closed: MStepResult
    cost: float


def revise_steps(
    recording: Recording,
    e: Float32,
    options: SlamOptions,
    matched: MStepResult,
    methods: PoseMethods,
    earlier: MStepResult | None = None,
) -> MStepResult:
    """The most likely trajectory, with loops closed.

    Args:
        recording: 2D, deskewed.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        matched: result of incremental scan matching, with segments in place.
        methods: see PoseMethods.
        earlier: trajectory of an earlier iteration, which is kept if it is more likely than
            `matched`: an M-step does not lower the likelihood.
    """
    comparison = _Comparison(recording, e, options, matched, methods)
    closed = methods.close_loops(matched)
    best = _Choice(matched, closed, comparison.cost(closed))
    odometry = comparison.follow_odometry(matched)
    if odometry is not None and (cost := comparison.cost(odometry)) < best.cost:
        closed = methods.close_loops(odometry)
        choices = (
            _Choice(odometry, odometry, cost),
            _Choice(odometry, closed, comparison.cost(closed)),
        )
        best = min(choices, key=lambda choice: choice.cost)
    if earlier is not None:
        # labels given the earlier poses agree with those: without them
        unlabelled = _Comparison(recording, np.ones_like(e), options, matched, methods)
        if unlabelled.cost(earlier) < unlabelled.cost(best.closed):
            return earlier
    changed = np.ones(recording.n_scans, np.bool_)
    while alternatives := comparison.propose(best.matched, changed):
        before, best = best.matched, comparison.choose(best, alternatives)
        changed = comparison.around(_changed_steps(before, best.matched))
    return best.closed


class _Comparison:
    """Compares trajectories of a recording; arguments as of `revise_steps`."""

    def __init__(
        self,
        recording: Recording,
        e: Float32,
        options: SlamOptions,
        matched: MStepResult,
        methods: PoseMethods,
    ) -> None:
        self.recording, self.e, self.options, self.methods = recording, e, options, methods
        self.travelled = local_map.travelled_distance(matched.poses)
        self.kept = local_map.select_keyframes_per_sensor(
            matched.poses, recording.sensor, local_map.SCAN_SPACING, local_map.SCAN_SPACING
        )
        self.odometry_cost = OdometryCost(recording, matched.poses, options.odometry)

    def follow_odometry(self, matched: MStepResult) -> MStepResult | None:
        """The trajectory of odometry alone; None: there is none."""
        T = self.recording.T_odom_base
        if T is None:
            return None
        noise = np.zeros((len(T), 3, 3))  # of the steps, which no scan corrects
        noise[1:] = np.square(self.odometry_cost.std)[:, :, None] * np.eye(3)
        return dataclasses.replace(
            matched,
            poses=se2.normalize(se2.inverse(T[0]) @ T),
            covariance=noise,
            drift=noise,
            loops=[],
            diagnostics=Diagnostics(follows_odometry=True),
        )

    def choose(self, best: _Choice, alternatives: list[_Alternative]) -> _Choice:
        """The more likely of a trajectory and the same with alternatives: all of them, or parts."""
        while alternatives:
            matched = best.matched
            for alternative in alternatives:
                matched = alternative.replace_in(matched)
            closed = self.methods.close_loops(matched)
            if (cost := self.cost(closed)) < best.cost:
                return _Choice(matched, closed, cost)
            # their map shows which of them are wrong; if none stands out, the least likely
            gains = [self._gain_within(best.closed, closed, each) for each in alternatives]
            least = 0.0 if min(gains) <= 0.0 else min(gains)
            alternatives = list(itertools.compress(alternatives, np.greater(gains, least)))
        return best

    def propose(self, matched: MStepResult, changed: Bool) -> list[_Alternative]:
        """Alternatives that the scans around them make more likely, in the order of the scans.

        Args:
            matched: the trajectory.
            changed: (T,) scans that did not lie so before: elsewhere nothing new is to be found.
        """
        proposed = [
            dataclasses.replace(alternative, gain=gain)
            for alternative in self._match_again(matched, changed)
            if (gain := self._gain(matched, alternative)) > 0.0
        ]
        chosen: list[_Alternative] = []
        for alternative in sorted(proposed, key=lambda proposal: -proposal.gain):
            if not any(alternative.overlaps(earlier) for earlier in chosen):
                chosen.append(alternative)
        return sorted(chosen, key=lambda alternative: alternative.a)

    def around(self, scans: Bool) -> Bool:
        """(T,) scans in windows around some of the scans (T,)."""
        out = np.zeros_like(scans)
        for t in np.flatnonzero(scans).tolist():
            out[slice(*_window(self.travelled, t, t + 1, _COMPARED))] = True
        return out

    def _match_again(self, matched: MStepResult, changed: Bool) -> Iterator[_Alternative]:
        """Steps that differ if odometry is right, fails at scans found far off, or throughout."""
        diagnostics = matched.diagnostics
        widened = np.array(diagnostics.widened, np.intp)
        faults = diagnostics.odometry_faults + diagnostics.possible_faults
        rejected = np.union1d(widened, np.array(faults, np.intp))
        for is_wide, without_odometry in ((False, False), (True, False), (True, True)):
            if is_wide and self.recording.T_odom_base is None:
                return
            at = rejected if without_odometry else widened
            at = at[changed[at]]
            for first, last in _windows(self.travelled, at):
                part, e = self._select(first, last)
                inside = widened[(first < widened) & (widened < last)] - first
                source = part.without_odometry() if without_odometry else part
                steps = self.methods.match_part(
                    source, e, is_wide, inside if is_wide else inside[:0]
                )
                for a, b in _differences(matched.poses[first:last], steps.poses):
                    # whether the robot was carried is decided where segments are placed
                    if not any(a <= t < b for t in steps.diagnostics.breaks):
                        yield _Alternative(steps, first, first + a, first + b)

    def _gain(self, matched: MStepResult, alternative: _Alternative) -> float:
        """Nats by which the steps of an alternative and the scans around them are more likely."""
        first, last = _window(self.travelled, alternative.a, alternative.b, _COMPARED)
        cuts = [t for t in matched.diagnostics.breaks if first < t < last]
        span = alternative.a, alternative.b
        costs = []
        for trajectory in (matched, alternative.replace_in(matched)):
            cost = self.odometry_cost(trajectory.poses, *span)
            for start, end in zip([first, *cuts], [*cuts, last], strict=True):
                scans = self._kept_within(start, end)
                cost += self._scan_cost(self._close_part(trajectory, scans), scans)
            costs.append(cost)
        return costs[0] - costs[1]

    def _gain_within(
        self, before: MStepResult, after: MStepResult, alternative: _Alternative
    ) -> float:
        """The same of two trajectories with loops closed, the latter with the alternative."""
        first, last = _window(self.travelled, alternative.a, alternative.b, _COMPARED)
        scans = self._kept_within(first, last)
        cost, cost_after = (
            self.odometry_cost(closed.poses, first + 1, last)
            + self._scan_cost(closed.poses[scans], scans)
            for closed in (before, after)
        )
        return cost - cost_after

    def cost(self, closed: MStepResult) -> float:
        """Nats, -ln of the probability of all scans and steps, up to a constant."""
        poses = closed.poses
        kept = self.kept
        return self.odometry_cost(poses, 1, len(poses)) + self._scan_cost(poses[kept], kept)

    def _kept_within(self, first: int, last: int) -> Index:
        """The spaced scans from first to last - 1."""
        return self.kept[slice(*np.searchsorted(self.kept, [first, last]))]

    def _scan_cost(self, poses: Float, scans: Index) -> float:
        """-ln of the evidence of the map of scans (n,) at poses (n, 3, 3)."""
        return -map_evidence(self.recording, self.e, scans, poses, self.options.resolution)

    def _close_part(self, trajectory: MStepResult, scans: Index) -> Float:
        """Poses of scans (n,) with the loops among them closed."""
        if not len(scans):
            return trajectory.poses[scans]
        drift = trajectory.drift
        matched = MStepResult(
            trajectory.poses[scans],
            trajectory.covariance[scans],
            trajectory.grid,
            trajectory.explained[scans],
            None if drift is None else np.diff(drift.cumsum(axis=0)[scans], axis=0, prepend=0.0),
        )
        part, e = scan_hits.select_scans(self.recording, self.e, scans)
        return self.methods.close_part(part, e, matched).poses

    def _select(self, first: int, last: int) -> tuple[Recording, Float32]:
        """The scans from first to last - 1 and the e of their beams."""
        offset = self.recording.offset
        return self.recording.slice_scans(first, last), self.e[offset[first] : offset[last]]


def _changed_steps(before: MStepResult, after: MStepResult) -> Bool:
    """(T,) scans whose step differs."""
    steps, steps_after = (se2.increments(trajectory.poses) for trajectory in (before, after))
    return np.append(False, _differ(steps, steps_after))


def _windows(travelled: Float, at: Index) -> list[tuple[int, int]]:
    """Windows around scans, first scan and one after the last; those that touch are merged."""
    out: list[tuple[int, int]] = []
    for t in at.tolist():
        first, last = _window(travelled, t, t + 1, _MATCHED_AGAIN)
        if out and first <= out[-1][1]:
            first, _ = out.pop()
        out.append((first, last))
    return out


def _window(travelled: Float, a: int, b: int, size: tuple[float, int]) -> tuple[int, int]:
    """The scans around a to b - 1: the first, and one after the last."""
    metres, scans = size
    ends = travelled[a] - metres, travelled[b - 1] + metres
    first, last = np.searchsorted(travelled, ends).tolist()
    return max(min(first, a - scans), 0), min(max(last, b + scans), len(travelled))


def _differences(P: Float, Q: Float) -> list[tuple[int, int]]:
    """Stretches in which the motions of poses P, Q (n, 3, 3) differ: first scan, one after last."""
    differs = np.zeros(len(P), np.bool_)
    for span in range(1, min(_SPAN, len(P) - 1) + 1):
        far = _differ(se2.inverse(P[:-span]) @ P[span:], se2.inverse(Q[:-span]) @ Q[span:])
        for k in range(1, span + 1):
            differs[k : len(P) - span + k] |= far
    at = np.flatnonzero(differs)
    parts = np.split(at, np.flatnonzero(np.diff(at) > _SPAN) + 1) if len(at) else []
    # a single scan that lies askew moves nothing after it
    ends = [(int(part[0]) - 1, int(part[-1])) for part in parts]
    return [
        (a + 1, b + 1)
        for a, b in ends
        if b - a > 2 * _SPAN or _differ(se2.inverse(P[a]) @ P[b], se2.inverse(Q[a]) @ Q[b])
    ]


def _differ(p: Float, q: Float) -> Bool:
    """(...,) whether motions (..., 3, 3) differ."""
    d = np.abs(se2.parameters(se2.inverse(p) @ q))
    differs: Bool = (np.hypot(d[..., 0], d[..., 1]) > _SAME[0]) | (d[..., 2] > _SAME[1])
    return differs
