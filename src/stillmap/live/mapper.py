"""`stillmap.LiveMapper`: scans in, poses, labels and map out, as they are known at the time."""

# signatures name ArrayLike instead of spelling it out
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core import se2
from stillmap.io.array_checks import poses_to_matrices
from stillmap.live.causal_labels import CausalLabels, MapChange
from stillmap.live.loop_closer import Correction, LoopCloser
from stillmap.live.scan import Scan, ScanBeams, to_beams
from stillmap.live.scan_odometry import Registration, ScanOdometry
from stillmap.live.update import Update
from stillmap.pipeline.options import Options
from stillmap.results.build import to_options
from stillmap.slam import scan_hits

Float = NDArray[np.float64]

_CHANGES_EVERY_NS = 10**9  # between two updates that tell what changed in the map


class LiveMapper:
    """Maps scan by scan.

    Args:
        options: `Options`, or the options to change, as of `stillmap.build`.

    Examples:
        >>> mapper = stillmap.LiveMapper()
        >>> update = mapper.push(stillmap.Scan(stamp, ranges, angles), odometry=(x, y, theta))
        >>> update.pose, update.p_static
    """

    def __init__(self, options: Options | Mapping[str, Any] | None = None) -> None:
        self.options = to_options(options)
        self._odometry = ScanOdometry(self.options.slam)
        self._labels = CausalLabels(2, self.options.slam.resolution, self.options.em)
        self._T_odom_base: Float | None = None
        self._closer = LoopCloser(self.options.slam)
        self._T_map_local, self._drift = np.eye(3), np.zeros((3, 3))
        self._changes_due_ns = 0

    def push(self, scan: Scan | ScanBeams, odometry: ArrayLike | None = None) -> Update:
        """Register a scan, label its beams, and add it to the map.

        Args:
            scan: the next scan in time.
            odometry: x, y, theta or (3, 3) T_odom_base at its stamp; None: there is none.

        Raises:
            ValueError: names the argument, what was expected, and what it was.
        """
        beams = scan if isinstance(scan, ScanBeams) else to_beams(scan)
        T_odom_base = _to_matrix(odometry)
        increment = self._increment(T_odom_base)
        prior = self._odometry.predict(beams, increment)
        weights = self._labels.label(beams, self._T_map_local @ prior.T_map_base)  # E-step at the predicted pose
        hits = _select_hits(beams, weights)
        found = self._odometry.register(beams, hits, prior, increment)  # M-step: (9)
        pose = self._T_map_local @ found.T
        self._labels.add(beams, pose, _normals_of(beams, hits), max(self._closer.count - 1, 0))
        p_static = self._labels.label(beams, pose)  # E-step: (8)
        self._T_odom_base = T_odom_base
        self._drift = self._drift + found.drift
        self._add_to_maps(beams, np.nan_to_num(p_static), found)
        return self._to_update(found, p_static, T_odom_base, beams.stamp_ns)

    def _add_to_maps(
        self, beams: ScanBeams, e: NDArray[np.float32], found: Registration
    ) -> None:
        """Add a spaced scan to the local map and to the pose graph, and close loops."""
        added = self._odometry.add(beams, e)
        if added is None:
            return
        self._closer.add(added, found.explained, self._drift)
        self._drift = np.zeros((3, 3))
        if self._closer.is_due:
            correction = self._closer.close()
            if correction is not None:
                self._correct(correction)

    def _correct(self, correction: Correction) -> None:
        """Take over the corrected map: pose, labels, and local map."""
        self._T_map_local = correction.T_map_local
        if _largest_shift(correction.motion, correction.poses) > 0.5 * self._labels.resolution:
            self._labels.correct(correction.motion)
        self._odometry.replace_local_map(self._closer.near_scans(correction))

    def _increment(self, T_odom_base: Float | None) -> Float | None:
        if T_odom_base is None or self._T_odom_base is None:
            return None
        out: Float = se2.inverse(self._T_odom_base) @ T_odom_base
        return out

    def _take_changes(self, stamp_ns: int) -> list[MapChange]:
        """The parts of the map that changed, once a second."""
        if stamp_ns < self._changes_due_ns:
            return []
        self._changes_due_ns = stamp_ns + _CHANGES_EVERY_NS
        return self._labels.take_changes()

    def _to_update(
        self,
        found: Registration,
        p_static: NDArray[np.float32],
        T_odom_base: Float | None,
        stamp_ns: int,
    ) -> Update:
        doubts = {
            "slip": found.is_slipping,
            "blind": found.is_blind,
            "carried": found.is_carried,
        }
        pose = self._T_map_local @ found.T
        return Update(
            pose,
            found.covariance,
            p_static,
            None if T_odom_base is None else pose @ se2.inverse(T_odom_base),
            tuple(name for name, is_so in doubts.items() if is_so),
            self._take_changes(stamp_ns),
        )


def _largest_shift(motion: Float, poses: Float) -> float:
    """m by which the motion (S, 3, 3) moves any of the poses (S, 3, 3), to which it has led."""
    before = se2.inverse(motion) @ poses
    return float(np.hypot(*(poses[:, :2, 2] - before[:, :2, 2]).T).max())


def _to_matrix(odometry: ArrayLike | None) -> Float | None:
    if odometry is None:
        return None
    return poses_to_matrices("odometry", np.asarray(odometry, np.float64)[None], 1, 2)[0]


def _select_hits(beams: ScanBeams, weights: NDArray[np.float32]) -> scan_hits.Scan:
    """The hits of a scan in the base frame; normals of all of them, whatever their weight."""
    points = scan_hits.transform_points(beams.points[beams.hit], beams.T_base_sensor)
    ones = np.ones(len(points), np.float32)
    scan = scan_hits.make_scan(points, ones, beams.T_base_sensor)
    return scan_hits.Scan(
        points, weights[beams.hit], scan.T_base_sensor, scan.normals, scan.isotropy
    )


def _normals_of(beams: ScanBeams, hits: scan_hits.Scan) -> Float:
    """(N, D) normals in the sensor frame; 0 where nothing was hit."""
    out = np.zeros(beams.points.shape)
    out[beams.hit] = hits.normals @ beams.T_base_sensor[:2, :2]  # rotated back
    return out
