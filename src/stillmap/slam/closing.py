"""Loop closure: find candidates, verify them, solve the graph, spread what it says."""

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.model import Recording
from stillmap.slam import chain, keyframes, loops, pose_graph
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
    found = chain.agreeing(track, way, loops.attempts(track))
    moved, found = _solved(track, way, found)
    return keyframes.spread(mapped.poses, track.keyframes, moved), found


def _solved(track: Track, way: list[Relation], found: list[Closure]) -> tuple[Float, list[Closure]]:
    """Keyframes (K, 3, 3) after the graph, and the closures with those that it refused."""
    start = track.poses[track.keyframes]

    def relation(closure: Closure) -> Relation:
        first, second = np.searchsorted(track.keyframes, [closure.earlier, closure.later])
        return Relation(int(first), int(second), closure.T, closure.covariance)

    accepted = [relation(c) for c in found if not c.refused]
    if not accepted:
        return start, found
    robust = pose_graph.optimised(start, way, accepted, track.options.robust)
    found = [
        refuse(c, "other loops disagree")
        if not c.refused and pose_graph.misfit(robust, relation(c)) > track.options.misfit
        else c
        for c in found
    ]
    accepted = [relation(c) for c in found if not c.refused]
    return pose_graph.optimised(robust, way, accepted, None), found
