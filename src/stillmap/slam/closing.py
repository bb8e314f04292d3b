"""Loop closure: find candidates, verify them, solve the graph, spread what it says."""

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
    fit = [pose_graph.misfit(out, relation) <= track.options.misfit for relation in relations]
    return out, [closure for closure, fits in zip(accepted, fit, strict=True) if fits]


def _solved(
    track: Track, way: list[Relation], start: Float, found: list[Closure]
) -> tuple[Float, list[Closure]]:
    """Keyframes (K, 3, 3) after the graph, and the closures with those that it refused."""
    accepted = [_relation(track, c) for c in found if not c.refused]
    if not accepted:
        return start, found
    robust = pose_graph.optimised(start, way, accepted, track.options.robust)
    found = [
        refuse(c, "other loops disagree")
        if not c.refused and pose_graph.misfit(robust, _relation(track, c)) > track.options.misfit
        else c
        for c in found
    ]
    accepted = [_relation(track, c) for c in found if not c.refused]
    return pose_graph.optimised(robust, way, accepted, None), found
