"""A graph of poses: what is known of pairs of them, and the poses that fit best.

The only file that knows GTSAM. In the plane its factors compare x, y, heading in the frame of the
second pose, in space the twist that leads to it: (translation, rotation). Which it is, the shape of
the poses tells: (K, 3, 3) or (K, 4, 4).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2, se3

Float = NDArray[np.float64]

# relative change of the cost at which a solution is one, and one is near enough to go on from
_EXACT, _ROUGH = 1e-7, 1e-3


@dataclass(frozen=True, eq=False)
class Constraint:
    """T_first_second as somebody measured it.

    Attributes:
        first, second: indices of poses, of keyframes in a Graph.
        T: (D+1, D+1).
        covariance: (3, 3) of x, y, heading in the frame of the second pose; in space (6, 6) of
            translation and rotation.
    """

    first: int
    second: int
    T: Float
    covariance: Float


@dataclass(frozen=True)
class Robust:
    """How loops that others contradict lose their weight.

    Attributes:
        misfit: chi-square at which a loop is left a quarter of it.
        steps: solutions with ever sharper weights; 1: sharp at once.
    """

    misfit: float
    steps: int


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """What is known of the keyframes of a recording.

    Attributes:
        scans: (K,) numbers of the scans that are keyframes, rising.
        poses: (K, D+1, D+1) T_map_base that fit the relations best.
        relations: along the way first, then the loops that were accepted; between keyframes.
    """

    keyframes: NDArray[np.intp]
    poses: Float
    constraints: list[Constraint]


def optimize_poses(
    poses: Float, chain: list[Constraint], loops: list[Constraint], robust: Robust | None
) -> Float:
    """(K, D+1, D+1) poses of least squares; the first one stays where it is.

    With `robust`, loops that the others contradict lose their weight: Geman and McClure's loss,
    which is made sharper from solution to solution (graduated non-convexity, Yang et al., RA-L
    2020), so that the start does not decide which of them are believed.

    Args:
        poses: (K, D+1, D+1) the start.
        chain: relations that are trusted.
        loops: relations that may be false.
        robust: None: plain least squares.
    """
    problem = _problem(poses, chain)
    found = _least_squares(problem, problem.start, loops, np.ones(len(loops)), _EXACT)
    out = _poses(found, poses[0])
    if robust is None or not loops:
        return out
    chi2 = squared_mahalanobis(out, loops)
    # a loop that is sure fits well even if it is false: then the way had to bend for it
    if np.append(chi2, squared_mahalanobis(out, chain)).max() <= robust.misfit:
        return out  # nothing contradicts anything
    blunt = 2.0 * chi2.max() / robust.misfit
    for step in range(robust.steps):
        mu = max(blunt ** (1.0 - (step + 1) / robust.steps), 1.0)
        weights = (mu * robust.misfit / (chi2 + mu * robust.misfit)) ** 2
        tolerance = _EXACT if step + 1 == robust.steps else _ROUGH
        found = _least_squares(problem, found, loops, weights, tolerance)
        out = _poses(found, poses[0])
        chi2 = squared_mahalanobis(out, loops)
    return out


@dataclass(frozen=True, eq=False)
class _Problem:
    """What stays from solution to solution, as GTSAM has it."""

    chain: Any
    start: Any


def _problem(poses: Float, chain: list[Constraint]) -> _Problem:
    import gtsam  # takes long to load

    start, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for k, pose in enumerate(_as_gtsam(poses)):
        start.insert(k, pose)
    if poses.shape[-1] == 3:
        fixed = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
        graph.add(gtsam.PriorFactorPose2(0, start.atPose2(0), fixed))
    else:
        fixed = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
        graph.add(gtsam.PriorFactorPose3(0, start.atPose3(0), fixed))
    for relation in chain:
        graph.add(_factor(relation, 1.0))
    return _Problem(graph, start)


def _least_squares(
    problem: _Problem, start: Any, loops: list[Constraint], weights: Float, tolerance: float
) -> Any:
    """The poses as GTSAM's values, to a relative tolerance of the cost."""
    import gtsam

    graph = problem.chain.clone()
    for relation, weight in zip(loops, weights.tolist(), strict=True):
        graph.add(_factor(relation, max(weight, 1e-9)))
    options = gtsam.LevenbergMarquardtParams()
    options.setRelativeErrorTol(tolerance)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, options).optimize()


def _poses(found: Any, first: Float) -> Float:
    """(K, D+1, D+1) of GTSAM's values; the first one is known."""
    import gtsam

    if len(first) == 3:
        out = se2.matrix(*gtsam.utilities.extractPose2(found).T)
    else:
        rows = gtsam.utilities.extractPose3(found)  # nine of the rotation, by rows; x, y, z
        out = np.tile(np.eye(4), (len(rows), 1, 1))
        out[:, :3, :3], out[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    out[0] = first
    return out


def squared_mahalanobis(poses: Float, relations: list[Constraint]) -> Float:
    """(L,) squared Mahalanobis distances of relations to the poses: chi-square, 3 or 6 degrees."""
    if not relations:
        return np.zeros(0)
    first, second = np.array([[r.first, r.second] for r in relations]).T
    found = se2.inverse(poses[first]) @ poses[second]
    apart = se2.inverse(np.array([r.T for r in relations])) @ found
    d = se2.parameters(apart) if apart.shape[-1] == 3 else se3.log(apart)
    solved = np.linalg.solve(np.array([r.covariance for r in relations]), d[..., None])[..., 0]
    out: Float = (d * solved).sum(axis=1)
    return out


def _factor(relation: Constraint, weight: float) -> Any:
    import gtsam

    covariance = relation.covariance / weight
    factor: Any = gtsam.BetweenFactorPose2
    if len(relation.T) == 4:
        factor = gtsam.BetweenFactorPose3
        covariance = np.roll(covariance, 3, axis=(0, 1))  # GTSAM has the rotation first
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    [T] = _as_gtsam(relation.T[None])
    return factor(relation.first, relation.second, T, noise)


def _as_gtsam(poses: Float) -> list[Any]:
    """Poses (K, D+1, D+1) as GTSAM has them."""
    import gtsam

    if poses.shape[-1] == 3:
        return [gtsam.Pose2(*parameters) for parameters in se2.parameters(poses)]
    return [gtsam.Pose3(pose) for pose in poses]
