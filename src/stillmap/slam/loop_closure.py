"""Loop closure: find candidates, verify them, solve the graph, spread what it says."""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.slam import (
    local_map,
    loop_candidates,
    loop_verification,
    pose_graph,
    relocalization,
)
from stillmap.slam import (
    loop_candidates as loop_candidates_module,
)
from stillmap.slam.loop_types import LoopClosure, LoopContext, refuse
from stillmap.slam.odometry_2d import MStepResult, SlamOptions
from stillmap.slam.pose_graph import Constraint, PoseGraph, Robust

Float = NDArray[np.float64]


def close_loops(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    mapped: MStepResult,
    progress: Callable[[int, int], None],
) -> MStepResult:
    """Poses after loop closure, all attempts at closing a loop, and the graph.

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        mapped: the incremental result; its grid is not looked at.
        progress: called with the number of scans done and their total.
    """
    track, ties, apart = _track(recording, e, options, mapped)
    way = loop_candidates_module.odometry_constraints(track, options.motion, mapped.breaks)
    moved, found = track.poses[track.keyframes], ties
    attempted, fitting = list[LoopClosure](), ties
    looks = loop_candidates.view_centers(track)
    for first, last in loop_candidates.split_stages(track):
        progress(int(track.keyframes[first]), recording.n_scans)
        asked = loop_candidates.propose_candidates(track, moved, looks, first, last, fitting)
        new = loop_verification.verify_candidates(track, asked)
        attempted += new
        if all(closure.refused for closure in new):
            found = found + new
            continue
        found = ties + loop_candidates_module.reject_inconsistent_since(
            track, way, attempted, found[len(ties) :], first
        )
        moved, fitting = _corrected(track, way, moved, last, found)
    moved, found = _solved(track, way, moved, found)
    accepted = [_relation(track, closure) for closure in found if not closure.refused]
    return dataclasses.replace(
        mapped,
        poses=local_map.propagate_corrections(track.poses, track.keyframes, moved),
        loops=found,
        graph=PoseGraph(track.keyframes, moved, [*way, *accepted]),
        apart=apart,
    )


def _track(
    recording: Recording, e: NDArray[np.float32], options: SlamOptions, mapped: MStepResult
) -> tuple[LoopContext, list[LoopClosure], list[int]]:
    """What loops are looked for in, with all pieces in their places; see `pieces.placed`."""
    poses, breaks = mapped.poses, mapped.breaks
    travelled = local_map.travelled_distance(poses)
    distance = options.loops.gap + 2.0 * options.loops.stretch
    track = LoopContext(
        recording,
        e,
        poses,
        relocalization.separate_segments(travelled, breaks, distance),
        mapped.explained,
        local_map.select_keyframes(poses, options.loops.distance, options.loops.turn, breaks),
        options.resolution,
        options.registration,
        options.surface,
        options.loops,
    )
    return relocalization.relocalize_segments(track, breaks, mapped.unconnected)


def _relation(track: LoopContext, closure: LoopClosure) -> Constraint:
    first, second = np.searchsorted(track.keyframes, [closure.earlier, closure.later])
    return Constraint(int(first), int(second), closure.T, closure.covariance)


def _robust(track: LoopContext) -> Robust:
    return Robust(track.options.misfit, track.options.annealing)


def _corrected(
    track: LoopContext, way: list[Constraint], poses: Float, last: int, found: list[LoopClosure]
) -> tuple[Float, list[LoopClosure]]:
    """Keyframes (K, 3, 3), those before `last` by the graph so far; and the loops that fit it.

    Later ones are carried along.
    """
    accepted = [closure for closure in found if not closure.refused]
    if not accepted:
        return poses, []
    relations = [_relation(track, closure) for closure in accepted]
    out = poses.copy()
    inside = [relation for relation in relations if relation.second < last]
    out[:last] = pose_graph.optimize_poses(poses[:last], way[: last - 1], inside, _robust(track))
    carried = out[last - 1] @ se2.inverse(poses[last - 1]) @ poses[last:]
    out[last:] = se2.normalize(carried)  # what they are off would double with every stage
    fit = pose_graph.squared_mahalanobis(out, relations) <= track.options.misfit
    return out, list(itertools.compress(accepted, fit))


def _solved(
    track: LoopContext, way: list[Constraint], start: Float, found: list[LoopClosure]
) -> tuple[Float, list[LoopClosure]]:
    """Keyframes (K, 3, 3) after the graph, and the closures with those that it refused."""
    accepted = [_relation(track, c) for c in found if not c.refused]
    if not accepted:
        return start, found
    robust = pose_graph.optimize_poses(start, way, accepted, _robust(track))
    misfits = pose_graph.squared_mahalanobis(
        robust, [_relation(track, closure) for closure in found]
    )
    found = [
        refuse(closure, "other loops disagree")
        if not closure.refused and misfit > track.options.misfit
        else closure
        for closure, misfit in zip(found, misfits, strict=True)
    ]
    accepted = [_relation(track, c) for c in found if not c.refused]
    return pose_graph.optimize_poses(robust, way, accepted, None), found
