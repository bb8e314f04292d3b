"""A graph of poses in the plane: what is known of pairs of them, and the poses that fit best.

The only file that knows GTSAM. Its factors compare x, y, heading in the frame of the second pose.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import se2

Float = NDArray[np.float64]


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
    poses: Float, chain: list[Relation], loops: list[Relation], robust: float | None
) -> Float:
    """(K, 3, 3) poses of least squares; the first one stays where it is.

    Args:
        poses: (K, 3, 3) the start.
        chain: relations that are trusted.
        loops: relations that may be false.
        robust: standard deviations beyond which Cauchy's loss takes weight from a loop; None:
            plain least squares.
    """
    import gtsam  # takes long to load

    graph = gtsam.NonlinearFactorGraph()
    start = gtsam.Values()
    for k, parameters in enumerate(se2.parameters(poses)):
        start.insert(k, gtsam.Pose2(*parameters))
    fixed = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*se2.parameters(poses[0])), fixed))
    for relation in chain:
        graph.add(_factor(relation, None))
    for relation in loops:
        graph.add(_factor(relation, robust))
    options = gtsam.LevenbergMarquardtParams()
    options.setRelativeErrorTol(1e-7)
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, options).optimize()
    at = [found.atPose2(k) for k in range(len(poses))]
    out = se2.matrix(*np.array([[p.x(), p.y(), p.theta()] for p in at]).T)
    out[0] = poses[0]
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


def _factor(relation: Relation, robust: float | None) -> Any:
    import gtsam

    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(relation.covariance)
    if robust is not None:
        loss = gtsam.noiseModel.mEstimator.Cauchy.Create(robust)
        noise = gtsam.noiseModel.Robust.Create(loss, noise)
    T = gtsam.Pose2(*se2.parameters(relation.T))
    return gtsam.BetweenFactorPose2(relation.first, relation.second, T, noise)
