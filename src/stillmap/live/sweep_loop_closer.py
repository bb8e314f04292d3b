"""Loop closure in 3D while the robot drives: keyframe by keyframe, as `slam.loop_closure_3d`."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Float, Float32
from stillmap.live.local_map import MappedScan, SpacedScans
from stillmap.live.loop_closer import Correction
from stillmap.slam import loop_closure
from stillmap.slam.lidar_odometry import LidarOdometry
from stillmap.slam.loop_closure_3d import MAX_CHI2, LoopSearch, SweepLoopCloser
from stillmap.slam.options import SlamOptions
from stillmap.slam.types import LoopClosure, LoopContext

_RINGS, _RING_WIDTH = 20, 2.0  # m; farther points are rare
_SECTORS = 60
_LOWEST, _HIGHEST = -1.0, 5.0  # m above the base: what is higher is one and the same
_CARRIED_TRAVEL = 2000.0  # m of travel, as uncertain as the place to which a robot is carried
_ANYWHERE = np.diag(np.square([100.0] * 3 + [3.0] * 3))  # of that place, m and rad
_MIN_LOOPS = 2  # that show it: one may be wrong
# sweeps that are compared with one after the robot was carried; m and rad from where they were
_MAX_ALIKE, _ALIKE_STD = 4, (2.0, 0.2)
_STATIC = 0.5  # P(static) of the beams that say how a place looks


class Candidate(NamedTuple):
    """A sweep that looks alike.

    Attributes:
        number: of it.
        yaw: rad of the later base in the frame of the earlier one.
        similarity: up to 1.
    """

    number: int
    yaw: float
    similarity: float


def view_from_above(points: NDArray[np.floating]) -> Float32:
    """(R, S) height of the highest points (N, 3), in the base frame, by distance and azimuth; less
    the mean of all, and scaled to length 1."""
    ring = np.floor(np.hypot(points[:, 0], points[:, 1]) / _RING_WIDTH).astype(np.int64)
    turn = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    sector = np.floor(turn * _SECTORS).astype(np.int64) % _SECTORS
    height = np.clip(points[:, 2], _LOWEST, _HIGHEST) - _LOWEST
    out = np.zeros((_RINGS, _SECTORS))
    near = ring < _RINGS
    np.maximum.at(out, (ring[near], sector[near]), height[near])
    out -= out.mean()
    return (out / max(float(np.linalg.norm(out)), 1e-9)).astype(np.float32)


def find_alike(view: Float32, earlier: Float32, count: int) -> list[Candidate]:
    """The sweeps that look most alike, best first, turned as they fit best.

    Args:
        view: (R, S).
        earlier: (K, R, S) views of earlier sweeps.
        count: of sweeps, at most; none next to a better one.
    """
    spectra = np.fft.rfft(earlier, axis=2) * np.conj(np.fft.rfft(view, axis=1))
    correlation = np.fft.irfft(spectra.sum(axis=1), _SECTORS, axis=1)  # (K, S)
    best = correlation.max(axis=1)
    candidates = list[Candidate]()
    for k in np.argsort(-best, kind="stable").tolist():
        if len(candidates) == count:
            break
        if all(abs(k - better.number) > 1 for better in candidates):
            yaw = float(np.argmax(correlation[k])) * 2.0 * np.pi / _SECTORS
            candidates.append(Candidate(k, yaw, float(best[k])))
    return candidates


class LiveSweepLoopCloser:
    """Keyframes of the whole run in 3D, and the loops between them.

    Args:
        options: see SlamOptions.
        folder: of temporary files; None: the system's.
        threads: the result does not depend on it.
    """

    def __init__(self, options: SlamOptions, folder: Path | None, threads: int) -> None:
        self._threads = threads
        self._scans = SpacedScans(3, options, folder)
        self._found: list[LoopClosure] = []
        self._search = LoopSearch(0)
        self._searched = 0
        self._from_above = list[Float32]()  # views of the first keyframes

    def add(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Add a keyframe at its pose in the frame of the odometry by scans; drift: infinite if the
        robot was carried before it, else not used."""
        self._scans.add(scan, explained, drift)

    def poll(self) -> Correction | None:
        """Search loops of the keyframes since the last search; None: nothing changed."""
        first, last = self._searched, len(self._scans)
        if first == last:
            return None
        context = self._scans.context(np.arange(last))
        # the first keyframes after the robot was carried
        carried = np.flatnonzero(np.isinf(context.drift[:, 0, 0])).tolist()
        closer = self._closer(context, carried)
        search, self._searched = self._search, last
        search.corrected = np.concatenate([search.corrected, np.zeros((last - first, 4, 4))])
        attempted = [self._search_keyframe(closer, context, carried, k) for k in range(first, last)]
        new = [closure for closure in attempted if closure is not None]
        self._found += new
        if all(closure.rejected for closure in new):
            return None
        chain = [
            replace(step, covariance=_ANYWHERE) if step.second in carried else step
            for step in closer.odometry_constraints()
        ]
        corrected, self._found = loop_closure.solve_graph(
            closer.keyframes, chain, context.poses, self._found, MAX_CHI2
        )
        search.corrected = corrected.copy()
        search.correction = corrected[-1] @ se2.inverse(context.poses[-1])
        untied = _find_untied(carried, self._found)
        return Correction(search.correction, corrected, [], untied)

    def _search_keyframe(
        self, closer: SweepLoopCloser, context: LoopContext, carried: list[int], k: int
    ) -> LoopClosure | None:
        """The closure of keyframe k with an earlier one: with one that looks alike, as long as it
        is not known where the robot was carried."""
        first, search = max((one for one in carried if one <= k), default=0), self._search
        known = (closure for closure in self._found if closure.earlier < first <= closure.later)
        if not first or any(not closure.rejected for closure in known):
            return closer.search_keyframe(k, search)
        search.corrected[k] = search.correction @ context.poses[k]
        for number in range(len(self._from_above), first):
            self._from_above.append(self._view(context, number))
        earlier = np.array(self._from_above[:first])
        for candidate in find_alike(self._view(context, k), earlier, _MAX_ALIKE):
            T = np.eye(4)
            T[:2, :2] = se2.matrix(0.0, 0.0, candidate.yaw)[:2, :2]
            closure = closer.verify(candidate.number, k, T, *_ALIKE_STD)
            if not closure.rejected:
                search.corrected[k] = search.corrected[candidate.number] @ closure.T
                search.correction = search.corrected[k] @ se2.inverse(context.poses[k])
                search.since = float(closer.travelled[k])
                return closure
        return None

    def _view(self, context: LoopContext, k: int) -> Float32:
        scan = self._scans.scan(context, k)
        use = scan.beams.hit & (scan.e >= _STATIC)
        points, T = scan.beams.points[use], scan.beams.T_base_sensor
        return view_from_above(points @ T[:3, :3].T + T[:3, 3])

    def stop(self) -> None:
        """Remove temporary files."""
        self._scans.close()

    def _closer(self, context: LoopContext, carried: list[int]) -> SweepLoopCloser:
        n, poses = len(context.poses), context.poses
        odometry = LidarOdometry(poses, np.zeros((n, 6)), np.zeros((n, 6, 6)), context.explained)
        # loops lead back to all from before, in a wide window; and no submap has both places
        apart = _CARRIED_TRAVEL * np.cumsum(np.isin(context.keyframes, carried))
        return SweepLoopCloser(
            context.recording,
            context.e,
            odometry,
            context.travelled + apart,
            context.keyframes,
            context.search_distance,
            self._threads,
        )


def _find_untied(carried: Sequence[int], closures: Sequence[LoopClosure]) -> tuple[int, ...]:
    """The first keyframes after the robot was carried whose stretch no loops tie to the first one,
    nor to others that are."""
    accepted = [closure for closure in closures if not closure.rejected]
    ends = np.array([(closure.earlier, closure.later) for closure in accepted], np.int64)
    # 0: before the first time
    stretches = np.searchsorted(carried, ends.reshape(-1, 2), side="right")
    counts = Counter((int(a), int(b)) for a, b in stretches if a != b)
    loops = [pair for pair, count in counts.items() if count >= _MIN_LOOPS]
    tied = {0}
    for _ in carried:
        tied |= {stretch for pair in loops if not tied.isdisjoint(pair) for stretch in pair}
    return tuple(k for number, k in enumerate(carried, 1) if number not in tied)
