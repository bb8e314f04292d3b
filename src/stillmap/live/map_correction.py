"""Corrections of the map after loop closure, applied in parts so that no scan waits for them."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.short_repr import ShortRepr
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter, take_over
from stillmap.live.local_map import LocalMap, MappedScan
from stillmap.live.loop_closer import Correction, is_small
from stillmap.live.observation import Observation

Float = NDArray[np.float64]

# blocks of cells in 2D and 3D, scans of the local map: about 2 ms each, in 3D 15 ms
_BLOCKS_PER_STEP, _SCANS_PER_STEP = {2: 24, 3: 500}, 2
_ADDED_PER_STEP = {2: 2, 3: 1}  # scans that came meanwhile
# spaced scans that move their cells alike: between neighbours corrections hardly differ
SPACED_PER_TAG = {2: 4, 3: 1}
_KEPT_EVERY_NS = {2: 0, 3: 500_000_000}  # between two of them
_MIN_SHIFT = 0.5  # cells by which the map must move for its cells to be moved


@dataclass(frozen=True, eq=False)
class LabelledScan(ShortRepr):
    """A scan that was added to the labels.

    Attributes:
        observation: of the scan.
        T: (D+1, D+1) pose of the base in the frame of the odometry by scans.
    """

    observation: Observation
    T: Float


class MapCorrection:
    """Applies a correction of the pose graph to labels and local map, a part per scan.

    Args:
        correction: of the pose graph.
        labels: of the map so far.
        spaced: (S, D+1, D+1) poses of the spaced scans in the frame of the odometry by scans.
        poses: (S, D+1, D+1) the same in the map so far.
        tagged: (K,) spaced scans with which the cells of each tag move.
    """

    def __init__(
        self,
        correction: Correction,
        labels: CausalLabels,
        spaced: Float,
        poses: Float,
        tagged: NDArray[np.int64],
    ) -> None:
        self.T_map_local, self.untied = correction.T_map_local, correction.untied
        self.count = len(correction.poses)  # of the spaced scans that were known
        self.poses = np.concatenate(
            [correction.poses, correction.T_map_local @ spaced[len(correction.poses) :]]
        )
        self._D = poses.shape[-1] - 1
        # in 3D the local map moves with its frame: it holds what is near, not what loops tie to it
        self.local_map = LocalMap(labels.resolution) if self._D == 2 else None
        tagged = np.minimum(tagged, len(poses) - 1)
        self._motion = self.poses[tagged] @ se2.inverse(poses[tagged])
        self._source: OccupancyFilter = labels.filter
        D = self._D
        shift = np.linalg.norm((self.poses - poses)[:, :D, D], axis=1)
        self.is_small = is_small(poses, self.poses, self._motion[-1])
        self.moves_cells = bool(shift.max() > _MIN_SHIFT * labels.resolution)
        self.filter: OccupancyFilter = self._source.sibling() if self.moves_cells else self._source
        self._block = 0
        self._scans = deque(sorted(correction.near, key=lambda scan: scan.travelled))
        self._labelled = deque[LabelledScan]()
        self._kept_ns = 0

    def note_labelled(self, scan: LabelledScan) -> None:
        """Tell of a scan that was added to the labels meanwhile."""
        stamp_ns = scan.observation.beams.stamp_ns
        if self.moves_cells and stamp_ns - self._kept_ns >= _KEPT_EVERY_NS[self._D]:
            self._labelled.append(scan)
            self._kept_ns = stamp_ns

    def note_added(self, scan: MappedScan) -> None:
        """Tell of a scan that was added to the local map meanwhile."""
        self._scans.append(scan)

    def step(self, labels: CausalLabels) -> bool:
        """Do a part of the work; True when nothing is left."""
        if labels.tags > len(self._motion):  # scans that came meanwhile move as the last one
            more = labels.tags - len(self._motion)
            self._motion = np.concatenate([self._motion, self._motion[-1:].repeat(more, axis=0)])
        if self.moves_cells and self._block < self._source.block_count:
            count = _BLOCKS_PER_STEP[self._D]
            self._block = take_over(self.filter, self._source, self._motion, self._block, count)
            return False
        if self._scans and self.local_map is not None:
            for _ in range(min(_SCANS_PER_STEP, len(self._scans))):
                self.local_map.extend([self._scans.popleft()])
            return False
        for _ in range(min(_ADDED_PER_STEP[self._D], len(self._labelled))):
            scan = self._labelled.popleft()
            labels.add(scan.observation, self.T_map_local @ scan.T, self.filter)
        return not self._labelled

    def finish(self, labels: CausalLabels) -> None:
        """Replace the cells of the labels."""
        if self.moves_cells:
            labels.filter = self.filter
