"""Loop closure in 2D: propose candidates, verify them, solve the pose graph stage by stage."""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import (
    local_map,
    loop_candidates,
    loop_verification,
    pose_graph,
    relocalization,
)
from stillmap.slam.heading_alignment import align_headings
from stillmap.slam.options import SlamOptions
from stillmap.slam.pose_graph import Constraint, PoseGraph
from stillmap.slam.types import BareStretch, LoopClosure, LoopContext, MStepResult, ScanProgress

KEYFRAME_DISTANCE, SEARCH_DISTANCE = 1.0, 6.0  # m, defaults of the options
_MAX_CHI2 = 16.0  # 3 degrees of freedom; above it the graph rejects a loop


def place_segments(
    recording: Recording, e: Float32, options: SlamOptions, matched: MStepResult
) -> MStepResult:
    """Incremental scan matching with all segments in place, and the closures that place them.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        matched: result of incremental scan matching.
    """
    starts = matched.diagnostics.breaks
    if not starts:
        return matched
    placed = relocalization.relocalize_segments(
        _make_context(recording, e, options, matched, starts), starts
    )
    diagnostics = dataclasses.replace(
        matched.diagnostics, breaks=placed.breaks, segments=starts, ambiguous=placed.ambiguous
    )
    return dataclasses.replace(
        matched, poses=placed.context.poses, loops=placed.closures, diagnostics=diagnostics
    )


def close_loops(
    recording: Recording,
    e: Float32,
    options: SlamOptions,
    odometry: MStepResult,
    progress: ScanProgress,
) -> MStepResult:
    """Poses after loop closure, all attempted closures, and the pose graph.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        odometry: result of incremental scan matching with segments in place; its grid is not used.
        progress: called with the number of scans done and their total.
    """
    breaks, ties = odometry.diagnostics.breaks, odometry.loops
    tied = [t for tie in ties for t in (tie.earlier, tie.later)]
    starts = odometry.diagnostics.segments
    context = _make_context(recording, e, options, odometry, starts, tied)
    chain = loop_candidates.odometry_constraints(context, breaks)
    state = LoopState(context.poses[context.keyframes], found=ties, fitting=ties)
    centers = loop_candidates.view_centers(context)
    for first, last in loop_candidates.split_stages(context):
        progress(int(context.keyframes[first]), recording.n_scans)
        state = close_stage(context, chain, centers, state, first, last, len(ties))
    poses, found = solve_graph(context.keyframes, chain, state.poses, state.found, _MAX_CHI2)
    accepted = accepted_constraints(context.keyframes, found)
    graph = PoseGraph(context.keyframes, poses, [*chain, *accepted])
    graph = align_headings(recording, e, graph, odometry.covariance)
    stretches = _without_loops(odometry.diagnostics.bare_stretches, found)
    return dataclasses.replace(
        odometry,
        poses=local_map.propagate_corrections(context.poses, context.keyframes, graph.poses),
        loops=found,
        graph=graph,
        diagnostics=dataclasses.replace(odometry.diagnostics, bare_stretches=stretches),
    )


def _make_context(
    recording: Recording,
    e: Float32,
    options: SlamOptions,
    odometry: MStepResult,
    breaks: list[int],
    tied: Sequence[int] = (),
) -> LoopContext:
    """The trajectory, cut at breaks; scans that closures tie are keyframes."""
    poses = odometry.poses
    keyframe_distance = options.keyframe_distance or KEYFRAME_DISTANCE
    search = options.loop_search_distance
    gap = loop_candidates.MIN_LOOP_TRAVEL + 2.0 * loop_verification.SUBMAP_TRAVEL
    selected = local_map.select_keyframes(
        poses, keyframe_distance, local_map.KEYFRAME_ANGLE, breaks
    )
    return LoopContext(
        recording,
        e,
        poses,
        relocalization.separate_segments(local_map.travelled_distance(poses), breaks, gap),
        odometry.explained,
        np.union1d(selected, np.array(tied, np.intp)),
        options.resolution,
        keyframe_distance,
        SEARCH_DISTANCE if search is None else search,
        np.zeros((len(poses), 3, 3)) if odometry.drift is None else odometry.drift,
    )


def _without_loops(stretches: list[BareStretch], loops: list[LoopClosure]) -> list[BareStretch]:
    """The stretches that no accepted loop spans: one that does measures their length."""
    spans = [(loop.earlier, loop.later) for loop in loops if not loop.rejected]
    return [s for s in stretches if not any(i <= s.first and s.last <= j for i, j in spans)]


@dataclass(frozen=True, eq=False)
class LoopState:
    """Loop closure up to a keyframe.

    Attributes:
        poses: (K, 3, 3) keyframes, corrected so far.
        attempted: closures, accepted and rejected, by the later scan.
        found: the same after the comparison with those nearby, after those that were given.
        fitting: accepted ones that agree with the poses.
    """

    poses: Float
    attempted: list[LoopClosure] = field(default_factory=list)
    found: list[LoopClosure] = field(default_factory=list)
    fitting: list[LoopClosure] = field(default_factory=list)


def close_stage(
    context: LoopContext,
    chain: list[Constraint],
    centers: Float,
    state: LoopState,
    first: int,
    last: int,
    given: int = 0,
) -> LoopState:
    """Close the loops of the keyframes from `first` on, before `last`.

    Args:
        context: the trajectory.
        chain: odometry constraints between the keyframes.
        centers: (K, 2) as of `propose_candidates`.
        state: of the keyframes before `first`; poses of all.
        first, last: range of keyframes.
        given: number of closures at the beginning of `state.found` that were not searched for.
    """
    candidates = loop_candidates.propose_candidates(
        context, state.poses, centers, first, last, state.fitting
    )
    new = loop_verification.verify_candidates(context, candidates)
    attempted = state.attempted + new
    if all(closure.rejected for closure in new):
        return dataclasses.replace(state, attempted=attempted, found=state.found + new)
    found = state.found[:given] + reject_inconsistent_since(
        context, chain, attempted, state.found[given:], first
    )
    poses, fitting = _correct_stage(context, chain, state.poses, last, found)
    return LoopState(poses, attempted, found, fitting)


def _correct_stage(
    context: LoopContext, chain: list[Constraint], poses: Float, last: int, found: list[LoopClosure]
) -> tuple[Float, list[LoopClosure]]:
    """Keyframes (K, 3, 3) with those before `last` optimized, and the closures that fit them.

    Later keyframes move rigidly with the last optimized one.
    """
    accepted = [closure for closure in found if not closure.rejected]
    if not accepted:
        return poses, []
    loops = accepted_constraints(context.keyframes, found)
    out = poses.copy()
    inside = [loop for loop in loops if loop.second < last]
    out[:last] = pose_graph.optimize_poses(poses[:last], chain[: last - 1], inside, _MAX_CHI2)
    moved = out[last - 1] @ se2.inverse(poses[last - 1]) @ poses[last:]
    out[last:] = se2.normalize(moved)  # rounding errors would double with every stage
    fits = pose_graph.squared_mahalanobis(out, loops) <= _MAX_CHI2
    return out, list(itertools.compress(accepted, fits))


def solve_graph(
    keyframes: Index,
    chain: list[Constraint],
    start: Float,
    closures: list[LoopClosure],
    max_chi2: float,
) -> tuple[Float, list[LoopClosure]]:
    """Optimized keyframes (K, D+1, D+1), and the closures with those that the graph rejects.

    Args:
        keyframes: (K,) scans.
        chain: odometry constraints between them.
        start: (K, D+1, D+1).
        closures: accepted and rejected.
        max_chi2: chi-square above which a closure is rejected.
    """
    accepted = accepted_constraints(keyframes, closures)
    if not accepted:
        return start, closures
    robust = pose_graph.optimize_poses(start, chain, accepted, max_chi2)
    loops = [_to_constraint(keyframes, closure) for closure in closures]
    chi2 = pose_graph.squared_mahalanobis(robust, loops)
    closures = [
        c.reject("other loops disagree") if not c.rejected and x > max_chi2 else c
        for c, x in zip(closures, chi2, strict=True)
    ]
    accepted = accepted_constraints(keyframes, closures)
    return pose_graph.optimize_poses(robust, chain, accepted), closures


def accepted_constraints(keyframes: Index, closures: list[LoopClosure]) -> list[Constraint]:
    """Constraints between keyframes, of the accepted closures."""
    return [_to_constraint(keyframes, closure) for closure in closures if not closure.rejected]


def _to_constraint(keyframes: Index, closure: LoopClosure) -> Constraint:
    first, second = np.searchsorted(keyframes, [closure.earlier, closure.later])
    return Constraint(int(first), int(second), closure.T, closure.covariance)


# keyframes on the earlier and the later side that count as nearby; chi-square up to which two agree
_NEARBY, _MAX_AGREEMENT_CHI2 = np.array([8, 4]), 9.0
_PROOF = 13.8  # nats of closures nearby: one correction in a million is wrong


def reject_inconsistent(
    context: LoopContext, chain: list[Constraint], closures: list[LoopClosure]
) -> list[LoopClosure]:
    """Rejects closures whose correction is not proved by those nearby.

    The scores of those that agree, itself included, less those of the others must reach _PROOF.
    """
    accepted = _AcceptedLoops(context, chain, closures)
    out, n = [], 0
    for closure in closures:
        if not closure.rejected:
            others = accepted.nearby(n)
            sign = np.where(accepted.agree(n, others), 1.0, -1.0)
            if closure.score + sign @ accepted.score[others] < _PROOF:
                closure = closure.reject("nearby closures disagree")
            n += 1
        out.append(closure)
    return out


def reject_inconsistent_since(
    context: LoopContext,
    chain: list[Constraint],
    attempted: list[LoopClosure],
    decided: list[LoopClosure],
    k: int,
) -> list[LoopClosure]:
    """`reject_inconsistent` of all attempts, when those from keyframe k on are new.

    Args:
        context, chain: as of `reject_inconsistent`.
        attempted: all attempts, by the later scan.
        decided: the result of those before keyframe k.
        k: index into the keyframes.
    """
    later = np.searchsorted(context.keyframes, [closure.later for closure in attempted])
    # new votes reach back one neighborhood, whose closures depend on one more
    changed, relevant = np.searchsorted(later, [k - _NEARBY[1], k - 2 * _NEARBY[1]])
    again = reject_inconsistent(context, chain, attempted[relevant:])
    return decided[:changed] + again[changed - relevant :]


class _AcceptedLoops:
    """Loop closures that are not rejected, as arrays.

    Attributes:
        score: (L,) as of LoopClosure.
        scans, keyframes: (L, 2) earlier and later scan, and their keyframes' indices.
        T: (L, 3, 3) as of LoopClosure.
        P_earlier, P_later: (L, 3, 3) T_map_base of the scans by the context.
        covariance: (L, 3, 3) as of LoopClosure.
        accumulated: (L, 2, 3, 3) sum of the covariances of the steps to both scans, along the
            map's axes.
    """

    def __init__(
        self, context: LoopContext, chain: list[Constraint], closures: list[LoopClosure]
    ) -> None:
        accepted = [closure for closure in closures if not closure.rejected]
        scans = np.array([[c.earlier, c.later] for c in accepted], np.intp).reshape(-1, 2)
        self.scans = scans
        self.T = np.array([c.T for c in accepted]).reshape(-1, 3, 3)
        self.score = np.array([c.score for c in accepted])
        self.covariance = np.array([c.covariance for c in accepted]).reshape(-1, 3, 3)
        self.keyframes = np.searchsorted(context.keyframes, scans)
        self.accumulated = _accumulate_covariance(context, chain)[self.keyframes]
        self.P_earlier, self.P_later = context.poses[scans].swapaxes(0, 1)

    def nearby(self, n: int) -> Index:
        """(K,) the others a few keyframes from loop n on both sides, with no break in between."""
        near = (np.abs(self.keyframes - self.keyframes[n]) < _NEARBY).all(axis=1)
        between = np.abs(self.accumulated[:, :, 0, 0] - self.accumulated[n, :, 0, 0])
        near &= (between < 0.5 * loop_candidates.NO_ODOMETRY[0] ** 2).all(axis=1)
        near[n] = False
        return np.flatnonzero(near)

    def agree(self, n: int, others: Index) -> Bool:
        """(K,) whether loop n and others (K,) fit the motion between their later scans."""
        is_first = self.scans[n, 1] <= self.scans[others, 1]
        a, b = np.where(is_first, n, others), np.where(is_first, others, n)
        back = se2.inverse(self.P_later[b])
        predicted = self.P_earlier[a] @ self.T[a] @ se2.inverse(self.P_later[a]) @ self.P_later[b]
        d = se2.parameters(se2.inverse(predicted) @ self.P_earlier[b] @ self.T[b])
        sides = self.accumulated[b] - self.accumulated[a]
        between = (sides * np.sign(sides[:, :, :1, :1])).sum(axis=1)  # in either order
        between += se2.rotate_covariance(self.covariance[a], self.P_later[a])
        covariance = self.covariance[b] + se2.rotate_covariance(between, back)
        chi2 = (d * np.linalg.solve(covariance, d[..., None])[..., 0]).sum(axis=1)
        return np.asarray(chi2 < _MAX_AGREEMENT_CHI2)


def _accumulate_covariance(context: LoopContext, chain: list[Constraint]) -> Float:
    """(K, 3, 3) sum of the covariances of the steps to each keyframe, along the map's axes."""
    poses = context.poses[context.keyframes[1:]]
    steps = np.array([constraint.covariance for constraint in chain]).reshape(-1, 3, 3)
    out = np.zeros((len(context.keyframes), 3, 3))
    np.cumsum(se2.rotate_covariance(steps, poses), axis=0, out=out[1:])
    return out
