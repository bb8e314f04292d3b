"""A corrected map, taken over a little with every scan: no scan waits for all of it."""

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
    """What is left to do until a correction is taken over.

    Args:
        correction: of the pose graph.
        labels: of the map so far.
        T_map_local: (3, 3) of the frame of the odometry by scans in the map so far.
        tags: number of spaced scans so far.
    """

    def __init__(
        self, correction: Correction, labels: CausalLabels, T_map_local: Float, tags: int
    ) -> None:
        self.correction = correction
        self.local_map = LocalMap(labels.resolution)
        self._source: OccupancyFilter = labels.filter
        since = correction.T_map_local @ se2.inverse(T_map_local)  # of scans after the request
        rest = np.broadcast_to(since, (max(tags - len(correction.motion), 0) + 1, 3, 3))
        self._motion = np.concatenate([correction.motion, rest])
        self.moves_cells = _largest_shift(correction) > _MIN_SHIFT * labels.resolution
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
            T = self.correction.T_map_local @ scan.T
            labels.add(scan.beams, T, scan.normals, scan.tag)


def _largest_shift(correction: Correction) -> float:
    """m by which any spaced scan moves."""
    after = correction.poses
    before = se2.inverse(correction.motion) @ after
    return float(np.hypot(*(after[:, :2, 2] - before[:, :2, 2]).T).max(initial=0.0))
