"""Cost of a trajectory in nats: -ln of the evidence of its map, and of its steps given odometry."""

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import motion_model, scan_hits
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_matching import FAULT_COST, INFORMATION_SCALE

_PRIOR = 0.02, 0.5  # Beta(a, b) of the occupancy of a cell: few are occupied, fewer in between
_RECOVERY_COST = 2.3  # nats: odometry that failed is valid again after ten scans


def map_evidence(
    recording: Recording, e: Float32, scans: Index, poses: Float, resolution: float
) -> float:
    """ln of the marginal likelihood of the counts (10), times the gain of dependent beams.

    The occupancy of each cell with returns is integrated out: beams that end in free space or pass
    through walls cost, and so does every new cell, and a place that is mapped twice. Free space
    alone is no evidence: its cells depend on each other, and all places have some. Where cells
    begin says nothing, but changes the evidence of walls along them: mean of two grids half a cell
    apart.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        scans: (n,) of the map.
        poses: (n, 3, 3) of their robot.
        resolution: m of a cell.
    """
    evidence = 0.0
    for shift in (0.0, 0.5 * resolution):
        shifted = se2.matrix(shift, shift, 0.0) @ poses
        grid = scan_hits.count_beams(recording, e, scans, shifted, resolution)
        recording.release_pages(e)
        evidence += 0.5 * INFORMATION_SCALE * grid.log_evidence(*_PRIOR)
    return evidence


def same_place_evidence(grid: _core.OccupancyGrid2D, other: _core.OccupancyGrid2D) -> float:
    """Nats by which one map of the counts of both grids has more evidence than one of each."""
    evidence: float = INFORMATION_SCALE * grid.evidence_gain(other, *_PRIOR)
    return evidence


class OdometryCost:
    """Cost of steps given odometry that may fail: a hidden Markov model of two states.

    Where odometry is valid, steps are its increments with the noise fitted to a trajectory; where
    it is not, the robot goes on at constant velocity, to within what it may accelerate.

    Args:
        recording: 2D.
        poses: (T, 3, 3) of the trajectory.
        options: largest noise of odometry.
    """

    def __init__(self, recording: Recording, poses: Float, options: OdometryOptions) -> None:
        self.increments: Float | None = None
        if recording.T_odom_base is None:
            return
        self.increments = se2.increments(recording.T_odom_base)
        noise, _ = motion_model.fit_odometry_noise(self.increments, se2.increments(poses), options)
        self.std = motion_model.increment_std(self.increments, options, noise)[:, [0, 0, 1]]
        self.onward_std = motion_model.onward_std(recording.stamp_ns)[:, [0, 0, 1]]

    def __call__(self, poses: Float, a: int, b: int) -> float:
        """Nats of the steps to scans a to b - 1 of poses (T, 3, 3), by the likeliest states."""
        if self.increments is None:
            return 0.0
        before = max(a - 2, 0)
        steps, of = se2.increments(poses[before:b]), slice(a - 1, b - 1)
        here = steps[a - 1 - before :]
        onward = steps[: len(here)] if a > 1 else np.concatenate([here[:1], here[:-1]])
        costs = (
            _negative_log_density(self.increments[of], here, self.std[of]),
            _negative_log_density(onward, here, self.onward_std[of]),
        )
        valid, failed = 0.0, FAULT_COST
        for of_valid, of_failed in zip(*(cost.tolist() for cost in costs), strict=True):
            stays = min(valid, failed + _RECOVERY_COST) + of_valid
            failed = min(failed, valid + FAULT_COST) + of_failed
            valid = stays
        return min(valid, failed)


def _negative_log_density(expected: Float, steps: Float, std: Float) -> Float:
    """(n,) nats of steps (n, 3, 3) given expected ones and std (n, 3), up to a constant."""
    d = se2.parameters(se2.inverse(expected) @ steps) / std
    cost: Float = (0.5 * d**2 + np.log(std)).sum(axis=1)
    return cost
