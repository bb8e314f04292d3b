"""Relation errors of a trajectory in the plane.

Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27 (2009):
a trajectory is scored by known displacements between pairs of its poses, which are independent of
the map frame. Where their program and their text differ, the default follows the program, which
produced the published numbers.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.results.eval.labels import Float, Scores
from stillmap.results.eval.trajectory import nearest_index

MAX_DT = 0.1  # seconds, as in the authors' program


@dataclass(frozen=True)
class Spread(Scores):
    """Mean and sample standard deviation of absolute and squared errors, median and maximum."""

    mean: float
    std: float
    squared_mean: float
    squared_std: float
    median: float
    max: float


@dataclass(frozen=True)
class RelationErrors(Scores):
    """Errors over the usable relations.

    Attributes:
        relations: number of relations.
        used: those with a pose at both ends.
        stamps: number of distinct times of the relations.
        stamps_by_odometry: those whose pose is extrapolated by odometry.
        translation: metres. rotation: degrees. NaN where no relation was used.
    """

    relations: int
    used: int
    stamps: int
    stamps_by_odometry: int
    translation: Spread
    rotation: Spread


def compute_relation_errors(
    trajectory: Float,
    relations: Float,
    odometry: Float | None = None,
    max_dt: float = MAX_DT,
    compose: bool = False,
) -> RelationErrors:
    """Compare the displacements of a trajectory with known ones.

    The pose at a time is the nearest one within `max_dt`; beyond it, the nearest pose plus the
    odometry between the two times. Without odometry such a relation is left out.

    Args:
        trajectory: (N, 4) t, x, y, theta in seconds, metres, radians; N >= 1, sorted by t.
        relations: (R, 8) t1, t2, x, y, z, roll, pitch, yaw; only x, y and yaw are compared.
        odometry: (K, 4) as `trajectory`, K >= 1.
        max_dt: seconds.
        compose: error as the displacement from the reference to the estimate, as in the paper's
            equation; else the difference of the components, as in its program.
    """
    times, index = np.unique(relations[:, :2].ravel(), return_inverse=True)
    poses, known, by_odometry = _look_up_poses(times, trajectory, odometry, max_dt)
    first, second = index.reshape(-1, 2).T
    used = known[first] & known[second]
    estimate = _displacement(poses[first[used]], poses[second[used]])
    reference = relations[used][:, [2, 3, 7]]
    error = _displacement(reference, estimate) if compose else estimate - reference
    return RelationErrors(
        relations=len(relations),
        used=int(used.sum()),
        stamps=len(times),
        stamps_by_odometry=by_odometry,
        translation=_summarize(np.hypot(error[:, 0], error[:, 1])),
        rotation=_summarize(np.degrees(np.abs(se2.wrap(error[:, 2])))),
    )


def _look_up_poses(
    times: Float, trajectory: Float, odometry: Float | None, max_dt: float
) -> tuple[Float, NDArray[np.bool_], int]:
    index, distance = nearest_index(trajectory[:, 0], times)
    poses = trajectory[index, 1:]
    far = distance > max_dt
    if odometry is None:
        return poses, ~far, 0
    start, _ = nearest_index(odometry[:, 0], trajectory[index[far], 0])
    end, _ = nearest_index(odometry[:, 0], times[far])
    step = _displacement(odometry[start, 1:], odometry[end, 1:])
    poses[far] = se2.parameters(se2.matrix(*poses[far].T) @ se2.matrix(*step.T))
    return poses, np.ones(len(times), bool), int(far.sum())


def _displacement(a: Float, b: Float) -> Float:
    """a^-1 b for (N, 3) poses."""
    return se2.parameters(se2.inverse(se2.matrix(*a.T)) @ se2.matrix(*b.T))


def _summarize(error: Float) -> Spread:
    if not len(error):
        return Spread(*[float("nan")] * 6)
    squared = error**2
    return Spread(
        mean=float(error.mean()),
        std=_sample_std(error),
        squared_mean=float(squared.mean()),
        squared_std=_sample_std(squared),
        median=float(np.median(error)),
        max=float(error.max()),
    )


def _sample_std(values: Float) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0
