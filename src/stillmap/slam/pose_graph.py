"""Pose graph optimization. The only module that uses GTSAM.

Residuals of constraints are x, y, heading in the frame of the second pose in 2D, and the twist
(translation, rotation) to it in 3D. The shape of the poses, (K, 3, 3) or (K, 4, 4), decides.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from stillmap.core import se2, se3
from stillmap.core.array_types import Float, Index
from stillmap.core.short_repr import ShortRepr

_TOLERANCE, _COARSE_TOLERANCE = 1e-7, 1e-3  # relative change of the cost; coarse between steps
_ANNEALING_STEPS = 8  # solutions of graduated non-convexity
_PRIOR_STD = 1e-6  # of the first pose, which is fixed


@dataclass(frozen=True, eq=False)
class Constraint(ShortRepr):
    """A measured relative pose T_first_second (a between factor).

    Attributes:
        first, second: indices of poses; of keyframes in a PoseGraph.
        T: (D+1, D+1).
        covariance: (3, 3) of x, y, heading in the frame of the second pose; in 3D (6, 6) of
            translation and rotation.
    """

    first: int
    second: int
    T: Float
    covariance: Float


class HeadingMeasurement(NamedTuple):
    """A measured heading of a pose in 2D.

    Attributes:
        pose: its index.
        heading: rad, in a frame that all headings share.
        variance: rad2.
    """

    pose: int
    heading: float
    variance: float


@dataclass(frozen=True, eq=False)
class PoseGraph(ShortRepr):
    """Keyframes and the constraints between them.

    Attributes:
        keyframes: (K,) scan numbers, increasing.
        poses: (K, D+1, D+1) optimized T_map_base.
        constraints: between keyframes: successive ones first, then accepted loop closures.
    """

    keyframes: Index
    poses: Float
    constraints: list[Constraint]


def optimize_poses(
    poses: Float, chain: list[Constraint], loops: list[Constraint], max_chi2: float | None = None
) -> Float:
    """(K, D+1, D+1) poses of least squares; the first pose is fixed.

    With `max_chi2`, contradicted loops lose their weight by the Geman-McClure kernel, sharpened
    from solution to solution (graduated non-convexity, Yang et al., RA-L 2020), so that the start
    does not decide which loops count.

    Args:
        poses: (K, D+1, D+1) the start.
        chain: trusted constraints.
        loops: constraints that may be false.
        max_chi2: chi-square at which a loop keeps a quarter of its weight; None: no kernel.
    """
    import gtsam  # loading it takes long

    graph, start = _build_problem(poses, chain)
    is_2d = poses.shape[-1] == 3
    fixed = gtsam.noiseModel.Isotropic.Sigma(3 if is_2d else 6, _PRIOR_STD)
    prior_factor = gtsam.PriorFactorPose2 if is_2d else gtsam.PriorFactorPose3
    graph.add(prior_factor(0, _to_gtsam(poses[:1])[0], fixed))

    def solve(start: Any, weights: Float, tolerance: float) -> Any:
        weighted = graph.clone()
        _add_factors(weighted, loops, np.maximum(weights, 1e-9))
        return _solve(weighted, start, tolerance)

    found = solve(start, np.ones(len(loops)), _TOLERANCE)
    out = _extract_poses(found, poses[0])
    if max_chi2 is None or not loops:
        return out
    chi2 = squared_mahalanobis(out, loops)
    # a precise but false loop fits well by bending the chain: test the chain too
    if np.append(chi2, squared_mahalanobis(out, chain)).max() <= max_chi2:
        return out
    blunt = 2.0 * chi2.max() / max_chi2
    for step in range(_ANNEALING_STEPS):
        mu = max(blunt ** (1.0 - (step + 1) / _ANNEALING_STEPS), 1.0)
        weights = (mu * max_chi2 / (chi2 + mu * max_chi2)) ** 2
        is_last = step + 1 == _ANNEALING_STEPS
        found = solve(found, weights, _TOLERANCE if is_last else _COARSE_TOLERANCE)
        out = _extract_poses(found, poses[0])
        chi2 = squared_mahalanobis(out, loops)
    return out


def optimize_headings(
    poses: Float, constraints: list[Constraint], headings: Sequence[HeadingMeasurement]
) -> Float:
    """(K, 3, 3) poses of least squares whose headings were measured, weighted by the Cauchy kernel.

    The frame of the headings may be rotated against that of the map: the solution is transformed
    so that the first pose stays as it is.

    Args:
        poses: (K, 3, 3) the start.
        constraints: trusted constraints.
        headings: at least one.
    """
    import gtsam

    graph, start = _build_problem(poses, constraints)
    noise = gtsam.noiseModel
    fixed = noise.Isotropic.Sigma(2, _PRIOR_STD)
    graph.add(gtsam.PoseTranslationPrior2D(0, poses[0, :2, 2], fixed))
    for one in headings:
        model = noise.Isotropic.Sigma(1, float(np.sqrt(one.variance)))
        robust = noise.Robust.Create(noise.mEstimator.Cauchy.Create(1.0), model)
        graph.add(gtsam.PoseRotationPrior2D(one.pose, gtsam.Rot2(one.heading), robust))
    found = se2.matrix(*gtsam.utilities.extractPose2(_solve(graph, start, _TOLERANCE)).T)
    out: Float = se2.normalize(poses[0] @ se2.inverse(found[0]) @ found)
    out[0] = poses[0]
    return out


def squared_mahalanobis(poses: Float, constraints: list[Constraint]) -> Float:
    """(L,) squared Mahalanobis distances of the residuals: chi-square, 3 or 6 degrees."""
    if not constraints:
        return np.zeros(0)
    first, second = np.array([[c.first, c.second] for c in constraints]).T
    found = se2.inverse(poses[first]) @ poses[second]
    residual = se2.inverse(np.array([c.T for c in constraints])) @ found
    d = se2.parameters(residual) if residual.shape[-1] == 3 else se3.log(residual)
    solved = np.linalg.solve(np.array([c.covariance for c in constraints]), d[..., None])[..., 0]
    out: Float = (d * solved).sum(axis=1)
    return out


def _build_problem(poses: Float, chain: list[Constraint]) -> tuple[Any, Any]:
    """GTSAM's factor graph of the chain and the initial values."""
    import gtsam

    start, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for k, pose in enumerate(_to_gtsam(poses)):
        start.insert(k, pose)
    _add_factors(graph, chain, np.ones(len(chain)))
    return graph, start


def _solve(graph: Any, start: Any, tolerance: float) -> Any:
    """Values of least squares; `tolerance`: relative change of the cost."""
    import gtsam

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def _extract_poses(found: Any, first: Float) -> Float:
    """(K, D+1, D+1) poses of GTSAM's values; the first one is known exactly."""
    import gtsam

    if len(first) == 3:
        out = se2.matrix(*gtsam.utilities.extractPose2(found).T)
    else:
        rows = gtsam.utilities.extractPose3(found)  # nine of the rotation, by rows; x, y, z
        out = np.tile(np.eye(4), (len(rows), 1, 1))
        out[:, :3, :3], out[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    out[0] = first
    return out


def _add_factors(graph: Any, constraints: list[Constraint], weights: Float) -> None:
    """Add constraints with their weights (L,) to GTSAM's factor graph."""
    import gtsam

    if not constraints:
        return
    measured = np.array([one.T for one in constraints])
    covariance = np.array([one.covariance for one in constraints]) / weights[:, None, None]
    factor: Any = gtsam.BetweenFactorPose2
    if measured.shape[-1] == 4:
        factor = gtsam.BetweenFactorPose3
        covariance = np.roll(covariance, 3, axis=(1, 2))  # GTSAM puts the rotation first
    for one, T, of in zip(constraints, _to_gtsam(measured), covariance, strict=True):
        graph.add(factor(one.first, one.second, T, gtsam.noiseModel.Gaussian.Covariance(of)))


def _to_gtsam(poses: Float) -> list[Any]:
    """Poses (K, D+1, D+1) as GTSAM's objects."""
    import gtsam

    if poses.shape[-1] == 3:
        return [gtsam.Pose2(*parameters) for parameters in se2.parameters(poses)]
    return [gtsam.Pose3(pose) for pose in poses]
