"""Constraints between two 3D sessions: sweeps of one registered to submaps of the other."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.places.keyframes import join_keyframes
from stillmap.places.matching import SESSION_GAP, KeyframeMatch, Verdict
from stillmap.places.place import PlacedSession
from stillmap.slam.lidar_odometry import LidarOdometry
from stillmap.slam.local_map import travelled_distance
from stillmap.slam.loop_closure_3d import SweepLoopCloser

Float = NDArray[np.float64]

_REACH = 20.0  # m between a node and the one of the other session whose submap it is matched with
_USUAL_EXPLAINED = 0.8  # share of a sweep that the map of its own session explains
_MAX_NODES = 40  # that are registered: each takes long, and neighbours say the same


def match_sessions(
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
    one, other = reference.session.keyframes, placed.session.keyframes
    both = join_keyframes([one, other])
    poses = np.concatenate([reference.keyframe_poses, placed.keyframe_poses])
    travelled = travelled_distance(poses)
    travelled[len(one) :] += SESSION_GAP
    T = len(poses)
    odometry = LidarOdometry(
        poses, np.zeros((T, 6)), np.zeros((T, 6, 6)), np.full(T, _USUAL_EXPLAINED)
    )
    closer = SweepLoopCloser(
        both.recording, both.e, odometry, travelled, np.arange(T), _REACH, threads
    )
    theirs = poses[one.nodes, :3, 3]
    out = []
    step = max(-(-len(nodes) // _MAX_NODES), 1)
    for node in nodes[::step]:
        later = len(one) + int(other.nodes[node])
        distance = np.linalg.norm(theirs - poses[later, :3, 3], axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] > _REACH:
            continue
        earlier = int(one.nodes[nearest])
        closure = closer.verify(earlier, later, se2.inverse(poses[earlier]) @ poses[later], *std)
        out.append(
            KeyframeMatch(
                node,
                nearest,
                closure.T,
                closure.covariance,
                closure.explained,
                1.0,
                0.0,
                Verdict.CONTRADICTS if closure.rejected else Verdict.FITS,
            )
        )
    return out
