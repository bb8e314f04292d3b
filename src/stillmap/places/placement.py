"""Placement of a session in a place: accepted where the evidence is clear, else refused.

Keyframes of one session are registered to submaps of the other: in the plane by the evidence that
also verifies loops, in 3D sweep by sweep.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.short_repr import ShortRepr
from stillmap.places.alignment import Hypothesis, propose_alignments, spread_evenly
from stillmap.places.evidence import measure_evidence
from stillmap.places.keyframes import Keyframes, Session, join_keyframes
from stillmap.places.place import PlacedSession, combine_covariances
from stillmap.places.surface_map import is_determined, make_surface_map
from stillmap.slam import loop_candidates, loop_verification, scan_matching
from stillmap.slam.lidar_odometry import LidarOdometry
from stillmap.slam.local_map import travelled_distance
from stillmap.slam.loop_closure_3d import SweepLoopCloser
from stillmap.slam.types import LoopCandidate, LoopClosure, LoopContext

# m between a keyframe, or its view, and the one of the other session that it is matched with
REACH, _VIEW_REACH = 6.0, 10.0
SESSION_GAP = 100.0  # m of travel put between two sessions, so that no submap reaches across
_USUAL_EXPLAINED = 0.9  # share of a scan that its own session's map explains
# explained share of the comparable beams from which on a keyframe fits, and below which it
# contradicts; comparable is what the other session observed from the same side
_FITS, _CONTRADICTS = 0.6, 0.4
_MIN_COMPARABLE = 0.3  # share of a view that the submap must have observed
_RESOLUTION, _KEYFRAME_DISTANCE = 0.05, 1.0  # m, of submaps


class Verdict(Enum):
    """Evidence of a keyframe for or against an alignment."""

    FITS = "fits"
    CONTRADICTS = "contradicts"
    UNKNOWN = "unknown"


class KeyframeMatch(NamedTuple):
    """A keyframe matched with a submap of another session.

    Attributes:
        node, nearest: indices into the nodes of the session and of the other one.
        closure: the measured pose of the keyframe in the frame of the other node.
        verdict: see Verdict.
    """

    node: int
    nearest: int
    closure: LoopClosure
    verdict: Verdict


def match_sessions(
    reference: Keyframes,
    T_place_reference: Float,
    session: Keyframes,
    T_place_session: Float,
    std: tuple[float, float],
    nodes: list[int],
) -> list[KeyframeMatch]:
    """Matches nodes of a session with the nearest submaps of a reference session.

    Args:
        reference: 2D keyframes of a session of the place.
        T_place_reference: (K, 3, 3) their poses in the place.
        session: 2D keyframes.
        T_place_session: (L, 3, 3) their predicted poses in the place.
        std: m and rad, of the prediction.
        nodes: indices into the nodes of the session.
    """
    context = _make_context(reference, T_place_reference, session, T_place_session)
    K = len(reference)
    pairs = list(_pair_nodes(context, len(reference.nodes), nodes))
    by_stretch: dict[int, list[tuple[int, int]]] = {}
    for node, nearest in pairs:
        at = context.travelled[reference.nodes[nearest]]
        by_stretch.setdefault(round(at / loop_verification.SUBMAP_TRAVEL), []).append(
            (node, nearest)
        )
    out = []
    for stretch, members in sorted(by_stretch.items()):
        submap = loop_verification.Submap(context, stretch * loop_verification.SUBMAP_TRAVEL)
        for node, nearest in members:
            earlier, later = int(reference.nodes[nearest]), K + int(session.nodes[node])
            T = se2.inverse(context.poses[earlier]) @ context.poses[later]
            closure = loop_verification.verify_candidate(
                context, submap, LoopCandidate(earlier, later, T, 0.0), *std
            )
            occluded = scan_matching.occluded_share(
                submap.grid, context.hits(later), context.poses[earlier] @ closure.T
            )
            out.append(_judge(node, nearest, closure, occluded))
    return sorted(out, key=lambda match: match.node)


def _make_context(
    reference: Keyframes, T_place_reference: Float, session: Keyframes, T_place_session: Float
) -> LoopContext:
    """Both sessions as one trajectory, the reference first."""
    both = join_keyframes([reference, session])
    poses = np.concatenate([T_place_reference, T_place_session])
    travelled = travelled_distance(poses)
    travelled[len(reference) :] += SESSION_GAP
    return LoopContext(
        both.recording,
        both.e,
        poses,
        travelled,
        np.full(len(poses), _USUAL_EXPLAINED),
        both.nodes,
        _RESOLUTION,
        _KEYFRAME_DISTANCE,
        REACH,
        np.zeros((len(poses), 3, 3)),
    )


def _pair_nodes(
    context: LoopContext, n_reference: int, nodes: list[int]
) -> Iterator[tuple[int, int]]:
    """Each node of the session with the nearest one of the reference, if near enough.

    Where there is a choice, with one of about the same heading. Otherwise with the one whose view
    is nearest: robots that pass on two sides of a hall see the same walls.
    """
    poses = context.poses[context.keyframes]
    x = se2.parameters(poses)
    centers = loop_candidates.view_centers(context)
    in_place = np.einsum("kij,kj->ki", poses[:, :2, :2], centers) + poses[:, :2, 2]
    for node in nodes:
        k = n_reference + node
        distance = np.linalg.norm(x[:n_reference, :2] - x[k, :2], axis=1)
        turn = np.abs(se2.wrap(x[:n_reference, 2] - x[k, 2]))
        view_distance = np.linalg.norm(in_place[:n_reference] - in_place[k], axis=1)
        for cost, off, reach in (
            (distance + turn, distance, REACH),
            (view_distance, view_distance, _VIEW_REACH),
        ):
            nearest = int(np.argmin(cost))
            if off[nearest] <= reach:
                yield node, nearest
                break


def _judge(node: int, nearest: int, closure: LoopClosure, occluded: float) -> KeyframeMatch:
    verdict = Verdict.UNKNOWN
    if closure.comparable >= _MIN_COMPARABLE:
        if occluded > scan_matching.MAX_OCCLUDED or closure.explained < _CONTRADICTS:
            verdict = Verdict.CONTRADICTS
        elif not closure.rejected and closure.explained >= _FITS:
            verdict = Verdict.FITS
    return KeyframeMatch(node, nearest, closure, verdict)


_REACH = 20.0  # m between a node and the one of the other session whose submap it is matched with
_USUAL_EXPLAINED_3D = 0.8  # share of a sweep that the map of its own session explains
_MAX_NODES = 40  # that are registered: each takes long, and neighbours say the same


def match_sweeps(
    reference: PlacedSession,
    placed: PlacedSession,
    std: tuple[float, float],
    nodes: list[int],
    threads: int,
) -> list[KeyframeMatch]:
    """Registers nodes of a session to submaps of a reference session.

    Args:
        reference: a session of the place.
        placed: a session at its predicted poses in the place.
        std: m and rad, of these poses.
        nodes: indices into the nodes of the session.
        threads: the result does not depend on it.
    """
    known, own = reference.session.keyframes, placed.session.keyframes
    both = join_keyframes([known, own])
    poses = np.concatenate([reference.keyframe_poses, placed.keyframe_poses])
    travelled = travelled_distance(poses)
    travelled[len(known) :] += SESSION_GAP
    T = len(poses)
    odometry = LidarOdometry(
        poses, np.zeros((T, 6)), np.zeros((T, 6, 6)), np.full(T, _USUAL_EXPLAINED_3D)
    )
    closer = SweepLoopCloser(
        both.recording, both.e, odometry, travelled, np.arange(T), _REACH, threads
    )
    theirs = poses[known.nodes, :3, 3]
    out = []
    step = max(-(-len(nodes) // _MAX_NODES), 1)
    for node in nodes[::step]:
        later = len(known) + int(own.nodes[node])
        distance = np.linalg.norm(theirs - poses[later, :3, 3], axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] > _REACH:
            continue
        earlier = int(known.nodes[nearest])
        closure = closer.verify(earlier, later, se2.inverse(poses[earlier]) @ poses[later], *std)
        verdict = Verdict.CONTRADICTS if closure.rejected else Verdict.FITS
        out.append(KeyframeMatch(node, nearest, closure, verdict))
    return out


# sessions of the place that a new one is matched with; share of its nodes that only a further one
# is near to: each takes as long as the first
_MAX_REFERENCES, _MIN_GAIN = 3, 0.1
_MAX_TESTED = 60  # nodes that test a hypothesis, per reference
# std (m, rad) of poses by a hypothesis, before the pose graph; after it
PREDICTION_STD, CORRECTED_STD = (0.25, 0.04), (0.1, 0.015)
# squares (0.1 m) of surface that must agree
_MIN_AGREEING = 200
# share of the squares seen by both that may differ where no other alignment fits at all, and score
# of another one, relative to the best, at which none may: things move between sessions, but
# look-alike places fit in several ways (docs/sessions.md has the distributions)
_MAX_CONFLICT, _MAX_RIVAL = 0.15, 0.6
_MAX_RIVALS = 3  # alignments that registered sweeps compare, the best one among them
# squares that must agree, share that may differ, and score of a rival, where the keyframes that
# fit do not say where a session lies: the maps alone do
_STRONG_AGREEING, _STRONG_CONFLICT, _STRONG_RIVAL = 1000, 0.06, 0.3
_MIN_FITTING = 5  # nodes
# std along the least known direction (m), and of the heading (rad), up to which a session is placed
_MAX_STD, _MAX_HEADING_STD = 0.05, math.radians(0.5)


@dataclass(frozen=True, eq=False)
class Placement(ShortRepr):
    """Alignment of a session with a place, or why that is not known.

    Attributes:
        T: (3, 3) T_place_session in the plane.
        matches: of each reference, by its index in the place.
        refused: the reason; empty if accepted.
        rivals: (3, 3) further alignments. If there are any, `refused` holds unless registered
            sweeps tell them from T.
    """

    T: Float
    matches: dict[int, list[KeyframeMatch]] = field(default_factory=dict)
    refused: str = ""
    rivals: list[Float] = field(default_factory=list)

    def count(self, verdict: Verdict) -> int:
        """Number of matches with a verdict."""
        return sum(match.verdict is verdict for of in self.matches.values() for match in of)


def find_placement(place: Sequence[PlacedSession], session: Session) -> Placement:
    """Find the alignment of a session with a place.

    Args:
        place: its sessions, at least one, with evidence.
        session: a further one, with the evidence of its planar keyframes in its own frame.
    """
    D = session.dimension
    known = make_surface_map([placed.require_evidence()[1] for placed in place], D)
    cell = place[0].require_evidence()[1].resolution
    evidence = measure_evidence(session.planar, session.planar.poses, cell, 1)
    own = make_surface_map([evidence], D)
    proposed = propose_alignments(known, own)
    refused = _doubt(proposed)
    if D == 3 and not _is_excluded(proposed):
        # sweeps are registered in space, which tells more than their planar views
        rivals = [rival.T for rival in proposed[1:_MAX_RIVALS]] if refused else []
        return Placement(proposed[0].T, refused=refused, rivals=rivals)
    if refused:
        return Placement(np.eye(3), refused=refused)
    best = test_alignment(place, session, proposed[0].T)
    refused = _uncertainty(best, session)
    contradicted = best.count(Verdict.CONTRADICTS) > best.count(Verdict.FITS)
    if refused and not contradicted and _is_strong(proposed) and is_determined(known, own, best.T):
        return Placement(best.T)  # seen from afar, as across a hall: the maps alone say where it is
    return replace(best, refused=refused)


def _is_strong(proposed: list[Hypothesis]) -> bool:
    """True if the comparison of the maps alone is enough."""
    best = proposed[0].comparison
    rival = max((hypothesis.comparison.score for hypothesis in proposed[1:]), default=0.0)
    few = best.conflict <= _STRONG_CONFLICT * (best.agree + best.conflict)
    return best.agree >= _STRONG_AGREEING and few and rival <= _STRONG_RIVAL * best.score


def _is_excluded(proposed: list[Hypothesis]) -> bool:
    """True if the maps exclude even the best alignment."""
    if not proposed or proposed[0].comparison.agree < _MIN_AGREEING:
        return True
    best = proposed[0].comparison
    return best.conflict > _MAX_CONFLICT * (best.agree + best.conflict)


def _doubt(proposed: list[Hypothesis]) -> str:
    """Why the best alignment is not certain by the comparison of the maps; empty if it is."""
    if not proposed or proposed[0].comparison.agree < _MIN_AGREEING:
        return "no part of it looks like the place"
    best, rivals = proposed[0].comparison, proposed[1:]
    share = best.conflict / (best.agree + best.conflict)
    if _is_excluded(proposed):
        return f"it contradicts the place: {100 * share:.0f} % of the surfaces that both saw differ"
    rival = max((hypothesis.comparison.score for hypothesis in rivals), default=0.0) / best.score
    if share > _MAX_CONFLICT * (1.0 - rival / _MAX_RIVAL):
        return (
            f"it may lie in another place: {100 * share:.0f} % of the surfaces that both saw "
            f"differ, and another alignment has {100 * rival:.0f} % of the evidence for the best"
        )
    return ""


def test_alignment(place: Sequence[PlacedSession], session: Session, T: Float) -> Placement:
    """The matches of a session's nodes with its references, at an alignment T (3, 3)."""
    planar = session.planar
    poses = T @ planar.poses
    matches = {}
    for index in select_references(place, planar, poses):
        reference = place[index]
        nodes = spread_evenly(len(planar.nodes), _MAX_TESTED)
        matches[index] = match_sessions(
            reference.session.planar, reference.planar_poses, planar, poses, PREDICTION_STD, nodes
        )
    return Placement(T, matches)


def select_references(place: Sequence[PlacedSession], planar: Keyframes, poses: Float) -> list[int]:
    """The sessions of a place that together were near most nodes at poses (K, 3, 3).

    Of equally good ones the latest, which has changed least since.
    """
    xy = poses[planar.nodes, :2, 2]
    near = []
    for placed in place:
        theirs = placed.planar_poses[placed.session.planar.nodes, :2, 2]
        distance = np.linalg.norm(xy[:, None] - theirs[None], axis=2).min(axis=1)
        near.append(distance <= 0.5 * REACH)
    chosen, missing = list[int](), np.ones(len(xy), np.bool_)
    while len(chosen) < min(_MAX_REFERENCES, len(place)):
        gains = [
            int((mask & missing).sum()) if k not in chosen else -1 for k, mask in enumerate(near)
        ]
        best = max(range(len(place)), key=lambda k: (gains[k], k))
        if chosen and gains[best] < _MIN_GAIN * len(xy):
            break
        chosen.append(best)
        missing &= ~near[best]
    return chosen


def _uncertainty(best: Placement, session: Session) -> str:
    """Why the matches do not determine where a session lies; empty if they do."""
    fitting, against = best.count(Verdict.FITS), best.count(Verdict.CONTRADICTS)
    if fitting < _MIN_FITTING:
        return f"too little of it fits the place: {fitting} keyframes"
    if against > fitting:
        return f"it contradicts the place: {against} keyframes, against {fitting} that fit"
    std, heading = placement_std(best, session)
    if std > _MAX_STD or heading > _MAX_HEADING_STD:
        return (
            f"the overlap does not determine where it lies: standard deviation {std:.2f} m, "
            f"{math.degrees(heading):.1f} degrees"
        )
    return ""


def placement_std(placement: Placement, session: Session) -> tuple[float, float]:
    """Standard deviations of the position (m) along the least known direction, and heading (rad).

    Of the session as a whole, at the middle of the keyframes that fit.
    """
    fits = [m for of in placement.matches.values() for m in of if m.verdict is Verdict.FITS]
    poses = session.planar.poses[session.planar.nodes[[m.node for m in fits]]]
    x, y = poses[:, :2, 2].mean(axis=0).tolist()
    covariance = combine_covariances(
        se2.inverse(se2.matrix(x, y, 0.0)) @ poses, [match.closure.covariance for match in fits]
    )
    return (
        float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1])),
        float(np.sqrt(covariance[2, 2])),
    )
