"""Poses of scans in the map or in a submap that no constraint ties to it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.live.beam_store import join_parts
from stillmap.live.history import Answers

Float = NDArray[np.float64]
Index = NDArray[np.int64]

_MIN_SCANS = 20  # of a map of its own


@dataclass(frozen=True, eq=False)
class Placement(ShortRepr):
    """Poses of T scans, each in the map or in a submap.

    Attributes:
        poses: (T, D+1, D+1) T_map_base, in the frame of the submap.
        submap: (T,) 0: the map. From 1 on: a submap that nothing ties to it, one for each time that
            the robot was lost and not found. -1: the pose is not known.
    """

    poses: Float
    submap: Index

    def select(self, scans: Index) -> "Placement":
        """That of some scans."""
        return Placement(self.poses[scans], self.submap[scans])

    def known_poses(self) -> Float:
        """(T, D+1, D+1) T_map_base; NaN where the place in the map is not known."""
        return np.where((self.submap == 0)[:, None, None], self.poses, np.nan)

    @property
    def main(self) -> int:
        """Number of the map, or of the largest submap, if no scan is in the map."""
        counts = np.bincount(self.submap[self.submap >= 0])
        return 0 if not len(counts) or counts[0] else int(np.argmax(counts))

    def others(self) -> list[int]:
        """Numbers of the submaps beside that one which are large enough for a map of their own."""
        numbers, counts = np.unique(self.submap, return_counts=True)
        large = numbers[(numbers >= 0) & (numbers != self.main) & (counts >= _MIN_SCANS)]
        return [int(number) for number in large]


def take_scans(
    recording: Recording, answers: Answers, scans: Index, scratch: Path | None
) -> tuple[Recording, Answers]:
    """A recording of some of the scans, and the answers to them.

    Args:
        recording: as pushed.
        answers: to its scans.
        scans: (n,) rising.
        scratch: folder of temporary files; None: the system's.

    Raises:
        OSError: the disk is full.
    """
    if len(scans) == recording.n_scans:
        return recording, answers
    arrays = [recording.points, recording.hit, answers.p_static]
    if recording.beam_time is not None:
        arrays.append(recording.beam_time)
    runs = np.split(scans, np.flatnonzero(np.diff(scans) > 1) + 1) if len(scans) else []
    spans = [slice(recording.offset[run[0]], recording.offset[run[-1] + 1]) for run in runs]
    fields = [[array[span] for span in spans or [slice(0, 0)]] for array in arrays]
    points, hit, p_static, *times = join_parts(fields, scratch)
    counts = np.diff(recording.offset)[scans]
    odometry = recording.T_odom_base
    taken = replace(
        recording,
        stamp_ns=recording.stamp_ns[scans],
        offset=np.concatenate([np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)]),
        points=points,
        hit=hit,
        sensor=recording.sensor[scans],
        T_odom_base=None if odometry is None else odometry[scans],
        beam_time=times[0] if times else None,
    )
    given = Answers(
        answers.number[scans],
        answers.poses[scans],
        answers.local[scans],
        answers.anchor[scans],
        p_static,
    )
    return taken, given
