"""Absolute, relative and relation errors of a trajectory.

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. Alignment: the
rigid case of Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", PAMI 13 (1991); the scale is never estimated, since a laser measures it.

Relations: Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27
(2009): a trajectory is scored by known displacements between pairs of its poses, which are
independent of the map frame. Where their program and their text differ, the default follows the
program, which produced the published numbers.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import scipy  # its parts load when they are first used

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Index
from stillmap.core.errors import InputError
from stillmap.io.trajectory import nearest_index
from stillmap.results.eval import readers
from stillmap.results.eval.labels import NAN, Scores
from stillmap.results.eval.readers import Truth

Unit = Literal["m", "frames"]

_PLANAR_TOLERANCE = 1e-6  # metres and sines: rounding of text and quaternions
_PATH_TOLERANCE = 0.1  # of the distance between the poses of a pair
_STAMP_TOLERANCE = 1e-6  # s: a result carries the stamps of its recording
MAX_DT = 0.1  # s of relations, as in the authors' program


@dataclass(frozen=True)
class ErrorStats(Scores):
    """Summary of errors; NaN of none."""

    rmse: float
    mean: float
    median: float
    max: float


@dataclass(frozen=True)
class RelativeErrors(Scores):
    """RPE over `pairs` pairs of poses: translation in metres, rotation in degrees."""

    pairs: int
    translation: ErrorStats
    rotation: ErrorStats


def associate_trajectories(
    estimated_s: Float, reference_s: Float, max_dt: float
) -> tuple[Index, Index]:
    """Indices of matching poses by their stamps.

    Equal arrays of stamps match one to one. Else each pose of the shorter trajectory is matched
    with the nearest one of the other within `max_dt` seconds.

    Args:
        estimated_s, reference_s: (N,) and (K,) seconds, sorted, N, K >= 1.

    Raises:
        InputError: no two stamps are that close.
    """
    if np.array_equal(estimated_s, reference_s):  # stamps may repeat
        return np.arange(len(estimated_s)), np.arange(len(estimated_s))
    swap = len(estimated_s) > len(reference_s)
    few, many = (reference_s, estimated_s) if swap else (estimated_s, reference_s)
    partner = nearest_index(many, few)
    near = np.flatnonzero(np.abs(many[partner] - few) <= max_dt)
    if not len(near):
        what = f"no two stamps lie within {max_dt:g} s of each other"
        raise InputError(what, hint="other clocks? see max_dt=SECONDS")
    return (partner[near], near) if swap else (near, partner[near])


def project_flat_trajectories(a: Float, b: Float) -> tuple[Float, Float]:
    """Both trajectories (N, 4, 4) as (N, 3, 3) if both lie in the plane z = 0.

    A 3D alignment may flip a flat trajectory; a 2D one cannot.
    """
    return (planar(a), planar(b)) if _is_flat(a) and _is_flat(b) else (a, b)


def planar(T: Float) -> Float:
    """(N, 3, 3) of flat poses (N, 4, 4)."""
    keep = np.array([0, 1, 3])
    return T[:, keep[:, None], keep]


def _is_flat(T: Float) -> bool:
    return bool(np.all(np.abs(T[:, 2, :] - (0.0, 0.0, 1.0, 0.0)) < _PLANAR_TOLERANCE))


def align(estimated: Float, truth: Float, lever: float = 1.0) -> Float:
    """T_truth_estimated that aligns estimated with true poses, (N, D+1, D+1) each, N >= 1.

    Every pose counts as points `lever` metres from its origin in both directions of each axis. So
    headings determine the rotation where positions do not (a robot at rest, or on a straight
    line), and weigh little against a path much longer than the lever.
    """
    return se2.align_points(_arms(estimated, lever), _arms(truth, lever))


def _arms(T: Float, lever: float) -> Float:
    D = T.shape[-1] - 1
    axes = lever * np.swapaxes(T[:, :D, :D], 1, 2)
    origin = T[:, None, :D, D]
    return np.concatenate([origin + axes, origin - axes], axis=1).reshape(-1, D)


def compute_absolute_errors(estimated: Float, reference: Float) -> ErrorStats:
    """ATE in metres: distances between positions after the best rigid alignment.

    Args:
        estimated, reference: (N, D+1, D+1) associated poses, N >= 1.
    """
    D = estimated.shape[-1] - 1
    source, target = estimated[:, :D, D], reference[:, :D, D]
    T = se2.align_points(source, target)
    return summarize_errors(np.linalg.norm(target - (source @ T[:D, :D].T + T[:D, D]), axis=1))


def compute_relative_errors(
    estimated: Float, reference: Float, delta: float = 1.0, unit: Unit = "m"
) -> RelativeErrors:
    """RPE: (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) over all pairs i, j that lie `delta` apart.

    In frames j = i + delta. In metres j is the pose whose distance from i along the reference
    path comes nearest to delta; a pair more than a tenth off is left out.

    Args:
        estimated, reference: (N, D+1, D+1) associated poses P and Q.
        delta: > 0; an integer where the unit is frames.
    """
    i, j = _pairs(reference, delta, unit)
    true_step = se2.inverse(reference[i]) @ reference[j]
    error = se2.inverse(true_step) @ se2.inverse(estimated[i]) @ estimated[j]
    D = error.shape[-1] - 1
    return RelativeErrors(
        pairs=len(i),
        translation=summarize_errors(np.linalg.norm(error[:, :D, D], axis=1)),
        rotation=summarize_errors(np.degrees(_angle(error[:, :D, :D]))),
    )


def _pairs(reference: Float, delta: float, unit: Unit) -> tuple[Index, Index]:
    if unit == "frames":
        step = round(delta)
        if step != delta or step < 1:
            raise InputError(f"a step of {delta:g} frames is not a positive integer")
        first = np.arange(max(len(reference) - step, 0))
        return first, first + step
    if not delta > 0:
        raise InputError(f"a step of {delta:g} m is not positive")
    position = reference[:, :-1, -1]
    path = np.concatenate([[0.0], np.linalg.norm(np.diff(position, axis=0), axis=1).cumsum()])
    ends = path + delta
    second = nearest_index(path, ends)
    first = np.flatnonzero(np.abs(path[second] - ends) <= _PATH_TOLERANCE * delta)
    return first, second[first]


def _angle(R: Float) -> Float:
    """(N,) rad of rotations (N, D, D)."""
    if R.shape[-1] == 2:
        return np.abs(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    if not len(R):  # scipy < 1.15 refuses an empty stack
        return np.zeros(0)
    return np.asarray(scipy.spatial.transform.Rotation.from_matrix(R).magnitude())


def summarize_errors(error: Float) -> ErrorStats:
    """Summary of (N,) errors."""
    if not len(error):
        return ErrorStats(*[NAN] * 4)
    return ErrorStats(
        rmse=float(np.sqrt(np.mean(error**2))),
        mean=float(error.mean()),
        median=float(np.median(error)),
        max=float(error.max()),
    )


def read_paired_poses(result: Path, truth: Truth) -> tuple[Float, Float]:
    """Poses (N, 4, 4) of a result and true ones (N, D+1, D+1) at the same stamps.

    Raises:
        InputError: the trajectory is missing, damaged, or of another recording.
    """
    estimated = readers.read_trajectory(result / "trajectory.tum")
    stamps = readers.to_seconds(truth.recording.stamp_ns)
    try:
        i, j = associate_trajectories(estimated.stamp_s, stamps, _STAMP_TOLERANCE)
    except InputError as error:
        what = f"is not of the recording in {truth.folder}: no stamp in common"
        raise InputError(what, where=str(result)) from error
    return estimated.poses[i], truth.poses()[j]


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
) -> tuple[Float, Bool, int]:
    index = nearest_index(trajectory[:, 0], times)
    poses = trajectory[index, 1:]
    far = np.abs(trajectory[index, 0] - times) > max_dt
    if odometry is None:
        return poses, ~far, 0
    start = nearest_index(odometry[:, 0], trajectory[index[far], 0])
    end = nearest_index(odometry[:, 0], times[far])
    step = _displacement(odometry[start, 1:], odometry[end, 1:])
    poses[far] = se2.parameters(se2.matrix(*poses[far].T) @ se2.matrix(*step.T))
    return poses, np.ones(len(times), bool), int(far.sum())


def _displacement(a: Float, b: Float) -> Float:
    """a^-1 b for (N, 3) poses."""
    return se2.parameters(se2.inverse(se2.matrix(*a.T)) @ se2.matrix(*b.T))


def _summarize(error: Float) -> Spread:
    if not len(error):
        return Spread(*[NAN] * 6)
    ddof = int(len(error) > 1)  # the deviation of one error is 0
    squared = error**2
    return Spread(
        mean=float(error.mean()),
        std=float(error.std(ddof=ddof)),
        squared_mean=float(squared.mean()),
        squared_std=float(squared.std(ddof=ddof)),
        median=float(np.median(error)),
        max=float(error.max()),
    )
