"""Loop closure: find, verify, solve, spread, and register once more against all the others."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, em, se2
from stillmap.recording.model import Recording
from stillmap.slam import keyframes, loops, pose_graph
from stillmap.slam.incremental import Mapped, SlamOptions
from stillmap.slam.loops import Closure, LoopOptions
from stillmap.slam.pose_graph import Relation
from stillmap.slam.sweep import sweep

Float = NDArray[np.float64]


def closed(
    recording: Recording, e: NDArray[np.float32], options: SlamOptions, mapped: Mapped, threads: int
) -> Mapped:
    """The incremental result with its loops closed."""
    poses, found = mapped.poses, list[Closure]()
    frames = keyframes.chosen(poses, options.loops.distance, options.loops.turn)
    if len(frames) < 3:
        return mapped
    chain = _chain(poses, frames, options.loops)
    for _ in range(options.loops.rounds):
        search = loops.Search(
            recording,
            e,
            poses,
            keyframes.travel(poses),
            frames,
            mapped.explained,
            options.resolution,
            options.registration,
            options.loops,
        )
        moved, found = _solved(poses[frames], frames, chain, loops.attempts(search), options.loops)
        poses = keyframes.spread(poses, frames, moved)
    grid = _core.Grid2D(options.resolution, options.registration.approach)
    em.add_recording(grid, recording, poses, e, threads)
    covariance, explained = mapped.covariance, mapped.explained
    for _ in range(options.loops.sweeps):
        poses, covariance, explained = sweep(recording, e, options, grid, poses)
    return Mapped(poses, covariance, grid, explained, mapped.widened, found)


def _chain(poses: Float, frames: NDArray[np.intp], options: LoopOptions) -> list[Relation]:
    """Relations between successive keyframes, as loose as the drift of the incremental poses."""
    at = keyframes.travel(poses)
    chain = []
    for k in range(len(frames) - 1):
        i, j = frames[k], frames[k + 1]
        T = se2.inverse(poses[i]) @ poses[j]
        turn = abs(float(se2.parameters(T)[2]))
        root = np.sqrt(at[j] - at[i] + turn + 0.05)
        xy, theta = options.step_translation * root, options.step_rotation * root
        chain.append(Relation(k, k + 1, T, np.diag([xy**2, (0.5 * xy) ** 2, theta**2])))
    return chain


def _solved(
    poses: Float,
    frames: NDArray[np.intp],
    chain: list[Relation],
    found: list[Closure],
    options: LoopOptions,
) -> tuple[Float, list[Closure]]:
    """Keyframes (K, 3, 3) after the graph, and the closures with those that it refused."""
    index = {int(t): k for k, t in enumerate(frames)}

    def relation(closure: Closure) -> Relation:
        return Relation(
            index[closure.earlier], index[closure.later], closure.T, closure.covariance
        )

    accepted = [relation(c) for c in found if not c.refused]
    if not accepted:
        return poses, found
    robust = pose_graph.optimised(poses, chain, accepted, options.robust)
    out = []
    for closure in found:
        if not closure.refused and pose_graph.misfit(robust, relation(closure)) > options.misfit:
            closure = dataclasses.replace(closure, refused="the other loops disagree")
        out.append(closure)
    accepted = [relation(c) for c in out if not c.refused]
    return pose_graph.optimised(robust, chain, accepted, None), out
