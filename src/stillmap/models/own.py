"""Which beams met a thing that moves, and these in its own frame."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from stillmap.models.frames import Way
from stillmap.models.moments import Look
from stillmap.models.options import MoverOptions
from stillmap.models.sources import Sources
from stillmap.objects import MovingObject
from stillmap.recording.model import Recording
from stillmap.recording.stamps import beam_ns
from stillmap.texture.things import Thing

Float = NDArray[np.float64]

_DYNAMIC = 0.5
_FAR = 1000.0  # m
_CAR = 6.0  # m, from one end of it to the other
_CELL = 0.2  # m, in which one point is enough
SPACING = 0.025  # rad between beams, at most


class First(NamedTuple):
    """Where a part of a recording begins in it, and when its beams were taken.

    Attributes:
        scan, beam: numbers of its first ones.
        seconds: (n,) of its beams, by the time of boxes.
    """

    scan: int
    beam: int
    seconds: Float


def own_beams(
    one: MovingObject, thing: Thing, sources: Sources, options: MoverOptions
) -> tuple[Recording, First]:
    """The scans that saw a thing, in which only what ended on it is a hit.

    That is what is rather dynamic than static, in the box around it, and of no other thing.
    """
    seen, box = sources.seen, thing.box
    stamps = 1e-9 * (seen.stamp_ns - sources.start_ns)
    a = int(np.searchsorted(stamps, box.seconds[0] - box.hold))
    b = max(int(np.searchsorted(stamps, box.seconds[-1] + box.hold, side="right")), a)
    scans, beams = slice(a, b), slice(int(seen.offset[a]), int(seen.offset[b]))
    seconds = np.asarray(1e-9 * (beam_ns(sources.recording, scans) - sources.start_ns), np.float64)
    own = np.zeros(beams.stop - beams.start, np.bool_)
    moves = np.flatnonzero(seen.hit[beams] & (sources.p_static[beams] < _DYNAMIC))
    ends = seen.end_points(beams.start + moves, sources.poses)
    at = Way.of_track(thing).local(seconds[moves], ends)
    half = np.array(box.half) + options.margin
    inside = (np.abs(at[:, :2]) <= half).all(axis=1)
    inside &= (at[:, 2] > options.low) & (at[:, 2] <= thing.tall + options.margin)
    own[moves[inside]] = True
    for other in sources.objects:
        if other.id != one.id:
            theirs = other.beams[np.searchsorted(other.beams, beams.start) :]
            theirs = theirs[: np.searchsorted(theirs, beams.stop)]
            own[theirs - beams.start] = False
    mine = one.beams[(one.beams >= beams.start) & (one.beams < beams.stop)]
    at = Way.of_track(thing).local(
        seconds[mine - beams.start], seen.end_points(mine, sources.poses)
    )
    # a track of somebody may take hold of who stands beside
    near = (np.abs(at[:, :2]) <= half + options.margin).all(axis=1)
    own[mine - beams.start] = near | (options.together and 2.0 * thing.box.half[0] >= options.rigid)
    part = dataclasses.replace(
        seen,
        stamp_ns=seen.stamp_ns[scans],
        offset=seen.offset[a : b + 1] - seen.offset[a],
        points=np.asarray(seen.points[beams]),
        hit=own,
        sensor=seen.sensor[scans],
        T_odom_base=None,
        T_recorded_base=None,
        beam_time=None,
        images=None,
    )
    return part, First(a, beams.start, seconds)


def grown(
    beams: NDArray[np.intp],
    mine: NDArray[np.bool_],
    way: Way,
    first: First,
    sources: Sources,
    options: MoverOptions,
) -> NDArray[np.bool_]:
    """(n,) which beams met a thing that is faster than people: all that move, and hang together.

    Parts of a car are often followed each on its own.
    """
    number = first.beam + beams
    moves = np.flatnonzero(sources.seen.hit[number] & (sources.p_static[number] < _DYNAMIC))
    at = way.local(
        first.seconds[beams[moves]], sources.seen.end_points(number[moves], sources.poses)
    )
    some = (at[:, 2] > options.low) & (np.linalg.norm(at[:, :2], axis=1) <= _CAR)
    moves, at = moves[some], at[some]
    if not len(moves):
        return mine
    place = look_of(beams[:1], way, first, sources).origin[0]
    away = float(np.median(np.linalg.norm(at - place, axis=1)))
    link = options.link + SPACING * away
    cells, of = np.unique(np.floor(at / _CELL), axis=0, return_inverse=True)
    one, other = cKDTree(cells).query_pairs(link / _CELL, output_type="ndarray").T
    n = len(cells)
    graph = coo_matrix((np.ones(len(one), np.int8), (one, other)), (n, n))
    piece = connected_components(graph, directed=False)[1][of.ravel()]
    out = mine.copy()
    out[moves[np.isin(piece, piece[mine[moves]])]] = True
    return out


def look_of(beams: NDArray[np.intp], way: Way, first: First, sources: Sources) -> Look:
    """Beams in a thing's own frame; those that came back from nowhere go on for a kilometre."""
    seen, number = sources.seen, first.beam + beams
    ends = seen.end_points(number, sources.poses)
    scan = seen.scans_of(number)
    T = sources.poses[scan] @ seen.T_base_sensor[seen.sensor[scan]]
    origin = T[:, :3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        far = origin + (ends - origin) * (
            _FAR / np.linalg.norm(ends - origin, axis=1, keepdims=True)
        )
    ends = np.where(seen.hit[number][:, None], ends, far)
    return Look.of(ends, origin, first.seconds[beams], way)
