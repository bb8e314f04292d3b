"""Loop candidates, and odometry constraints between keyframes."""

import itertools
from collections.abc import Iterator

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.slam.pose_graph import Constraint
from stillmap.slam.types import LoopCandidate, LoopClosure, LoopContext

MIN_LOOP_TRAVEL = 15.0  # m after which a place counts as revisited
# loops are searched in stages of travel, after each of which the graph is solved: m, share of the
# travel so far
_MIN_STAGE, _STAGE_SHARE = 40.0, 0.05
# drift per m, which sets the search window: m, rad, at least, and m after which it stops growing
_DRIFT_TRANSLATION, DRIFT_ROTATION = 0.006, 0.0003
_MIN_DRIFT, _MAX_DRIFT_TRAVEL = (0.1, 0.02), 1000.0
_STEP_TRANSLATION, _STEP_ROTATION = 0.03, 0.004  # random walk, m and rad per root of a metre
NO_ODOMETRY = [1e3, 1e3, 10.0]  # m, m, rad: std of a step across a break


def drift_std(metres: float) -> tuple[float, float]:
    """Standard deviations of position (m) and heading (rad) after that much travel."""
    metres = min(metres, _MAX_DRIFT_TRAVEL)
    return (
        float(np.hypot(_MIN_DRIFT[0], _DRIFT_TRANSLATION * metres)),
        float(np.hypot(_MIN_DRIFT[1], DRIFT_ROTATION * metres)),
    )


def split_stages(context: LoopContext) -> Iterator[tuple[int, int]]:
    """Ranges (first, last) of keyframes, one per stage of travel; later stages are longer."""
    travelled = context.travelled[context.keyframes]
    first = 0
    while first < len(travelled):
        here = travelled[first]
        until = here + max(_MIN_STAGE, _STAGE_SHARE * here)
        last = max(first + 1, int(np.searchsorted(travelled, until)))
        yield first, last
        first = last


def graph_distances(context: LoopContext, k: int, closures: list[LoopClosure]) -> Float:
    """(k + 1,) m of drift between the keyframes up to k and keyframe k.

    The shortest path through the graph: along the chain, or through closures, each of which counts
    as the travel whose drift equals its standard deviation.
    """
    steps = np.diff(context.travelled[context.keyframes[: k + 1]])
    covariance = np.array([closure.covariance[:2, :2] for closure in closures]).reshape(-1, 2, 2)
    std: Float = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    return _shortest_paths(context, k, steps, closures, std / max(_DRIFT_TRANSLATION, 1e-9))


def _shortest_paths(
    context: LoopContext, k: int, steps: Float, closures: list[LoopClosure], lengths: Float
) -> Float:
    """(k + 1,) lengths of the shortest paths through the graph from keyframe k.

    Args:
        context: the trajectory.
        k: index into the keyframes.
        steps: (k,) lengths between successive keyframes.
        closures: further edges.
        lengths: of them.
    """
    is_before = np.array([closure.later <= context.keyframes[k] for closure in closures], np.bool_)
    if not is_before.any():
        return np.append(steps[::-1].cumsum()[::-1], 0.0)
    scans = np.array([[closure.earlier, closure.later] for closure in closures])[is_before]
    first, second = np.searchsorted(context.keyframes, scans).T
    ends = np.append(np.arange(k), first), np.append(np.arange(1, k + 1), second)
    # even where the robot stands a path through fewer keyframes is the shorter one
    weights = np.concatenate([steps, lengths[is_before]]).clip(1e-9)
    return _core.shortest_paths(np.stack(ends, axis=1), weights, k + 1, k)


def blind_stds(context: LoopContext, k: int, closures: list[LoopClosure]) -> tuple[Float, Float]:
    """(k + 1,) standard deviations, m and rad, that blind steps add between keyframes and k.

    Of the path through chain and closures with the least variance of the heading. An error of the
    heading moves all that follows.
    """
    keyframes = context.keyframes[: k + 1]
    blind = np.diff(context.drift.cumsum(axis=0)[keyframes], axis=0)
    covariance = np.array([closure.covariance for closure in closures]).reshape(-1, 3, 3)
    steps = np.linalg.eigvalsh(blind[:, :2, :2])[:, 1], blind[:, 2, 2]
    lengths = np.linalg.eigvalsh(covariance[:, :2, :2])[:, 1], covariance[:, 2, 2]
    variances = [
        _shortest_paths(context, k, *pair)
        for pair in ((steps[0], closures, lengths[0]), (steps[1], closures, lengths[1]))
    ]
    spread = context.poses[keyframes][:, :2, 2].std(axis=0)
    lever2 = float(spread @ spread)
    return np.sqrt(variances[0] + lever2 * variances[1]), np.sqrt(variances[1])


def view_centers(context: LoopContext) -> Float:
    """(K, 2) weighted mean of the end points of each keyframe, in its frame."""
    out = np.zeros((len(context.keyframes), 2))
    keyframes = context.recording.iter_scans(context.keyframes.tolist(), context.e)
    for k, t in enumerate(keyframes):
        scan = context.hits(t)
        if scan.weights.sum() > 0.0:
            out[k] = np.average(scan.points, axis=0, weights=scan.weights)
    return out


def propose_candidates(
    context: LoopContext,
    poses: Float,
    centers: Float,
    first: int,
    last: int,
    closures: list[LoopClosure],
) -> Iterator[LoopCandidate]:
    """Each keyframe of a stage with the nearest one of much earlier travel, if near enough.

    Otherwise with the one whose view center is nearest: a robot that returns on the other side of a
    street sees the same place from elsewhere.

    Args:
        context: the trajectory.
        poses: (K, 3, 3) keyframes, corrected so far.
        centers: (K, 2) their view centers, in their frames.
        first, last: range of keyframes of the stage.
        closures: accepted ones of earlier stages.
    """
    keyframes, travelled = context.keyframes, context.travelled[context.keyframes]
    x = se2.parameters(poses)
    metres = graph_distances(context, first, closures)
    blind_xy, blind_heading = blind_stds(context, first, closures)
    in_map = np.einsum("kij,kj->ki", poses[:, :2, :2], centers) + poses[:, :2, 2]
    for k in range(first, last):
        n = int(np.searchsorted(travelled, travelled[k] - MIN_LOOP_TRAVEL))
        if n == 0:
            continue
        distance = np.linalg.norm(x[:n, :2] - x[k, :2], axis=1)
        turn = np.abs(se2.wrap(x[:n, 2] - x[k, 2]))
        view_distance = np.linalg.norm(in_map[:n] - in_map[k], axis=1)
        # where there is a choice, a keyframe with the same heading
        for cost, off in ((distance + turn, distance), (view_distance, view_distance)):
            i = int(np.argmin(cost))
            drift = travelled[k] - travelled[i]
            if i < first:
                drift = min(drift, travelled[k] - travelled[first] + metres[i])
            blind = float(blind_xy[min(i, first)]), float(blind_heading[min(i, first)])
            if off[i] < context.search_distance + np.hypot(drift_std(drift)[0], blind[0]):
                T = se2.inverse(poses[i]) @ poses[k]
                yield LoopCandidate(int(keyframes[i]), int(keyframes[k]), T, float(drift), blind)
                break


def odometry_constraints(context: LoopContext, breaks: list[int]) -> list[Constraint]:
    """Constraints between successive keyframes, indexed by keyframe.

    Their covariance is that of a random walk, half as wide across as along the motion. A
    step across a break is unconstrained.
    """
    keyframes, poses = context.keyframes, context.poses
    chain = []
    for k, (i, j) in enumerate(itertools.pairwise(keyframes)):
        T = se2.inverse(poses[i]) @ poses[j]
        covariance = _step_covariance(T, float(context.travelled[j] - context.travelled[i]))
        back = se2.inverse(poses[j])
        covariance += se2.rotate_covariance(context.drift[i + 1 : j + 1].sum(axis=0), back)
        if j in breaks:
            covariance = np.diag(np.square(NO_ODOMETRY))
        chain.append(Constraint(k, k + 1, T, covariance))
    return chain


def _step_covariance(T: Float, metres: float) -> Float:
    # rotation on the spot and standing still are not free of error either
    root = np.sqrt(metres + abs(float(se2.parameters(T)[2])) + 0.05)
    xy, theta = _STEP_TRANSLATION * root, _STEP_ROTATION * root
    return np.diag([xy**2, (0.5 * xy) ** 2, theta**2])
