"""A session: one mapped recording as a place keeps it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stillmap.core.local_frame import LocalFrame
from stillmap.core.short_repr import ShortRepr
from stillmap.places.keyframes import Keyframes
from stillmap.slam import PoseGraph

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Session(ShortRepr):
    """A mapped recording of T scans.

    Attributes:
        name: unique in its place.
        input: its path, as it was given; None: it had none.
        stamp_ns: (T,) the recording's own stamps.
        poses: (T, D+1, D+1) T_session_base.
        graph: the session's own pose graph, in the session's frame.
        keyframes: spaced scans in D dimensions.
        planar: the same scans in the plane; in 2D the keyframes themselves.
        clearance: (K,) height of the base of each keyframe above the ground, metres; 0 in 2D.
        frame: the session's frame, in the map frame of the result that it was made from.
    """

    name: str
    input: str | None
    stamp_ns: NDArray[np.int64]
    poses: Float
    graph: PoseGraph
    keyframes: Keyframes
    planar: Keyframes
    clearance: Float
    frame: LocalFrame = field(default_factory=LocalFrame)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.keyframes.dimension

    @property
    def node_poses(self) -> Float:
        """(N, D+1, D+1) T_session_base of the nodes of the pose graph."""
        return self.poses[self.graph.keyframes]
