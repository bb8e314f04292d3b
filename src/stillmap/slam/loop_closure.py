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
from stillmap.slam.loop_types import Closure, Track, refuse
from stillmap.slam.odometry_2d import Mapped, SlamOptions
from stillmap.slam.pose_graph import Graph, Relation, Robust

Float = NDArray[np.float64]


def closed(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    mapped: Mapped,
    progress: Callable[[int, int], None],
) -> Mapped:
    """Poses after loop closure, all attempts at closing a loop, and the graph.

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        mapped: the incremental result; its grid is not looked at.
        progress: called with the number of scans done and their total.
    """
    track, ties, apart = _track(recording, e, options, mapped)
    way = loop_candidates_module.relations(track, options.motion, mapped.breaks)
    moved, found = track.poses[track.keyframes], ties
    attempted, fitting = list[Closure](), ties
    looks = loop_candidates.looks(track)
    for first, last in loop_candidates.stages(track):
        progress(int(track.keyframes[first]), recording.n_scans)
        asked = loop_candidates.of_stage(track, moved, looks, first, last, fitting)
        new = loop_verification.attempts(track, asked)
        attempted += new
        if all(closure.refused for closure in new):
            found = found + new
            continue
        found = ties + loop_candidates_module.agreeing_since(
            track, way, attempted, found[len(ties) :], first
        )
        moved, fitting = _corrected(track, way, moved, last, found)
    moved, found = _solved(track, way, moved, found)
    accepted = [_relation(track, closure) for closure in found if not closure.refused]
    return dataclasses.replace(
        mapped,
        poses=local_map.spread(track.poses, track.keyframes, moved),
        loops=found,
        graph=Graph(track.keyframes, moved, [*way, *accepted]),
        apart=apart,
    )


def _track(
    recording: Recording, e: NDArray[np.float32], options: SlamOptions, mapped: Mapped
) -> tuple[Track, list[Closure], list[int]]:
    """What loops are looked for in, with all pieces in their places; see `pieces.placed`."""
    poses, breaks = mapped.poses, mapped.breaks
    travelled = local_map.travel(poses)
    distance = options.loops.gap + 2.0 * options.loops.stretch
    track = Track(
        recording,
        e,
        poses,
        relocalization.separated(travelled, breaks, distance),
        mapped.explained,
        local_map.chosen(poses, options.loops.distance, options.loops.turn, breaks),
        options.resolution,
        options.registration,
        options.surface,
        options.loops,
    )
    return relocalization.placed(track, breaks, mapped.apart)


def _relation(track: Track, closure: Closure) -> Relation:
    first, second = np.searchsorted(track.keyframes, [closure.earlier, closure.later])
    return Relation(int(first), int(second), closure.T, closure.covariance)


def _robust(track: Track) -> Robust:
    return Robust(track.options.misfit, track.options.annealing)


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
    inside = [relation for relation in relations if relation.second < last]
    out[:last] = pose_graph.optimised(poses[:last], way[: last - 1], inside, _robust(track))
    carried = out[last - 1] @ se2.inverse(poses[last - 1]) @ poses[last:]
    out[last:] = se2.normalised(carried)  # what they are off would double with every stage
    fit = pose_graph.misfits(out, relations) <= track.options.misfit
    return out, list(itertools.compress(accepted, fit))


def _solved(
    track: Track, way: list[Relation], start: Float, found: list[Closure]
) -> tuple[Float, list[Closure]]:
    """Keyframes (K, 3, 3) after the graph, and the closures with those that it refused."""
    accepted = [_relation(track, c) for c in found if not c.refused]
    if not accepted:
        return start, found
    robust = pose_graph.optimised(start, way, accepted, _robust(track))
    misfits = pose_graph.misfits(robust, [_relation(track, closure) for closure in found])
    found = [
        refuse(closure, "other loops disagree")
        if not closure.refused and misfit > track.options.misfit
        else closure
        for closure, misfit in zip(found, misfits, strict=True)
    ]
    accepted = [_relation(track, c) for c in found if not c.refused]
    return pose_graph.optimised(robust, way, accepted, None), found
