"""The chain of keyframes: how sure the way from one to the next is, and what loops make of it."""

import itertools

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.recording.model import Recording
from stillmap.slam import motion
from stillmap.slam.loops import Closure, LoopOptions, Track, refuse
from stillmap.slam.motion import MotionOptions
from stillmap.slam.pose_graph import Relation

Float = NDArray[np.float64]

_NEAR = np.array([8.0, 4.0])  # keyframes on the earlier and on the later side that count as nearby
_ANYWHERE = [1e3, 1e3, 10.0]  # m, m, rad: a step that nobody saw
_LEAP = 3.0  # standard deviations of the motion prior beyond which an increment is a leap


def relations(track: Track, options: MotionOptions, breaks: list[int]) -> list[Relation]:
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
                covariance += se2.turned(np.outer(leaps[t], leaps[t]), to_j)
        if j in breaks:
            covariance = np.diag(np.square(_ANYWHERE))
        chain.append(Relation(k, k + 1, T, covariance))
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
        prior = motion.from_odometry(np.eye(3), increment, options)
        sigma = np.array([prior.sigma_translation] * 2 + [prior.sigma_rotation])
        if np.linalg.norm(d / sigma) > _LEAP:
            leaps[t] = d
    return leaps


def agreeing(track: Track, chain: list[Relation], found: list[Closure]) -> list[Closure]:
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


def agreeing_since(
    track: Track, chain: list[Relation], attempted: list[Closure], decided: list[Closure], k: int
) -> list[Closure]:
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
    return decided[:new] + agreeing(track, chain, attempted[heard:])[new - heard :]


def _drifted(track: Track, chain: list[Relation]) -> Float:
    """(K, 3, 3) covariance that the steps to each keyframe add up to, along the axes of the map."""
    poses = track.poses[track.keyframes[1:]]
    steps = np.array([relation.covariance for relation in chain]).reshape(-1, 3, 3)
    out = np.zeros((len(track.keyframes), 3, 3))
    np.cumsum(se2.turned(steps, poses), axis=0, out=out[1:])
    return out


def _agree(track: Track, drifted: Float, a: Closure, b: Closure) -> bool:
    """Whether two closures put their later scans where the way between them allows."""
    a, b = (a, b) if a.later <= b.later else (b, a)
    P = track.poses
    here = P[a.earlier] @ a.T
    predicted = here @ se2.inverse(P[a.later]) @ P[b.later]
    d = se2.parameters(se2.inverse(predicted) @ P[b.earlier] @ b.T)
    back = se2.inverse(P[b.later])
    i, j = np.searchsorted(track.keyframes, [a.later, b.later])
    between = se2.turned(a.covariance, P[a.later]) + drifted[j] - drifted[i]
    covariance = b.covariance + se2.turned(between, back)
    return float(d @ np.linalg.solve(covariance, d)) < 9.0
