"""Loop closure in 3D while the robot drives: keyframe by keyframe, as `slam.loop_closure_3d`."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_closer import Correction
from stillmap.live.spaced_scans import SpacedScans, SpacedView
from stillmap.slam import loop_closure
from stillmap.slam.lidar_odometry import LidarOdometry
from stillmap.slam.loop_closure_3d import (
    MAX_CHI2,
    SEARCH_DISTANCE,
    LoopSearch,
    SweepLoopCloser,
)
from stillmap.slam.options import SlamOptions
from stillmap.slam.types import LoopClosure

Float = NDArray[np.float64]


class LiveSweepLoopCloser:
    """Keyframes of the whole run in 3D, and the loops between them.

    Args:
        options: see SlamOptions.
        folder: of temporary files; None: the system's.
        threads: the result does not depend on it.
    """

    def __init__(self, options: SlamOptions, folder: Path | None, threads: int) -> None:
        self._options, self._threads = options, threads
        self._scans = SpacedScans(3, folder)
        self._found: list[LoopClosure] = []
        self._search = LoopSearch(0)
        self._searched = 0

    def add(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Add a keyframe at its pose in the frame of the odometry by scans; drift is not used."""
        self._scans.append(scan, explained, drift)

    def poll(self) -> Correction | None:
        """Search loops of the keyframes since the last search; None: nothing changed."""
        if not self._options.loop_closure or self._searched == len(self._scans):
            return None
        view, first = self._scans.view(), self._searched
        closer, last = self._closer(view), len(view.poses)
        search, self._searched = self._search, last
        search.corrected = np.concatenate([search.corrected, np.zeros((last - first, 4, 4))])
        attempted = [closer.search_keyframe(k, search) for k in range(first, last)]
        new = [closure for closure in attempted if closure is not None]
        self._found += new
        if all(closure.rejected for closure in new):
            return None
        corrected, self._found = loop_closure.solve_graph(
            closer.keyframes, closer.odometry_constraints(), view.poses, self._found, MAX_CHI2
        )
        search.corrected = corrected.copy()
        search.correction = corrected[-1] @ se2.inverse(view.poses[-1])
        return Correction(search.correction, corrected, [])

    def stop(self) -> None:
        """Remove temporary files."""
        self._scans.close()

    def _closer(self, view: SpacedView) -> SweepLoopCloser:
        n = len(view.poses)
        odometry = LidarOdometry(view.poses, np.zeros((n, 6)), np.zeros((n, 6, 6)), view.explained)
        search = self._options.loop_search_distance
        return SweepLoopCloser(
            view.recording,
            view.e,
            odometry,
            view.travelled,
            np.arange(n),
            SEARCH_DISTANCE if search is None else search,
            self._threads,
        )
