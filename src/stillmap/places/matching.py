"""Constraints between two sessions: keyframes of one registered to submaps of the other.

In the plane by the evidence that also verifies loops, in 3D sweep by sweep.
"""

from collections.abc import Iterator
from enum import Enum
from typing import NamedTuple

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.places.keyframes import Keyframes, join_keyframes
from stillmap.places.place import PlacedSession
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
        submap = loop_verification.build_submap(context, stretch * loop_verification.SUBMAP_TRAVEL)
        for node, nearest in members:
            earlier, later = int(reference.nodes[nearest]), K + int(session.nodes[node])
            T = se2.inverse(context.poses[earlier]) @ context.poses[later]
            closure = loop_verification.verify_candidate(
                context, submap, LoopCandidate(earlier, later, T, 0.0), *std, _FITS
            )
            occluded = scan_matching.occluded_share(
                submap, context.hits(later), context.poses[earlier] @ closure.T
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
    if closure.comparable >= loop_verification.MIN_COMPARABLE:
        if occluded > scan_matching.MAX_OCCLUDED or closure.explained < _CONTRADICTS:
            verdict = Verdict.CONTRADICTS
        elif not closure.rejected:
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
