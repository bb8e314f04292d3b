"""Pose of the frame of the odometry by scans in the map, as closed loops correct it."""

import logging
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Int64
from stillmap.core.parallel import trim_heap
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter, take_over
from stillmap.live.local_map import LocalMap, MappedScan, thin_scan
from stillmap.live.loop_closer import Correction, LoopCloser, is_small
from stillmap.live.loop_process import LoopProcess
from stillmap.live.registration import Registration
from stillmap.live.scan import Observation
from stillmap.live.scan_odometry import ScanOdometry
from stillmap.live.sweep_loop_closer import LiveSweepLoopCloser
from stillmap.live.sweep_odometry import SweepOdometry
from stillmap.slam import local_map

# blocks of cells in 2D and 3D, scans of the local map: about 2 ms each, in 3D 15 ms
_BLOCKS_PER_STEP, _SCANS_PER_STEP = {2: 24, 3: 500}, 2
_ADDED_PER_STEP = {2: 2, 3: 1}  # scans that came meanwhile
# spaced scans that move their cells alike: between neighbours corrections hardly differ
SPACED_PER_TAG = {2: 4, 3: 1}
_KEPT_EVERY_NS = {2: 0, 3: 500_000_000}  # between two of them
_MIN_SHIFT = 0.5  # cells by which the map must move for its cells to be moved
LoopClosing = LoopCloser | LiveSweepLoopCloser | LoopProcess
LiveOdometry = ScanOdometry | SweepOdometry

_log = logging.getLogger(__name__)

# beams of a spaced scan in 2D and 3D, for loops and for the local map after them
_MAX_KEPT_BEAMS = {2: 400, 3: 20_000}
_FIRST_SPACED = 256  # spaced scans for which there is room at first
_TRIM_EVERY = 128  # spaced scans after which freed memory is given back: 10 ms after an answer


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
        tagged: Int64,
    ) -> None:
        self._labels, self._D = labels, poses.shape[-1] - 1
        self.T_map_local, self.untied = correction.T_map_local, correction.untied
        self.count = len(correction.poses)  # of the spaced scans that were known
        later = correction.T_map_local @ spaced[len(correction.poses) :]
        self.poses = np.concatenate([correction.poses, later])
        # in 3D the local map moves with its frame: it holds what is near, not what loops tie to it
        self.local_map = LocalMap(labels.resolution) if self._D == 2 else None
        tagged = np.minimum(tagged, len(poses) - 1)
        self._motion = self.poses[tagged] @ se2.inverse(poses[tagged])
        self._source: OccupancyFilter = labels.filter
        shift = np.linalg.norm((self.poses - poses)[:, : self._D, self._D], axis=1)
        self.is_small = is_small(poses, self.poses, self._motion[-1])
        self.moves_cells = bool(shift.max() > _MIN_SHIFT * labels.resolution)
        self.filter: OccupancyFilter = self._source.sibling() if self.moves_cells else self._source
        self._block = 0
        self._scans = deque(sorted(correction.near, key=lambda scan: scan.travelled))
        self._labelled = deque[Observation]()
        self._kept_ns = 0

    def note_labelled(self, scan: Observation) -> None:
        """Tell of a scan that was added to the labels meanwhile."""
        stamp_ns = scan.beams.stamp_ns
        if self.moves_cells and stamp_ns - self._kept_ns >= _KEPT_EVERY_NS[self._D]:
            self._labelled.append(scan)
            self._kept_ns = stamp_ns

    def note_added(self, scan: MappedScan) -> None:
        """Tell of a scan that was added to the local map meanwhile."""
        self._scans.append(scan)

    def step(self) -> bool:
        """Do a part of the work; True when nothing is left."""
        labels = self._labels
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
            labels.add(scan, self.T_map_local @ scan.T, self.filter)
        return not self._labelled

    def finish(self) -> None:
        """Replace the cells of the labels."""
        if self.moves_cells:
            self._labels.filter = self.filter


class MapFrame:
    """The spaced scans in the frame of the odometry by scans and in the map.

    Args:
        dimension: 2 or 3.
        labels: of the map, which corrections move.
        odometry: by scans, whose local map they make anew.
        closer: what closes loops between them; None: nothing does.
        in_background: apply corrections in parts, one with each scan; else at once.

    Attributes:
        T_map_local: (D+1, D+1) of the frame of the odometry by scans.
    """

    def __init__(
        self,
        dimension: int,
        labels: CausalLabels,
        odometry: LiveOdometry,
        closer: LoopClosing | None,
        in_background: bool,
    ) -> None:
        D, self._labels, self._odometry = dimension, labels, odometry
        self.T_map_local = np.eye(D + 1)
        self._dimension, self._closer, self._in_background = D, closer, in_background
        # poses of the spaced scans: the first `_count` in the frame of the odometry by scans, and
        # in the map those that were corrected
        self._spaced, self._count = np.zeros((_FIRST_SPACED, D + 1, D + 1)), 0
        self._corrected = np.zeros((0, D + 1, D + 1))
        self._drift = np.zeros((3, 3))  # covariance since the last spaced scan
        self._correction: MapCorrection | None = None
        self._outdated = 0  # spaced scans of which corrections are not for where the robot is
        self._tagged = [0]  # spaced scans with which the cells of each tag move
        # first scans after the robot was carried, and the spaced scans that came first after them
        self._breaks = list[tuple[int, int]]()
        self._untied: tuple[int, ...] = ()  # of these spaced scans, see `Correction`

    @property
    def last(self) -> int:
        """Number of the last spaced scan; -1: there is none."""
        return self._count - 1

    @property
    def tag(self) -> int:
        """Number by which the cells that a scan observes now move when the map is corrected."""
        return len(self._tagged) - 1

    def begin_anew(self, scan: int) -> None:
        """The robot was carried before a scan: from now on, scans move with those that follow.
        In 3D loops show where it is."""
        self._breaks.append((scan, self._count))
        self._tagged.append(self._count)
        if self._dimension == 3:
            self._untied = (*self._untied, self._count)
            self._drift = np.full((3, 3), np.inf)

    @property
    def untied(self) -> list[int]:
        """The first scans after the robot was carried whose place in the map no loop shows yet."""
        return [scan for scan, first in self._breaks if first in self._untied]

    def add_drift(self, covariance: Float) -> None:
        """Add the covariance (3, 3) of a step that the scans do not show."""
        self._drift = self._drift + covariance

    def add(self, scan: MappedScan, registered: Registration) -> None:
        """Add a spaced scan to the pose graph."""
        if self._count == len(self._spaced):
            self._spaced = np.concatenate([self._spaced, np.zeros_like(self._spaced)])
        self._spaced[self._count] = scan.T_map_base
        if self._count - self._tagged[-1] >= SPACED_PER_TAG[self._dimension]:
            self._tagged.append(self._count)
        self._count += 1
        if self._count % _TRIM_EVERY == 0:
            trim_heap()
        with self._while_disk_lasts() as closer:
            if closer is not None:
                kept = thin_scan(scan, _MAX_KEPT_BEAMS[self._dimension])
                closer.add(kept, registered.explained, self._drift)
        self._drift = np.zeros((3, 3))

    def correct(self, labelled: Observation | None, added: MappedScan | None) -> None:
        """Go on correcting the map after a scan, if loops were closed.

        Args:
            labelled: the scan if it was added to the labels.
            added: the same if it was added to the local map.
        """
        if self._correction is not None:
            if labelled is not None:
                self._correction.note_labelled(labelled)
            if added is not None:
                self._correction.note_added(added)
        elif (correction := self._poll()) is not None and len(correction.poses) > self._outdated:
            spaced = self._spaced[: self._count].copy()
            tagged = np.array(self._tagged)
            new = MapCorrection(correction, self._labels, spaced, self.spaced_poses(), tagged)
            self._correction = None if new.is_small else new
            if new.is_small:
                self._keep_untied(new)
        self.go_on(to_the_end=not self._in_background)

    def _poll(self) -> Correction | None:
        with self._while_disk_lasts() as closer:
            return None if closer is None else closer.poll()
        return None

    @contextmanager
    def _while_disk_lasts(self) -> Iterator[LoopClosing | None]:
        """The loop closer; it ends when the disk is full, since no scan can be kept for later."""
        try:
            yield self._closer
        except OSError as error:
            _log.error("%s: poses go on, but loops are no longer closed", error.strerror or error)
            self.stop()
            self._closer = None

    def enter(self, covariance: Float) -> None:
        """Go on elsewhere in the map, where the robot was found: corrections that were begun
        before have the local map of where it was, and those that follow correct as much.

        Args:
            covariance: (3, 3) of the pose at which it was found.
        """
        self.add_drift(covariance)
        self._outdated = self._count

    def go_on(self, *, to_the_end: bool) -> None:
        """Apply a part, or all, of the correction that was begun, if there is one."""
        if self._correction is None:
            return
        is_done = self._correction.step()
        while to_the_end and not is_done:
            is_done = self._correction.step()
        if is_done:
            self._correction.finish()
            motion = self._correction.T_map_local @ se2.inverse(self.T_map_local)
            self._odometry.correct(self._correction.local_map, motion)
            self.T_map_local = self._correction.T_map_local
            self._corrected = self._correction.poses
            self._keep_untied(self._correction)
            self._correction = None
            trim_heap()  # of the map before

    def _keep_untied(self, correction: MapCorrection) -> None:
        """Those of the correction, and those that it does not know yet."""
        later = (first for first in self._untied if first >= correction.count)
        self._untied = (*correction.untied, *later)

    def spaced_poses(self) -> Float:
        """(S, D+1, D+1) T_map_base of the spaced scans."""
        since = self.T_map_local @ self._spaced[len(self._corrected) : self._count]
        return np.concatenate([self._corrected, since])

    def motion_since(self, poses: Float) -> Float:
        """(K, D+1, D+1) of the cells of each tag since the first spaced scans had these poses
        (S, D+1, D+1)."""
        tagged = [k for k in self._tagged if k < len(poses)]
        return np.asarray(self.spaced_poses()[tagged] @ se2.inverse(poses[tagged]))

    def to_map(self, local: Float, anchor: int, scan: int) -> Float:
        """(D+1, D+1) T_map_base of a scan at a pose in the frame of the odometry by scans, which
        moves with spaced scan `anchor`, or the first one since the robot was carried; -1: none."""
        anchor = max([anchor, *(first for begin, first in self._breaks if begin <= scan)])
        if not 0 <= anchor < len(self._corrected):
            return np.asarray(self.T_map_local @ local)
        moved = self._corrected[anchor] @ se2.inverse(self._spaced[anchor])
        return np.asarray(moved @ local)

    def to_map_all(self, local: Float, anchor: Int64, is_whole: bool = True) -> Float:
        """(T, D+1, D+1) the same of all scans, or of the first ones; between spaced ones
        corrections are blended."""
        count = self._count if is_whole else min(self._count, int(anchor[-1:].sum()) + 1)
        if not count or not len(local):
            return np.asarray(self.T_map_local @ local)
        # the scan after which each spaced one is the last: itself, but for the first
        scans = np.searchsorted(anchor, np.arange(count) - 1, side="right") - 1
        every, kept = np.unique(np.maximum(scans, 0), return_index=True)
        poses, last = self.spaced_poses(), len(local) - 1
        known = dict(zip(every.tolist(), poses[kept], strict=True))
        now = self.T_map_local @ local[-1]
        known.setdefault(last, now if is_whole else self.to_map(local[-1], int(anchor[-1]), last))
        motion = poses @ se2.inverse(self._spaced[: self._count])
        for scan, first in self._breaks:  # nothing is blended across
            if scan > last:
                break
            if first > 0:
                known.setdefault(scan - 1, motion[first - 1] @ local[scan - 1])
            if first < self._count:
                known.setdefault(scan, motion[first] @ local[scan])
        every = np.array(sorted(known))
        corrected = np.array([known[scan] for scan in every.tolist()])
        return local_map.propagate_corrections(local, every, corrected)

    def stop(self) -> None:
        """End the process that closes loops, if there is one."""
        if self._closer is not None:
            self._closer.stop()
