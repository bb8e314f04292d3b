"""The pose graph of a place: the graphs of all sessions, and constraints between them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.short_repr import ShortRepr
from stillmap.places.session import Session
from stillmap.slam import pose_graph
from stillmap.slam.local_map import propagate_corrections
from stillmap.slam.pose_graph import Constraint

Float = NDArray[np.float64]

MAX_CHI2 = {2: 16.0, 3: 25.0}  # above it the graph rejects a constraint between sessions
_LEVER = 2.0  # m at which an error of the heading counts like one of the position


@dataclass(frozen=True, eq=False)
class Tie(ShortRepr):
    """A measured relative pose of nodes of two sessions.

    Attributes:
        first, second: sessions, by their index in the place.
        first_node, second_node: indices into the nodes of each.
        T: (D+1, D+1) pose of the second node in the frame of the first.
        covariance: as of `Constraint`.
    """

    first: int
    first_node: int
    second: int
    second_node: int
    T: Float
    covariance: Float


def optimize_nodes(
    sessions: Sequence[Session], start: Sequence[Float], ties: Sequence[Tie]
) -> tuple[list[Float], NDArray[np.bool_]]:
    """Poses of all nodes in the place, of least squares; the first node stays.

    Args:
        sessions: of the place.
        start: of each session (N, D+1, D+1) poses of its nodes in the place.
        ties: between sessions; contradicted ones lose their weight.

    Returns:
        the poses, and which ties (L,) agree with them.
    """
    first = np.cumsum([0, *(len(nodes) for nodes in start)])
    chain = [
        Constraint(int(k + c.first), int(k + c.second), c.T, c.covariance)
        for k, session in zip(first, sessions, strict=False)
        for c in session.graph.constraints
    ]
    loops = [
        Constraint(
            int(first[tie.first] + tie.first_node),
            int(first[tie.second] + tie.second_node),
            tie.T,
            tie.covariance,
        )
        for tie in ties
    ]
    max_chi2 = MAX_CHI2[sessions[0].dimension]
    everything = np.concatenate(start)
    found = pose_graph.optimize_poses(everything, chain, loops, max_chi2)
    agree = pose_graph.squared_mahalanobis(found, loops) <= max_chi2
    kept = [loop for loop, agrees in zip(loops, agree.tolist(), strict=True) if agrees]
    found = pose_graph.optimize_poses(found, chain, kept)
    return np.split(found, first[1:-1]), agree


def place_scans(session: Session, T: Float, nodes: Float) -> Float:
    """(T, D+1, D+1) poses of all scans of a session in the place.

    Args:
        session: T scans.
        T: (D+1, D+1) T_place_session, about.
        nodes: (N, D+1, D+1) poses of its nodes in the place.
    """
    return propagate_corrections(T @ session.poses, session.graph.keyframes, nodes)


def fit_alignment(session_poses: Float, place_poses: Float) -> Float:
    """(D+1, D+1) T_place_session that maps poses (N, D+1, D+1) of a session best to those in the
    place, in the sense of least squares of positions and of the ends of their axes."""
    D = session_poses.shape[-1] - 1
    tips = np.concatenate([np.zeros((D, 1)), _LEVER * np.eye(D)], axis=1)
    one, other = (
        np.swapaxes(T[:, :D, :D] @ tips + T[:, :D, D:], 1, 2).reshape(-1, D)
        for T in (session_poses, place_poses)
    )
    centre, their_centre = one.mean(axis=0), other.mean(axis=0)
    U, _, V = np.linalg.svd((other - their_centre).T @ (one - centre))
    sign = np.ones(D)
    sign[-1] = np.sign(np.linalg.det(U @ V))
    T = np.eye(D + 1)
    T[:D, :D] = U @ np.diag(sign) @ V
    T[:D, D] = their_centre - T[:D, :D] @ centre
    return T


def relative_pose(first: Float, second: Float) -> Float:
    """(D+1, D+1) pose of the second in the frame of the first."""
    out: Float = se2.inverse(first) @ second
    return out
