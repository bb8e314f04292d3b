"""A graph of poses in the plane: what is known of pairs of them, and the poses that fit best.

The only file that knows GTSAM. Its factors compare x, y, heading in the frame of the second pose.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import se2

Float = NDArray[np.float64]

# relative change of the cost at which a solution is one, and one is near enough to go on from
_EXACT, _ROUGH = 1e-7, 1e-3


@dataclass(frozen=True, eq=False)
class Relation:
    """T_first_second as somebody measured it.

    Attributes:
        first, second: indices of poses, of keyframes in a Graph.
        T: (3, 3).
        covariance: (3, 3) of x, y, heading in the frame of the second pose.
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
class Graph:
    """What is known of the keyframes of a recording.

    Attributes:
        scans: (K,) numbers of the scans that are keyframes, rising.
        poses: (K, 3, 3) T_map_base that fit the relations best.
        relations: along the way first, then the loops that were accepted; between keyframes.
    """

    scans: NDArray[np.intp]
    poses: Float
    relations: list[Relation]


def optimised(
    poses: Float, chain: list[Relation], loops: list[Relation], robust: Robust | None
) -> Float:
    """(K, 3, 3) poses of least squares; the first one stays where it is.

    With `robust`, loops that the others contradict lose their weight: Geman and McClure's loss,
    which is made sharper from solution to solution (graduated non-convexity, Yang et al., RA-L
    2020), so that the start does not decide which of them are believed.

    Args:
        poses: (K, 3, 3) the start.
        chain: relations that are trusted.
        loops: relations that may be false.
        robust: None: plain least squares.
    """
    problem = _problem(poses, chain)
    found = _least_squares(problem, problem.start, loops, np.ones(len(loops)), _EXACT)
    out = _poses(found, poses[0])
    if robust is None or not loops:
        return out
    chi2 = misfits(out, loops)
    # a loop that is sure fits well even if it is false: then the way had to bend for it
    if np.append(chi2, misfits(out, chain)).max() <= robust.misfit:
        return out  # nothing contradicts anything
    blunt = 2.0 * chi2.max() / robust.misfit
    for step in range(robust.steps):
        mu = max(blunt ** (1.0 - (step + 1) / robust.steps), 1.0)
        weights = (mu * robust.misfit / (chi2 + mu * robust.misfit)) ** 2
        tolerance = _EXACT if step + 1 == robust.steps else _ROUGH
        found = _least_squares(problem, found, loops, weights, tolerance)
        out = _poses(found, poses[0])
        chi2 = misfits(out, loops)
    return out


@dataclass(frozen=True, eq=False)
class _Problem:
    """What stays from solution to solution, as GTSAM has it."""

    chain: Any
    start: Any


def _problem(poses: Float, chain: list[Relation]) -> _Problem:
    import gtsam  # takes long to load

    start = gtsam.Values()
    for k, parameters in enumerate(se2.parameters(poses)):
        start.insert(k, gtsam.Pose2(*parameters))
    graph = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    graph.add(gtsam.PriorFactorPose2(0, start.atPose2(0), fixed))
    for relation in chain:
        graph.add(_factor(relation, 1.0))
    return _Problem(graph, start)


def _least_squares(
    problem: _Problem, start: Any, loops: list[Relation], weights: Float, tolerance: float
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
    """(K, 3, 3) of GTSAM's values; the first one is known."""
    import gtsam

    out = se2.matrix(*gtsam.utilities.extractPose2(found).T)
    out[0] = first
    return out


def misfits(poses: Float, relations: list[Relation]) -> Float:
    """(L,) squared Mahalanobis distances of relations to the poses: chi-square, 3 degrees."""
    if not relations:
        return np.zeros(0)
    first, second = np.array([[r.first, r.second] for r in relations]).T
    found = se2.inverse(poses[first]) @ poses[second]
    d = se2.parameters(se2.inverse(np.array([r.T for r in relations])) @ found)
    solved = np.linalg.solve(np.array([r.covariance for r in relations]), d[..., None])[..., 0]
    out: Float = (d * solved).sum(axis=1)
    return out


def _factor(relation: Relation, weight: float) -> Any:
    import gtsam

    noise = gtsam.noiseModel.Gaussian.Covariance(relation.covariance / weight)
    T = gtsam.Pose2(*se2.parameters(relation.T))
    return gtsam.BetweenFactorPose2(relation.first, relation.second, T, noise)
