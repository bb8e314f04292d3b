"""Placement of a session in a place: accepted where the evidence is clear, else refused."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stillmap.core import se2, se3
from stillmap.core.array_types import Float
from stillmap.core.short_repr import ShortRepr
from stillmap.places.alignment import Hypothesis, propose_alignments, spread_evenly
from stillmap.places.evidence import measure_evidence
from stillmap.places.keyframes import Keyframes, Session
from stillmap.places.matching import REACH, KeyframeMatch, Verdict, match_sessions
from stillmap.places.place import PlacedSession, Tie
from stillmap.places.surface_map import is_determined, make_surface_map

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
_INDEPENDENT = 0.3  # share of a match that is evidence of its own: neighbours share their errors


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
    covariance = _combine(
        se2.inverse(se2.matrix(x, y, 0.0)) @ poses, [match.closure.covariance for match in fits]
    )
    return (
        float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1])),
        float(np.sqrt(covariance[2, 2])),
    )


def estimate_covariance(placed: PlacedSession, ties: Sequence[Tie]) -> Float:
    """Covariance of the alignment of a session, at its first scan and in its frame.

    (3, 3) of x, y, heading; (6, 6) of translation and rotation vector in 3D.
    """
    poses = se2.inverse(placed.session.node_poses[0]) @ placed.session.node_poses
    return _combine(poses[[tie.second_node for tie in ties]], [tie.covariance for tie in ties])


def _combine(poses: Float, covariances: Sequence[Float]) -> Float:
    """Covariance of the frame of poses (N, D+1, D+1), each measured with a covariance."""
    D = poses.shape[-1] - 1
    information: Float = 1e-9 * np.eye(3 * (D - 1))
    for pose, covariance in zip(poses, covariances, strict=True):
        J = _alignment_jacobian(pose)
        information = information + _INDEPENDENT * J.T @ np.linalg.solve(covariance, J)
    return np.asarray(np.linalg.inv(information).astype(np.float64))


def _alignment_jacobian(pose: Float) -> Float:
    """Of the error of a pose, in its own frame, by that of the frame it is given in."""
    if pose.shape[-1] == 4:
        return se3.adjoint(se2.inverse(pose))
    R, (x, y) = pose[:2, :2].T, pose[:2, 2]
    J = np.eye(3)
    J[:2, :2], J[:2, 2] = R, R @ [-y, x]
    return J
