"""Which keyframes may see again what was seen much earlier, and how sure the graph is of where.

The chain of keyframes: how sure the way from one to the next is, and what loops make of it.
"""

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.slam import motion_model
from stillmap.slam.loop_types import (
    LoopCandidate,
    LoopClosure,
    LoopContext,
    LoopOptions,
    drift,
    refuse,
)
from stillmap.slam.motion_model import MotionOptions
from stillmap.slam.pose_graph import Constraint
from stillmap.slam.scan_matching import select_hits

Float = NDArray[np.float64]


def split_stages(track: LoopContext) -> Iterator[tuple[int, int]]:
    """Ranges first, last of keyframes: each a stage of travel, later ones longer."""
    options, travelled = track.options, track.travelled[track.keyframes]
    first = 0
    while first < len(travelled):
        here = travelled[first]
        until = here + max(options.stage, options.stage_share * here)
        last = max(first + 1, int(np.searchsorted(travelled, until)))
        yield first, last
        first = last


def graph_distances(track: LoopContext, k: int, ties: list[LoopClosure]) -> Float:
    """(k + 1,) metres of drift between the keyframes up to k and keyframe k.

    The shortest way through the graph: along the chain, or through a closure, which counts as the
    metres that drift as much as it may be wrong. A loop closed elsewhere shortens no way here.
    """
    from scipy import sparse
    from scipy.sparse import csgraph  # takes long to load

    travelled = track.travelled[track.keyframes[: k + 1]]
    ties = [closure for closure in ties if closure.later <= track.keyframes[k]]
    if not ties:
        along: Float = travelled[k] - travelled
        return along
    scans = np.array([[closure.earlier, closure.later] for closure in ties])
    first, second = np.searchsorted(track.keyframes, scans).T
    # no edge may weigh zero: that would be none
    weights = np.concatenate([np.diff(travelled), _counted(ties, track.options)]).clip(1e-9)
    ends = np.append(np.arange(k), first), np.append(np.arange(1, k + 1), second)
    graph = sparse.csr_array((weights, ends), shape=(k + 1, k + 1))
    metres: Float = csgraph.dijkstra(graph, directed=False, indices=[k])[0]
    return metres


def _counted(ties: list[LoopClosure], options: LoopOptions) -> Float:
    """(L,) metres of drift that closures count as."""
    covariance = np.array([closure.covariance[:2, :2] for closure in ties])
    sigma: Float = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    return sigma / max(options.drift_translation, 1e-9)


def view_centers(track: LoopContext) -> Float:
    """(K, 2) where the keyframes look: the mean of what each saw, in its frame."""
    out = np.zeros((len(track.keyframes), 2))
    keyframes = track.recording.iter_scans(track.keyframes.tolist(), track.e)
    for k, t in enumerate(keyframes):
        scan = select_hits(track.recording, track.e, t)
        if scan.weights.sum() > 0.0:
            out[k] = np.average(scan.points, axis=0, weights=scan.weights)
    return out


def propose_candidates(
    track: LoopContext, poses: Float, looks: Float, first: int, last: int, ties: list[LoopClosure]
) -> Iterator[LoopCandidate]:
    """Keyframes of a stage with the nearest of much earlier travel, where that lies within reach.

    If it does not, with the one that looked nearest to where it looks: who comes back on the other
    side of a street is never near where it was.

    Args:
        track: where loops are looked for.
        poses: (K, 3, 3) the keyframes as far as they are corrected.
        looks: (K, 2) where they look, in their frames.
        first, last: the stage.
        ties: closures of earlier stages that are taken for true.
    """
    options, frames = track.options, track.keyframes
    x, travelled = se2.parameters(poses), track.travelled[frames]
    metres = graph_distances(track, first, ties)
    looked_at = np.einsum("kij,kj->ki", poses[:, :2, :2], looks) + poses[:, :2, 2]
    for k in range(first, last):
        n = int(np.searchsorted(travelled, travelled[k] - options.gap))
        if n == 0:
            continue
        distance = np.linalg.norm(x[:n, :2] - x[k, :2], axis=1)
        turned = np.abs(se2.wrap(x[:n, 2] - x[k, 2]))
        across = np.linalg.norm(looked_at[:n] - looked_at[k], axis=1)
        # seen from the same side, where there is a choice
        for cost, metres_off in ((distance + turned, distance), (across, across)):
            i = int(np.argmin(cost))
            way = travelled[k] - travelled[i]
            if i < first:
                way = min(way, travelled[k] - travelled[first] + metres[i])
            if metres_off[i] < options.reach + drift(way, options)[0]:
                T = se2.inverse(poses[i]) @ poses[k]
                yield LoopCandidate(int(frames[i]), int(frames[k]), T, float(way))
                break


_NEAR = np.array([8.0, 4.0])  # keyframes on the earlier and on the later side that count as nearby

_ANYWHERE = [1e3, 1e3, 10.0]  # m, m, rad: a step that nobody saw

_LEAP = 3.0  # standard deviations of the motion prior beyond which an increment is a leap


def odometry_constraints(
    track: LoopContext, options: MotionOptions, breaks: list[int]
) -> list[Constraint]:
    """Relations between successive keyframes, indices into the keyframes.

    Their covariances allow for drift, half as much across as along the way. Where odometry
    contradicts the poses by a leap, the way may be wrong by as much. A step across a break, from
    the scan before it, says nothing.
    """
    frames, poses = track.keyframes, track.poses
    leaps = _leaps(track.recording, poses, options)
    chain = []
    for k, (i, j) in enumerate(itertools.pairwise(frames)):
        T = se2.inverse(poses[i]) @ poses[j]
        covariance = _drift(T, float(track.travelled[j] - track.travelled[i]), track.options)
        for t in range(i + 1, j + 1):
            if leaps[t].any():
                to_j = se2.inverse(poses[j]) @ poses[t]
                covariance += se2.rotate_covariance(np.outer(leaps[t], leaps[t]), to_j)
        if j in breaks:
            covariance = np.diag(np.square(_ANYWHERE))
        chain.append(Constraint(k, k + 1, T, covariance))
    return chain


def _drift(T: Float, metres: float, options: LoopOptions) -> Float:
    # turning on the spot and standing still are not free of error either
    root = np.sqrt(metres + abs(float(se2.parameters(T)[2])) + 0.05)
    xy, theta = options.step_translation * root, options.step_rotation * root
    return np.diag([xy**2, (0.5 * xy) ** 2, theta**2])


def _leaps(recording: Recording, poses: Float, options: MotionOptions) -> Float:
    """(T, 3) by how much the motion to each scan contradicts odometry; 0 where it hardly does."""
    leaps = np.zeros((len(poses), 3))
    if recording.T_odom_base is None:
        return leaps
    increments = se2.inverse(recording.T_odom_base[:-1]) @ recording.T_odom_base[1:]
    found = se2.inverse(poses[:-1]) @ poses[1:]
    difference = se2.parameters(se2.inverse(increments) @ found)
    for t, (increment, d) in enumerate(zip(increments, difference, strict=True), start=1):
        prior = motion_model.odometry_prior(np.eye(3), increment, options)
        sigma = np.array([prior.sigma_translation] * 2 + [prior.sigma_rotation])
        if np.linalg.norm(d / sigma) > _LEAP:
            leaps[t] = d
    return leaps


def reject_inconsistent(
    track: LoopContext, chain: list[Constraint], found: list[LoopClosure]
) -> list[LoopClosure]:
    """Refuses closures whose correction the ones nearby do not ask for.

    Nearby: within four keyframes of travel on the later side, eight on the earlier one. At least
    `agreeing` of them and half of them all have to agree.
    """
    options, travelled = track.options, track.travelled
    candidates = [closure for closure in found if not closure.refused]
    at = np.array([[travelled[c.earlier], travelled[c.later]] for c in candidates]).reshape(-1, 2)
    far = _NEAR * options.distance
    drifted = _drifted(track, chain)
    out = []
    for closure in found:
        if not closure.refused:
            apart = np.abs(at - [travelled[closure.earlier], travelled[closure.later]])
            near = [candidates[n] for n in np.flatnonzero((apart < far).all(axis=1))]
            votes = [_agree(track, drifted, closure, c) for c in near if c is not closure]
            if sum(votes) < max(options.agreeing, len(votes) / 2):
                closure = refuse(closure, "closures around disagree")
        out.append(closure)
    return out


def reject_inconsistent_since(
    track: LoopContext,
    chain: list[Constraint],
    attempted: list[LoopClosure],
    decided: list[LoopClosure],
    k: int,
) -> list[LoopClosure]:
    """What `agreeing` makes of all attempts, when those from keyframe k on are new.

    Args:
        track, chain: as `agreeing` has them.
        attempted: all, by the later scan.
        decided: what it made of those before.
        k: index into the keyframes.
    """
    later = [track.travelled[closure.later] for closure in attempted]
    near = _NEAR[1] * track.options.distance
    new, heard = np.searchsorted(later, track.travelled[track.keyframes[k]] - [near, 2 * near])
    # their votes reach back one neighbourhood, and what is there hears one more
    return decided[:new] + reject_inconsistent(track, chain, attempted[heard:])[new - heard :]


def _drifted(track: LoopContext, chain: list[Constraint]) -> Float:
    """(K, 3, 3) covariance that the steps to each keyframe add up to, along the axes of the map."""
    poses = track.poses[track.keyframes[1:]]
    steps = np.array([relation.covariance for relation in chain]).reshape(-1, 3, 3)
    out = np.zeros((len(track.keyframes), 3, 3))
    np.cumsum(se2.rotate_covariance(steps, poses), axis=0, out=out[1:])
    return out


def _agree(track: LoopContext, drifted: Float, a: LoopClosure, b: LoopClosure) -> bool:
    """Whether two closures put their later scans where the way between them allows."""
    a, b = (a, b) if a.later <= b.later else (b, a)
    P = track.poses
    here = P[a.earlier] @ a.T
    predicted = here @ se2.inverse(P[a.later]) @ P[b.later]
    d = se2.parameters(se2.inverse(predicted) @ P[b.earlier] @ b.T)
    back = se2.inverse(P[b.later])
    i, j = np.searchsorted(track.keyframes, [a.later, b.later])
    between = se2.rotate_covariance(a.covariance, P[a.later]) + drifted[j] - drifted[i]
    covariance = b.covariance + se2.rotate_covariance(between, back)
    return float(d @ np.linalg.solve(covariance, d)) < 9.0
