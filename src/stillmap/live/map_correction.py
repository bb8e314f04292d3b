"""Corrections of the map after loop closure, applied in parts so that no scan waits for them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.short_repr import ShortRepr
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter, take_over
from stillmap.live.local_map import LocalMap, MappedScan
from stillmap.live.loop_closer import Correction
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]

_BLOCKS_PER_STEP, _SCANS_PER_STEP = 24, 4  # about 2 ms each
# m that any spaced scan and that the last one move, and rad that it turns, up to which the map
# stays as it is: constraints of loops have such errors themselves
_SMALL = 0.1, 0.03, 0.005
_MIN_SHIFT = 0.5  # cells by which the map must move for its cells to be moved


@dataclass(frozen=True, eq=False)
class LabelledScan(ShortRepr):
    """A scan that was added to the labels.

    Attributes:
        beams: of the scan.
        T: (3, 3) pose of the base in the frame of the odometry by scans.
        normals: (N, D), as of `CausalLabels.add`.
        tag: likewise.
    """

    beams: ScanBeams
    T: Float
    normals: Float
    tag: int


class MapCorrection:
    """Applies a correction of the pose graph to labels and local map, a part per scan.

    Args:
        correction: of the pose graph.
        labels: of the map so far.
        spaced: (S, 3, 3) poses of the spaced scans in the frame of the odometry by scans.
        poses: (S, 3, 3) the same in the map so far.
    """

    def __init__(
        self, correction: Correction, labels: CausalLabels, spaced: Float, poses: Float
    ) -> None:
        self.T_map_local = correction.T_map_local
        self.poses = np.concatenate(
            [correction.poses, correction.T_map_local @ spaced[len(correction.poses) :]]
        )
        self.local_map = LocalMap(labels.resolution)
        self._motion = self.poses @ se2.inverse(poses)
        self._source: OccupancyFilter = labels.filter
        shift = np.hypot(*(self.poses - poses)[:, :2, 2].T)
        turn = abs(float(se2.parameters(self._motion[-1])[2]))
        self.is_small = bool(shift.max() < _SMALL[0] and shift[-1] < _SMALL[1] and turn < _SMALL[2])
        self.moves_cells = bool(shift.max() > _MIN_SHIFT * labels.resolution)
        self.filter: OccupancyFilter = self._source.sibling() if self.moves_cells else self._source
        self._block, self._scans = 0, sorted(correction.near, key=lambda scan: scan.travelled)
        self._labelled: list[LabelledScan] = []
        self._added: list[MappedScan] = []

    def note_labelled(self, scan: LabelledScan) -> None:
        """Tell of a scan that was added to the labels meanwhile."""
        if self.moves_cells:
            self._labelled.append(scan)

    def note_added(self, scan: MappedScan) -> None:
        """Tell of a scan that was added to the local map meanwhile."""
        self._added.append(scan)

    def step(self) -> bool:
        """Do a part of the work; True when nothing is left."""
        if self.moves_cells and self._block < self._source.block_count:
            self._block = take_over(
                self.filter, self._source, self._motion, self._block, _BLOCKS_PER_STEP
            )
            return False
        if self._scans:
            self.local_map.extend(self._scans[:_SCANS_PER_STEP])
            self._scans = self._scans[_SCANS_PER_STEP:]
            return False
        return True

    def finish(self, labels: CausalLabels) -> None:
        """Replace the cells of the labels, and catch up with what came meanwhile."""
        self.local_map.extend(self._added)
        if not self.moves_cells:
            return
        labels.filter = self.filter
        for scan in self._labelled:
            T = self.T_map_local @ scan.T
            labels.add(scan.beams, T, scan.normals, scan.tag)
