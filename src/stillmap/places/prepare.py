"""From a mapped recording to a session: keyframes and pose graph."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.core import se2
from stillmap.core.local_frame import LocalFrame
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.mapping.projection import project_to_plane
from stillmap.places.keyframes import Keyframes, select_keyframes
from stillmap.places.session import Session
from stillmap.slam import PoseGraph, local_map
from stillmap.slam.local_map import KEYFRAME_ANGLE
from stillmap.slam.pose_graph import Constraint

Float = NDArray[np.float64]

_NODE_DISTANCE = {2: 1.0, 3: 2.0}  # m between the nodes of a session without a pose graph
# of a step between them: m and rad, at least, and per root of a metre
_STEP_STD, _MIN_STEP = (0.01, 0.002), 0.05
_PLANAR_CELL = 0.1  # m, in which one planar hit per direction is kept


@dataclass(frozen=True, eq=False)
class MappedRecording(ShortRepr):
    """A recording of T scans with M beams that was mapped, just now or earlier.

    Attributes:
        name: unique in its place.
        deskewed: without the motion during its scans.
        poses: (T, D+1, D+1) T_map_base.
        p_static: (M,) P(static).
        graph: the pose graph; None: there is none.
        band: m above the ground, lowest and greatest height of obstacles.
        threads: number of threads.
        frame: that of the poses, in the map frame of the result.
    """

    name: str
    deskewed: Recording
    poses: Float
    p_static: NDArray[np.float32]
    graph: PoseGraph | None
    band: tuple[float, float]
    threads: int = 1
    frame: LocalFrame = field(default_factory=LocalFrame)


def make_session(mapped: MappedRecording) -> Session:
    """The session of a mapped recording."""
    deskewed, poses = mapped.deskewed, mapped.poses
    graph = mapped.graph or chain_poses(poses)
    keyframes = select_keyframes(deskewed, poses, mapped.p_static, graph.keyframes)
    planar, clearance = keyframes, np.zeros(len(keyframes))
    if keyframes.dimension == 3:
        planar, clearance = _project(keyframes, mapped.band, mapped.threads)
    return Session(
        mapped.name,
        None,
        deskewed.stamp_ns,
        poses,
        graph,
        keyframes,
        planar,
        clearance,
        mapped.frame,
    )


def chain_poses(poses: Float) -> PoseGraph:
    """A pose graph of poses (T, D+1, D+1) that no graph came with: steps between keyframes."""
    D = poses.shape[-1] - 1
    nodes = local_map.select_keyframes(poses, _NODE_DISTANCE[D], KEYFRAME_ANGLE)
    steps = se2.inverse(poses[nodes[:-1]]) @ poses[nodes[1:]]
    metres = np.linalg.norm(steps[:, :D, D], axis=1) + _MIN_STEP
    turns = D * (D - 1) // 2
    unit = np.diag(np.square([_STEP_STD[0]] * D + [_STEP_STD[1]] * turns))
    chain = [
        Constraint(k, k + 1, T, length * unit)
        for k, (T, length) in enumerate(zip(steps, metres.tolist(), strict=True))
    ]
    return PoseGraph(nodes, poses[nodes], chain)


def _project(
    keyframes: Keyframes, band: tuple[float, float], threads: int
) -> tuple[Keyframes, Float]:
    """Keyframes of a 3D session in the plane, and the clearance (K,) of each above the ground."""
    recording, poses = keyframes.recording, keyframes.poses
    ground = em.estimate_ground(recording, poses, keyframes.e, threads)
    plan = project_to_plane(recording, poses, ground, band, _PLANAR_CELL, False, threads)
    e = keyframes.e[plan.beam]
    planar = Keyframes(plan.recording, keyframes.scans, plan.poses, e, keyframes.nodes)
    xy = np.ascontiguousarray(poses[:, :2, 3])
    return planar, poses[:, 2, 3] - ground.height_at(xy)
