"""A session as a place keeps it: its keyframes, poses and pose graph."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np

from stillmap import em
from stillmap.core import se2, se3
from stillmap.core.array_types import Float, Float32, Index, Int64
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.mapping.projection import project_to_plane
from stillmap.slam import PoseGraph, local_map
from stillmap.slam.local_map import KEYFRAME_ANGLE
from stillmap.slam.pose_graph import Constraint
from stillmap.slam.scan_hits import beams_of_scans, select_beams

# between keyframes: m of travel, rad, s of standing still; in 3D sweeps see farther
_SPACING = {2: (0.25, 0.2, 4.0), 3: (1.0, 0.5, 4.0)}
_NODE_DISTANCE = {2: 1.0, 3: 2.0}  # m between the nodes of a session without a pose graph
# of a step between them: m and rad, at least, and per root of a metre
_STEP_STD, _MIN_STEP = (0.01, 0.002), 0.05
_PLANAR_CELL = 0.1  # m, in which one planar hit per direction is kept
_MAX_BEAMS = 24_000  # of a keyframe: denser sweeps are thinned evenly, which registration allows


@dataclass(frozen=True, eq=False)
class Keyframes(ShortRepr):
    """K spaced scans of a session with M beams, without motion during the scans.

    Attributes:
        recording: the scans, deskewed, without odometry and images.
        scans: (K,) their numbers in the session's recording.
        poses: (K, D+1, D+1) T_session_base.
        e: (M,) float32, P(static) of every beam; 0: unusable.
        nodes: (N,) indices of those that are nodes of the pose graph, rising.
    """

    recording: Recording
    scans: Index
    poses: Float
    e: Float32
    nodes: Index

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.recording.dimension

    def __len__(self) -> int:
        return len(self.scans)


@dataclass(frozen=True, eq=False)
class Session(ShortRepr):
    """A mapped recording of T scans.

    Attributes:
        name: unique in its place.
        input: its path, as it was given; None: it had none.
        stamp_ns: (T,) the recording's own stamps.
        poses: (T, D+1, D+1) T_session_base.
        graph: the session's own pose graph, in the session's frame.
        keyframes: scans in D dimensions, spaced by travel.
        band: m above the ground, lowest and greatest height of obstacles.
        origin: (3,) m, of the session's frame, in the map frame of the result that it is from.
        threads: number of threads that project the keyframes.
    """

    name: str
    input: str | None
    stamp_ns: Int64
    poses: Float
    graph: PoseGraph
    keyframes: Keyframes
    band: tuple[float, float]
    origin: Float
    threads: int = 1

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.keyframes.dimension

    @property
    def node_poses(self) -> Float:
        """(N, D+1, D+1) T_session_base of the nodes of the pose graph."""
        return self.poses[self.graph.keyframes]

    @property
    def planar(self) -> Keyframes:
        """The keyframes in the plane; in 2D they themselves."""
        return self._projection[0]

    @property
    def clearance(self) -> Float:
        """(K,) height of the base of each keyframe above the ground, metres; 0 in 2D."""
        return self._projection[1]

    @cached_property
    def _projection(self) -> tuple[Keyframes, Float]:
        if self.dimension == 2:
            return self.keyframes, np.zeros(len(self.keyframes))
        return _project(self.keyframes, self.band, self.threads)


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


def chain_poses(poses: Float) -> PoseGraph:
    """A pose graph of poses (T, D+1, D+1) that no graph came with: steps between keyframes."""
    D = poses.shape[-1] - 1
    nodes = local_map.select_keyframes(poses, _NODE_DISTANCE[D], KEYFRAME_ANGLE)
    steps = se2.inverse(poses[nodes[:-1]]) @ poses[nodes[1:]]
    metres = np.linalg.norm(steps[:, :D, D], axis=1) + _MIN_STEP
    turns = D * (D - 1) // 2
    unit = np.diag(np.square([_STEP_STD[0]] * D + [_STEP_STD[1]] * turns))
    motions = enumerate(zip(steps, metres.tolist(), strict=True))
    chain = [Constraint(k, k + 1, T, length * unit) for k, (T, length) in motions]
    return PoseGraph(nodes, poses[nodes], chain)


def select_keyframes(
    deskewed: Recording, poses: Float, p_static: Float32, nodes: Index
) -> Keyframes:
    """The keyframes of a session.

    Args:
        deskewed: T scans with M beams.
        poses: (T, D+1, D+1) T_session_base.
        p_static: (M,) P(static) of every beam.
        nodes: (N,) scans that are nodes of the pose graph, rising.
    """
    scans = np.union1d(space_scans(deskewed, poses), nodes)
    beams = beams_of_scans(deskewed, scans, _MAX_BEAMS)
    recording = select_beams(deskewed, scans, beams, None)
    e = np.nan_to_num(p_static[np.concatenate(beams)], nan=0.0).astype(np.float32)
    return Keyframes(recording, scans, poses[scans], e, np.searchsorted(scans, nodes))


def space_scans(recording: Recording, poses: Float) -> Index:
    """(K,) scans of each sensor, spaced by travel, turn and time; always the first of each."""
    metres, radians, seconds = _SPACING[recording.dimension]
    progress = _progress(recording.stamp_ns, poses, metres, radians, seconds)
    kept = []
    for sensor in np.unique(recording.sensor):
        scans = np.flatnonzero(recording.sensor == sensor)
        # the first scan past each whole unit of progress
        kept.append(scans[np.unique(np.floor(progress[scans]), return_index=True)[1]])
    return np.sort(np.concatenate(kept))


def _progress(
    stamp_ns: Int64, poses: Float, metres: float, radians: float, seconds: float
) -> Float:
    """(T,) sum of travel, turn and time up to each scan, in units of the spacing."""
    steps = se2.increments(poses)
    travel = np.linalg.norm(steps[:, :-1, -1], axis=1)
    if poses.shape[-1] == 3:
        turn = np.abs(se2.parameters(steps)[:, 2])
    else:
        turn = np.linalg.norm(se3.log_rotation(steps[:, :3, :3]), axis=-1)
    gaps = np.minimum(1e-9 * np.diff(stamp_ns), seconds)  # a pause adds one keyframe at most
    units = travel / metres + turn / radians + gaps / seconds
    return np.concatenate([[0.0], units.cumsum()])


def join_keyframes(sessions: Sequence[Keyframes]) -> Keyframes:
    """The keyframes of some sessions, one or more, as those of one; poses are still each in its own
    frame."""
    recordings = [part.recording for part in sessions]

    def join(name: str, parts: Sequence[Any], firsts: Sequence[int] | None = None) -> Any:
        arrays = [getattr(part, name) for part in parts]
        if firsts is not None:  # numbers, which go on from one part to the next
            arrays = [array + first for array, first in zip(arrays, firsts, strict=True)]
        return np.concatenate(arrays)

    def begins(counts: Iterable[int]) -> list[int]:
        return [0, *accumulate(counts)][: len(sessions)]

    sensors = join("sensor", recordings, begins(len(part.T_base_sensor) for part in recordings))
    counts = np.concatenate([np.diff(part.offset) for part in recordings])
    recording = replace(
        recordings[0],
        **{name: join(name, recordings) for name in ("stamp_ns", "points", "hit", "T_base_sensor")},
        offset=np.concatenate([np.zeros(1, np.int64), counts.cumsum()]),
        sensor=sensors.astype(np.int32),
    )
    own = {name: join(name, sessions) for name in ("scans", "poses", "e")}
    return Keyframes(recording, nodes=join("nodes", sessions, begins(map(len, sessions))), **own)
