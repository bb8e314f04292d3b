"""Checks of a state that was read from a checkpoint, against the recording that it is of.

Checksums find damage; they do not find what somebody else has written.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap import em, slam
from stillmap.core.recording import Recording
from stillmap.pipeline.estimate import EmState, Estimate
from stillmap.pipeline.snapshots import Snapshot

Array = NDArray[np.generic]

_SOURCES = ("", "odometry", "scans", "odometry_in_stretches")  # see IterationRecord
_MAX_COORDINATE = 1e12  # m, as of a recording
_MAX_CELL = 1 << 40  # cells from the origin


def check_state(state: EmState, recording: Recording) -> None:
    """Refuse a state whose arrays do not fit the recording.

    Raises:
        ValueError: names what is wrong.
    """
    numbers = [one.number for one in state.records]
    _require(numbers == [*range(1, len(numbers) + 1)], "records")
    _require(all(one.source in _SOURCES for one in state.records), "records.source")
    _require(all(0.0 <= one.seconds < np.inf for one in state.records), "records.seconds")
    _require(state.best is not None and state.latest is not None, "best and latest")
    for name, one in (("best", state.best), ("latest", state.latest)):
        assert one is not None
        _require(1 <= one.number <= len(state.records), f"{name}.number")
        _check_estimate(name, one, recording)
    if state.window is not None:
        x0, y0, x1, y1 = state.window
        _require(_are_small(np.array(state.window)) and x0 < x1 and y0 < y1, "window")
    for number, part in state.snapshots.items():
        _check_snapshot(f"snapshots.{number}", part)


def _check_estimate(name: str, one: Estimate, recording: Recording) -> None:
    M = recording.n_beams
    _require(one.weights.shape == (M,), f"{name}.weights")
    _require(_are_probabilities(one.weights), f"{name}.weights")
    _check_m_step(f"{name}.m_step", one.m_step, recording)
    found = one.e_step
    _require(
        found.p_static.shape == (M,) and _are_probabilities(found.p_static), f"{name}.p_static"
    )
    D = recording.dimension
    if found.occupied is not None:
        cells, p = found.occupied.cells, found.occupied.p_occupied
        _check_cells(f"{name}.occupied", cells, D)
        _require(p.shape == (len(cells),) and _are_probabilities(p), f"{name}.occupied")
        _require(_are_probabilities(np.array([found.occupied.free_prior])), f"{name}.free_prior")
    if found.no_return is not None:
        _check_cells(f"{name}.no_return", found.no_return.stop_cells, D)
    if found.changed_cells is not None:
        _check_changed(f"{name}.changed_cells", found.changed_cells, D)
    if found.ground is not None:
        ground = found.ground
        fits = ground.height.ndim == 2 and ground.height.size and ground.corner.shape == (2,)
        _require(bool(fits) and _are_small(ground.height, ground.corner), f"{name}.ground")


def _check_m_step(name: str, found: slam.MStepResult, recording: Recording) -> None:
    T, D = recording.n_scans, recording.dimension
    dof = 3 * (D - 1)
    _check_poses(f"{name}.poses", found.poses, T, D)
    _require(found.covariance.shape == (T, dof, dof), f"{name}.covariance")
    _require(found.explained.shape == (T,), f"{name}.explained")
    _require(found.drift is None or found.drift.shape == (T, 3, 3), f"{name}.drift")
    _require(found.grid.resolution > 0.0, f"{name}.grid")
    for scan in _scans_of(found):
        _require(0 <= scan < T, f"{name}: scan {scan}")
    for loop in found.loops:
        _check_poses(f"{name}.loops", loop.T[None], 1, D)
        _require(loop.covariance.shape == (dof, dof), f"{name}.loops")
    if found.graph is None:
        return
    keyframes, K = found.graph.keyframes, len(found.graph.keyframes)
    _require(keyframes.shape == (K,) and bool((np.diff(keyframes) > 0).all()), f"{name}.keyframes")
    _require(bool(((keyframes >= 0) & (keyframes < T)).all()), f"{name}.keyframes")
    _check_poses(f"{name}.graph", found.graph.poses, K, D)
    for edge in found.graph.constraints:
        _require(0 <= edge.first < K and 0 <= edge.second < K, f"{name}.constraints")
        _check_poses(f"{name}.constraints", edge.T[None], 1, D)
        _require(edge.covariance.shape == (dof, dof), f"{name}.constraints")


def _scans_of(found: slam.MStepResult) -> Iterator[int]:
    """All numbers of scans in the notes of an M-step."""
    notes = found.diagnostics
    for scans in (notes.widened, notes.odometry_faults, notes.breaks, notes.unconnected):
        yield from scans
    yield from notes.ambiguous
    for stretch in notes.bare_stretches:
        yield from (stretch.first, stretch.last)
    for loop in found.loops:
        yield from (loop.earlier, loop.later)


def _check_poses(name: str, poses: NDArray[np.float64], count: int, D: int) -> None:
    _require(poses.shape == (count, D + 1, D + 1) and _are_small(poses), name)
    R = poses[:, :D, :D]
    _require(bool((poses[:, D] == np.eye(D + 1)[D]).all()), name)
    _require(np.allclose(R @ R.transpose(0, 2, 1), np.eye(D), atol=1e-6), name)


def _check_cells(name: str, cells: NDArray[np.int64], D: int) -> None:
    fits = cells.ndim == 2 and cells.shape[1] == D
    _require(fits and bool((np.abs(cells.astype(np.float64)) < _MAX_CELL).all()), name)


def _check_changed(name: str, found: em.ChangedCells, D: int) -> None:
    K = len(found.cells)
    _check_cells(name, found.cells, D)
    _require(found.p_object.shape == found.n_changes.shape == (K,), name)
    _require(found.change_bins.shape == (K, 2, 2), name)


def _check_snapshot(name: str, part: Snapshot) -> None:
    _require(part.p_occupied.ndim == 2 and _are_small(np.array(part.origin)), name)
    _require(0.0 < part.resolution < _MAX_COORDINATE, name)
    _require(part.dynamic_points.ndim == 2 and part.dynamic_points.shape[1] == 2, name)


def _are_probabilities(values: NDArray[np.floating]) -> bool:
    """Whether all lie between 0 and 1; NaN may."""
    return not bool(((values < 0.0) | (values > 1.0)).any())


def _are_small(*arrays: NDArray[np.floating]) -> bool:
    return all(bool((np.abs(one) < _MAX_COORDINATE).all()) for one in arrays)


def _require(fits: bool, name: str) -> None:
    if not fits:
        raise ValueError(f"{name} cannot be of this recording")
