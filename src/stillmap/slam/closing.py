"""Loop closure: find candidates, verify them, solve the graph, spread what it says."""

import itertools

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.recording.model import Recording
from stillmap.slam import candidates, chain, keyframes, loops, pose_graph
from stillmap.slam.incremental import Mapped, SlamOptions
from stillmap.slam.loops import Closure, Track, refuse
from stillmap.slam.pose_graph import Relation

Float = NDArray[np.float64]


def closed(
    recording: Recording, e: NDArray[np.float32], options: SlamOptions, mapped: Mapped
) -> tuple[Float, list[Closure]]:
    """Poses (T, 3, 3) after loop closure, and all attempts at closing a loop.

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        mapped: the incremental result; its grid is not looked at.
    """
    track = Track(
        recording,
        e,
        mapped.poses,
        keyframes.travel(mapped.poses),
        mapped.explained,
        keyframes.chosen(mapped.poses, options.loops.distance, options.loops.turn),
        options.resolution,
        options.registration,
        options.surface,
        options.loops,
    )
    way = chain.relations(track, options.motion)
    moved, found = track.poses[track.keyframes], list[Closure]()
    attempted, ties = list[Closure](), list[Closure]()
    for first, last in candidates.stages(track):
        new = loops.attempts(track, candidates.of_stage(track, moved, first, last, ties))
        attempted += new
        if all(closure.refused for closure in new):
            found += new
            continue
        found = chain.agreeing_since(track, way, attempted, found, first)
        moved, ties = _corrected(track, way, moved, last, found)
    moved, found = _solved(track, way, moved, found)
    return keyframes.spread(mapped.poses, track.keyframes, moved), found


def _relation(track: Track, closure: Closure) -> Relation:
    first, second = np.searchsorted(track.keyframes, [closure.earlier, closure.later])
    return Relation(int(first), int(second), closure.T, closure.covariance)


def _corrected(
    track: Track, way: list[Relation], poses: Float, last: int, found: list[Closure]
) -> tuple[Float, list[Closure]]:
    """Keyframes (K, 3, 3), those before `last` by the graph so far; and the loops that fit it.

    Later ones are carried along.
    """
    accepted = [closure for closure in found if not closure.refused]
    if not accepted:
        return poses, []
    relations = [_relation(track, closure) for closure in accepted]
    out = poses.copy()
    out[:last] = pose_graph.optimised(
        poses[:last], way[: last - 1], relations, track.options.robust
    )
    out[last:] = out[last - 1] @ se2.inverse(poses[last - 1]) @ poses[last:]
    fit = pose_graph.misfits(out, relations) <= track.options.misfit
    return out, list(itertools.compress(accepted, fit))


def _solved(
    track: Track, way: list[Relation], start: Float, found: list[Closure]
) -> tuple[Float, list[Closure]]:
    """Keyframes (K, 3, 3) after the graph, and the closures with those that it refused."""
    accepted = [_relation(track, c) for c in found if not c.refused]
    if not accepted:
        return start, found
    robust = pose_graph.optimised(start, way, accepted, track.options.robust)
    misfits = pose_graph.misfits(robust, [_relation(track, closure) for closure in found])
    found = [
        refuse(closure, "other loops disagree")
        if not closure.refused and misfit > track.options.misfit
        else closure
        for closure, misfit in zip(found, misfits, strict=True)
    ]
    accepted = [_relation(track, c) for c in found if not c.refused]
    return pose_graph.optimised(robust, way, accepted, None), found
