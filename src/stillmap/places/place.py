"""A place: sessions in one frame, the constraints between them, and what stands where when."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stillmap.core import se2, se3
from stillmap.core.array_types import Bool, Float
from stillmap.core.short_repr import ShortRepr
from stillmap.places.evidence import Evidence, measure_evidence
from stillmap.places.keyframes import Session
from stillmap.slam import pose_graph
from stillmap.slam.local_map import propagate_corrections
from stillmap.slam.pose_graph import Constraint

MAX_CHI2 = {2: 16.0, 3: 25.0}  # above it the graph rejects a constraint between sessions
_INDEPENDENT = 0.3  # share of a match that is evidence of its own: neighbours share their errors
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


def join_constraints(
    sessions: Sequence[Session], ties: Sequence[Tie]
) -> tuple[list[Constraint], list[Constraint]]:
    """The constraints of all sessions, and those between them, of nodes numbered through."""
    first = np.cumsum([0, *(len(session.graph.keyframes) for session in sessions)]).tolist()
    chain = [
        Constraint(k + c.first, k + c.second, c.T, c.covariance)
        for k, session in zip(first, sessions, strict=False)
        for c in session.graph.constraints
    ]
    loops = [
        Constraint(
            first[tie.first] + tie.first_node,
            first[tie.second] + tie.second_node,
            tie.T,
            tie.covariance,
        )
        for tie in ties
    ]
    return chain, loops


def optimize_nodes(
    sessions: Sequence[Session], start: Sequence[Float], ties: Sequence[Tie]
) -> tuple[list[Float], Bool]:
    """Poses of all nodes in the place, of least squares; the first node stays.

    Args:
        sessions: of the place.
        start: of each session (N, D+1, D+1) poses of its nodes in the place.
        ties: between sessions; contradicted ones lose their weight.

    Returns:
        the poses, and which ties (L,) agree with them.
    """
    chain, loops = join_constraints(sessions, ties)
    max_chi2 = MAX_CHI2[sessions[0].dimension]
    everything = np.concatenate(start)
    poses = pose_graph.optimize_poses(everything, chain, loops, max_chi2)
    agree = pose_graph.squared_mahalanobis(poses, loops) <= max_chi2
    kept = [loop for loop, agrees in zip(loops, agree.tolist(), strict=True) if agrees]
    poses = pose_graph.optimize_poses(poses, chain, kept)
    ends = np.cumsum([len(nodes) for nodes in start])
    return np.split(poses, ends[:-1]), agree


def fit_alignment(session_poses: Float, place_poses: Float) -> Float:
    """(D+1, D+1) T_place_session that maps poses (N, D+1, D+1) of a session best to those in the
    place, in the sense of least squares of positions and of the ends of their axes."""
    D = session_poses.shape[-1] - 1
    tips = np.concatenate([np.zeros((D, 1)), _LEVER * np.eye(D)], axis=1)
    ours, theirs = (
        np.swapaxes(T[:, :D, :D] @ tips + T[:, :D, D:], 1, 2).reshape(-1, D)
        for T in (session_poses, place_poses)
    )
    return se2.align_points(ours, theirs)


# of a cell, by which keyframes may move before the evidence of their session is measured again
MAX_MOTION = 0.5


@dataclass(frozen=True, eq=False)
class PlacedSession(ShortRepr):
    """A session with its poses in the place.

    Attributes:
        session: T scans, K keyframes, N nodes.
        nodes: (N, D+1, D+1) T_place_base of the nodes of its pose graph.
        covariance: (3, 3), in 3D (6, 6), of its alignment at its first scan; 0 of the first.
        overlap: share of its hits in area that the sessions before it knew; 1 of the first.
        evidence: in D dimensions and in the plane, in 2D the same; None: not measured yet.
        measured_at: (K, D+1, D+1) poses of the keyframes at which evidence was measured.
    """

    session: Session
    nodes: Float
    covariance: Float
    overlap: float = 1.0
    evidence: tuple[Evidence, Evidence] | None = None
    measured_at: Float | None = None

    @property
    def T(self) -> Float:
        """(D+1, D+1) T_place_session, where the first scan is."""
        return np.asarray(self.nodes[0] @ se2.inverse(self.session.node_poses[0]))

    @cached_property
    def poses(self) -> Float:
        """(T, D+1, D+1) T_place_base of all scans."""
        about = fit_alignment(self.session.node_poses, self.nodes) @ self.session.poses
        return propagate_corrections(about, self.session.graph.keyframes, self.nodes)

    @property
    def keyframe_poses(self) -> Float:
        """(K, D+1, D+1) T_place_base of the keyframes."""
        return self.poses[self.session.keyframes.scans]

    @property
    def planar_poses(self) -> Float:
        """(K, 3, 3) poses of the planar keyframes."""
        return to_planar(self.session, self.keyframe_poses)

    def require_evidence(self) -> tuple[Evidence, Evidence]:
        """The evidence in D dimensions and in the plane.

        Raises:
            RuntimeError: it has not been measured.
        """
        if self.evidence is None:
            raise RuntimeError("evidence has not been measured")
        return self.evidence


def to_planar(session: Session, keyframe_poses: Float) -> Float:
    """(K, 3, 3) poses of the planar keyframes at poses (K, D+1, D+1) of the keyframes."""
    if session.dimension == 2:
        return keyframe_poses
    return se2.project_to_plane(session.keyframes.recording.T_map_sensor(keyframe_poses))


@dataclass(frozen=True, eq=False)
class Place(ShortRepr):
    """Sessions in one frame.

    Attributes:
        sessions: in the order in which they were merged.
        ties: constraints between them.
        resolution: m, edge of a cell of the map; in 3D `voxel_size` is that of a voxel.
        voxel_size: m, edge of a cell of the evidence in D dimensions.
        frame: name of the session that has its frame; None: the first one.
    """

    sessions: list[PlacedSession]
    ties: list[Tie]
    resolution: float
    voxel_size: float
    frame: str | None = None

    @property
    def home(self) -> Session:
        """The session that has its frame."""
        named = self.frame or self.sessions[0].session.name
        return next(placed.session for placed in self.sessions if placed.session.name == named)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.sessions[0].session.dimension

    def in_time(self) -> list[PlacedSession]:
        """The sessions in the order of their first stamps; ties as they were merged."""
        return sorted(self.sessions, key=lambda placed: int(placed.session.stamp_ns[0]))

    def with_nodes(self, nodes: Sequence[Float]) -> "Place":
        """The place with other poses of the nodes of every session."""
        moved = [replace(placed, nodes=of) for placed, of in zip(self.sessions, nodes, strict=True)]
        return replace(self, sessions=moved)


def update_evidence(place: Place, threads: int, max_motion: float = MAX_MOTION) -> Place:
    """The place with the evidence of sessions whose keyframes moved measured again.

    max_motion: cells, up to which evidence holds.
    """
    limit = max_motion * min(place.resolution, place.voxel_size)
    sessions = [_measure(placed, place, limit, threads) for placed in place.sessions]
    return replace(place, sessions=sessions)


def _measure(placed: PlacedSession, place: Place, limit: float, threads: int) -> PlacedSession:
    session, poses = placed.session, placed.keyframe_poses
    if placed.measured_at is not None:
        moved = np.linalg.norm((poses - placed.measured_at)[:, :-1, -1], axis=1)
        if moved.max() <= limit:
            if placed.evidence is not None:
                return placed
            poses = placed.measured_at  # of a place that was read: as it was
    planar = measure_evidence(session.planar, to_planar(session, poses), place.resolution, threads)
    evidence = planar
    if session.dimension == 3:
        evidence = measure_evidence(session.keyframes, poses, place.voxel_size, threads)
    return replace(placed, evidence=(evidence, planar), measured_at=poses)


def combine_covariances(poses: Float, covariances: Sequence[Float]) -> Float:
    """Covariance of the frame of poses (N, D+1, D+1), each measured with a covariance.

    (3, 3) of x, y, heading; (6, 6) of translation and rotation vector in 3D.
    """
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
