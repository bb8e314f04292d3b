"""A session as a place keeps it: its keyframes, poses and pose graph."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stillmap.core import se2, se3
from stillmap.core.array_types import Float, Float32, Index, Int64
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.slam import PoseGraph
from stillmap.slam.scan_hits import beams_of_scans, select_beams

# between keyframes: m of travel, rad, s of standing still; in 3D sweeps see farther
_SPACING = {2: (0.25, 0.2, 4.0), 3: (1.0, 0.5, 4.0)}
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
        planar: the same scans in the plane; in 2D the keyframes themselves.
        clearance: (K,) height of the base of each keyframe above the ground, metres; 0 in 2D.
        origin: (3,) m, of the session's frame, in the map frame of the result that it is from.
    """

    name: str
    input: str | None
    stamp_ns: Int64
    poses: Float
    graph: PoseGraph
    keyframes: Keyframes
    planar: Keyframes
    clearance: Float
    origin: Float = field(default_factory=lambda: np.zeros(3))

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.keyframes.dimension

    @property
    def node_poses(self) -> Float:
        """(N, D+1, D+1) T_session_base of the nodes of the pose graph."""
        return self.poses[self.graph.keyframes]


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
    steps = se2.inverse(poses[:-1]) @ poses[1:]
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
    beams = np.cumsum([0, *(part.n_beams for part in recordings)])
    sensors = np.cumsum([0, *(len(part.T_base_sensor) for part in recordings)])
    keyframes = np.cumsum([0, *(len(part) for part in sessions)])
    ends = [part.offset[1:] + first for part, first in zip(recordings, beams, strict=False)]
    recording = replace(
        recordings[0],
        stamp_ns=np.concatenate([part.stamp_ns for part in recordings]),
        offset=np.concatenate([np.zeros(1, np.int64), *ends]),
        points=np.concatenate([part.points for part in recordings]),
        hit=np.concatenate([part.hit for part in recordings]),
        T_base_sensor=np.concatenate([part.T_base_sensor for part in recordings]),
        sensor=np.concatenate(
            [part.sensor + first for part, first in zip(recordings, sensors, strict=False)],
            dtype=np.int32,
            casting="same_kind",
        ),
    )
    return Keyframes(
        recording,
        np.concatenate([part.scans for part in sessions]),
        np.concatenate([part.poses for part in sessions]),
        np.concatenate([part.e for part in sessions]),
        np.concatenate([part.nodes + k for part, k in zip(sessions, keyframes, strict=False)]),
    )
