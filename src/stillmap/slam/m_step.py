"""The M-step over poses and map: incremental registration, loop closure, one more pass."""

import dataclasses
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.core.recording import Recording
from stillmap.slam import lidar_odometry, loop_closure, loop_closure_3d, odometry_2d
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.odometry_2d import MStepResult, SlamOptions
from stillmap.slam.refinement import refine_poses

Float = NDArray[np.float64]
StepProgress = Callable[[str, int, int], None]  # what, scans done, of how many


def m_step(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    poses: Float | None,
    threads: int,
    progress: StepProgress,
    *,
    start: MStepResult | None = None,
    earlier_poses: Float | None = None,
    with_grid: bool = True,
) -> MStepResult:
    """The most likely poses and map given e: (9), (10)-(15).

    Args:
        recording: as it was taken: the motion during its scans is taken out of them here.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        poses: (T, D+1, D+1) T_map_base when they are known: then only the map is made.
        threads: for maps of poses that are known already; the result does not depend on it.
        progress: called with what is done, the number of scans done and their total.
        start: an M-step whose loops are closed already: its poses are only swept again.
        before: (T, 3, 3) earlier poses, which tell how the robot moved during its scans better than
            odometry does.
        sums: whether the sums of (10) are wanted.
    """
    if poses is not None:
        mapped = _mapped_at(recording, e, options, poses, threads, sums=with_grid)
        progress("mapping", recording.n_scans, recording.n_scans)
        return mapped
    if recording.dimension == 3:
        mapped = _driven(recording, e, options, progress, threads)
    else:
        mapped = _estimated(recording, e, options, progress, start, earlier_poses)
    progress("drawing the map", 0, 0)
    grid = _mapped_at(recording, e, options, mapped.poses, threads, sums=with_grid).grid
    return dataclasses.replace(mapped, grid=grid)


def _driven(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    progress: StepProgress,
    threads: int,
) -> MStepResult:
    """The same of sweeps in space."""
    local = lidar_odometry.register_sweeps(
        recording, e, options.spinning, options.motion, partial(progress, "mapping"), threads
    )
    driven, loops, graph = loop_closure_3d.close_loops_3d(
        recording,
        e,
        options.spinning,
        options.spinning_loops,
        local,
        partial(progress, "closing loops"),
        threads,
    )
    nothing = em.make_grid(3, options.resolution)
    return MStepResult(
        driven.poses,
        driven.covariance,
        nothing,
        local.explained,
        widened=[],
        loops=loops,
        graph=graph,
    )


def _estimated(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    progress: StepProgress,
    start: MStepResult | None,
    before: Float | None,
) -> MStepResult:
    """The most likely poses alone, see m_step."""
    if not options.loops.enabled:
        return _followed(recording, e, options, partial(progress, "mapping"), before)
    if start is not None:
        mapped = _swept(recording, e, options, start, partial(progress, "mapping"))
        return dataclasses.replace(mapped, explained=start.explained)
    local = _followed(recording, e, options, partial(progress, "mapping"), before)
    seen = deskew_recording(recording, local.poses, options)
    closed = loop_closure.close_loops(seen, e, options, local, partial(progress, "closing loops"))
    mapped = _swept(recording, e, options, closed, partial(progress, "mapping again"))
    # a scan that went astray explains itself in the map of all: the map so far tells
    return dataclasses.replace(mapped, explained=local.explained)


def _followed(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    progress: Callable[[int, int], None],
    before: Float | None,
) -> MStepResult:
    """Poses one after the other, of scans without the motion during them as far as it is known."""
    memory = options.loops.memory if options.loops.enabled else np.inf
    known = recording.T_odom_base if before is None else before
    if known is None and options.deskew and recording.beam_time is not None:
        # scans as they were taken are alike enough to tell how the robot went
        known = odometry_2d.register_scans(recording, e, options, progress, memory).poses
    seen = deskew_recording(recording, known, options)
    return odometry_2d.register_scans(seen, e, options, progress, memory)


def _swept(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    mapped: MStepResult,
    progress: Callable[[int, int], None],
) -> MStepResult:
    """Poses whose loops are closed, registered once more against all others."""
    for _ in range(options.loops.sweeps):
        seen = deskew_recording(recording, mapped.poses, options)
        mapped = refine_poses(seen, e, options, mapped, progress)
    return mapped


def _mapped_at(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    poses: Float,
    threads: int,
    *,
    sums: bool = True,
) -> MStepResult:
    """The map of known poses (T, D+1, D+1)."""
    D, T = recording.dimension, recording.n_scans
    grid = em.make_grid(D, options.resolution, options.registration.approach)
    if sums:
        em.add_recording(
            grid, deskew_recording(recording, poses, options, threads), poses, e, threads
        )
    freedom = D * (D + 1) // 2
    return MStepResult(poses, np.zeros((T, freedom, freedom)), grid, np.full(T, np.nan), [])
