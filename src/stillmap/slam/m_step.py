"""The M-step over poses (9) and map (10)-(15): scan matching, loop closure, refinement."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

import stillmap._core as _core
from stillmap import em
from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import motion_model, scan_hits, scan_matching
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.lidar_odometry import register_sweeps
from stillmap.slam.local_map import SCAN_SPACING, select_keyframes_per_sensor
from stillmap.slam.loop_closure import close_loops, place_segments
from stillmap.slam.loop_closure_3d import close_loops_3d
from stillmap.slam.odometry_2d import register_scans
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import FREE_SPACE_MARGIN, add_scan, thin_scans
from stillmap.slam.step_alternatives import PoseMethods, revise_steps
from stillmap.slam.types import MStepResult, ScanProgress

_SCANS_PER_CALL = 200  # of the kernel; interrupts are noticed in between


def refine_poses(
    recording: Recording,
    e: Float32,
    options: SlamOptions,
    initial: MStepResult,
    progress: ScanProgress,
) -> MStepResult:
    """Poses, covariances and explained shares after one pass; the first pose is fixed.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        initial: poses to refine; its grid is not used.
        progress: called with the number of scans done and their total.
    """
    poses = initial.poses.copy()
    T = len(poses)
    covariance, explained = np.zeros((T, 3, 3)), np.ones(T)
    increments, std, known = _motion_steps(recording, poses, options, initial.diagnostics.breaks)
    grid = _core.OccupancyGrid2D(options.resolution, scan_hits.FREE_SPACE_MARGIN)
    kept = select_keyframes_per_sensor(poses, recording.sensor, SCAN_SPACING, SCAN_SPACING)
    for t in recording.iter_scans(kept, e):
        add_scan(grid, recording, e, t, poses[t])
    is_in_map = np.zeros(T, np.bool_)
    is_in_map[kept] = True
    for first in recording.iter_scans(range(1, T, _SCANS_PER_CALL), e):
        scans = slice(first, min(first + _SCANS_PER_CALL, T))
        beams = slice(int(recording.offset[first]), int(recording.offset[scans.stop]))
        before_to_after = np.clip(np.arange(first - 1, scans.stop + 1), 0, T - 1)
        to_each_and_beyond = slice(first - 1, scans.stop)
        poses[scans], covariance[scans], explained[scans] = _core.refine_scans(
            grid,
            recording.points[beams],
            recording.hit[beams],
            e[beams],
            recording.offset[first : scans.stop + 1] - beams.start,
            recording.T_base_sensor[recording.sensor[scans]],
            is_in_map[scans],
            poses[before_to_after],
            increments[to_each_and_beyond],
            std[to_each_and_beyond],
            known[to_each_and_beyond],
            np.array(motion_model.MIN_INCREMENT_STD),
            **scan_matching.refinement_options(grid),
        )
        progress(scans.stop, T)
    return dataclasses.replace(initial, poses=poses, covariance=covariance, explained=explained)


def _motion_steps(
    recording: Recording, poses: Float, options: SlamOptions, breaks: list[int]
) -> tuple[Float, Float, Bool]:
    """The motion from each scan to the next by odometry, with its noise about the poses.

    By the poses (T, 3, 3) where odometry is missing or at fault.

    Returns:
        increments (T, 3, 3); their std (T, 2) in m and rad; which are known (T,), False across
        breaks and after the last scan.
    """
    motion = se2.increments(poses)
    increments, std = motion, np.tile(motion_model.MIN_INCREMENT_STD, (len(motion), 1))
    if recording.T_odom_base is not None:
        measured = se2.increments(recording.T_odom_base)
        noise, is_fault = motion_model.fit_odometry_noise(measured, motion, options.odometry)
        increments = np.where(is_fault[:, None, None], motion, measured)
        std = motion_model.increment_std(increments, options.odometry, noise)
    known = np.ones(len(poses), np.bool_)
    known[[*(t - 1 for t in breaks), -1]] = False
    padded = np.concatenate([increments, np.eye(3)[None]]), np.concatenate([std, np.ones((1, 2))])
    return *padded, known


StepProgress = Callable[[str, int, int], None]  # step, scans done, total; 0: not counted

_LOCAL_MAP_TRAVEL = 25.0  # m after which scans leave the local map if loops are closed afterwards


def m_step(
    recording: Recording,
    e: Float32,
    options: SlamOptions,
    poses: Float | None,
    threads: int,
    progress: StepProgress,
    *,
    initial: MStepResult | None = None,
    earlier: MStepResult | None = None,
    with_grid: bool = True,
    free_space_margin: float = FREE_SPACE_MARGIN,
) -> MStepResult:
    """The most likely poses and map given e: (9), (10)-(15).

    Args:
        recording: as recorded, not deskewed.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        poses: (T, D+1, D+1) known T_map_base: only the map is computed.
        threads: of the 3D registration and of the map; the result does not depend on it.
        progress: called with the step, the number of scans done and their total.
        initial: an M-step with closed loops: its poses are only refined. 2D only.
        earlier: an earlier M-step, better than odometry for deskewing: it is refined, and kept if
            scans matched anew are less likely. 2D only.
        with_grid: whether to compute the sums of (10).
        free_space_margin: m before its end in which a beam is not used as free space; (10) as
            printed has 0.
    """
    D, T = recording.dimension, recording.n_scans
    grid = em.make_grid(D, options.resolution, free_space_margin)
    if poses is not None:
        dof = D * (D + 1) // 2
        estimated = MStepResult(poses, np.zeros((T, dof, dof)), grid, np.full(T, np.nan))
    else:
        matched, weights = thin_scans(recording, e) if D == 2 else (recording, e)
        step = _PoseStep(matched, weights, options, threads, progress, free_space_margin)
        estimated = step.estimate_3d() if D == 3 else step.estimate_2d(initial, earlier)
        progress("counting beams", 0, 0)
    if with_grid:
        deskewed = deskew_recording(recording, estimated.poses, options, threads)
        em.add_recording(grid, deskewed, estimated.poses, e, threads)
    if poses is not None:
        progress("matching scans", T, T)
    return dataclasses.replace(estimated, grid=grid)


@dataclass(frozen=True, eq=False)
class _PoseStep:
    """The M-step over poses; arguments as of `m_step`. Grids of results are empty."""

    recording: Recording
    e: Float32
    options: SlamOptions
    threads: int
    progress: StepProgress
    free_space_margin: float

    def estimate_3d(self) -> MStepResult:
        """Lidar odometry and loop closure."""
        recording, e, options, threads = self.recording, self.e, self.options, self.threads
        matching, closing = self._progress("matching scans"), self._progress("closing loops")
        odometry = register_sweeps(recording, e, options.odometry, matching, threads)
        empty = em.make_grid(3, options.resolution)
        estimated = MStepResult(odometry.poses, odometry.covariance, empty, odometry.explained)
        if not options.loop_closure:
            return estimated
        poses, loops, graph = close_loops_3d(recording, e, options, odometry, closing, threads)
        return dataclasses.replace(estimated, poses=poses, loops=loops, graph=graph)

    def estimate_2d(self, initial: MStepResult | None, earlier: MStepResult | None) -> MStepResult:
        """Scan matching, loop closure and refinement."""
        if initial is not None and self.options.loop_closure:
            return self._refine(initial, self._progress("matching scans"))
        recording, options = self.recording, self.options
        motion = recording.T_odom_base if earlier is None else earlier.poses
        if motion is None and options.deskew and recording.beam_time is not None:
            motion = self._match_scans(recording).poses  # skewed scans are good enough
        deskewed = self._deskew(motion)
        matched = self._match_scans(deskewed)
        if not options.loop_closure:
            return matched
        placed = place_segments(self._deskew(matched.poses), self.e, options, matched)

        if earlier is not None:
            earlier = self._refine(earlier, self._progress("refining poses"))
        methods = PoseMethods(
            lambda part, e, *how: self._of_part(part, e)._match_scans(part, *how),
            self._close_loops,
            lambda part, e, trajectory: self._of_part(part, e)._close_loops(trajectory),
        )
        return revise_steps(deskewed, self.e, options, placed, methods, earlier)

    def _match_scans(
        self,
        scans: Recording,
        search_wider: bool = True,
        faults: Index | None = None,
    ) -> MStepResult:
        """Incremental scan matching."""
        return register_scans(
            scans,
            self.e,
            self.options,
            self._progress("matching scans"),
            _LOCAL_MAP_TRAVEL if self.options.loop_closure else np.inf,
            self.free_space_margin,
            search_wider=search_wider,
            faults=faults,
        )

    def _close_loops(self, matched: MStepResult) -> MStepResult:
        """Loop closure and refinement; scans are deskewed by the best motion estimate so far."""
        deskewed, closing = self._deskew(matched.poses), self._progress("closing loops")
        closed = close_loops(deskewed, self.e, self.options, matched, closing)
        return self._refine(closed, self._progress("refining poses"))

    def _refine(self, initial: MStepResult, progress: ScanProgress) -> MStepResult:
        deskewed = self._deskew(initial.poses)
        refined = refine_poses(deskewed, self.e, self.options, initial, progress)
        # a misregistered scan agrees with a map that contains it: keep the share from the local map
        return dataclasses.replace(refined, explained=initial.explained)

    def _of_part(self, scans: Recording, e: Float32) -> "_PoseStep":
        """The same of some scans, without progress."""
        return dataclasses.replace(self, recording=scans, e=e, progress=lambda *_: None)

    def _deskew(self, poses: Float | None) -> Recording:
        return deskew_recording(self.recording, poses, self.options)

    def _progress(self, step: str) -> ScanProgress:
        return partial(self.progress, step)
