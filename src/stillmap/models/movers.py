"""Models of what moved (Sect. 4.5): what ended on a thing, in its own frame, as a surface."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.models.frames import Way
from stillmap.models.moments import Look, best_moment, between_beams
from stillmap.models.options import MoverOptions
from stillmap.models.own import SPACING, Moves, about_as, grown, look_of, scans_about, seconds_of
from stillmap.models.sources import Sources
from stillmap.models.wholes import Followed
from stillmap.surface.extraction import without_islands
from stillmap.surface.mesh import Mesh

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_DEEPEST = 3.0  # m, the side of a car from its middle to its end
_AROUND = 0.03  # s, in which a scan sees the rest of a car
_MOSTLY = 0.1  # of what hangs together is of a track: else another one follows it


@dataclass(frozen=True, eq=False)
class Shape:
    """The surface of a thing that moved.

    Attributes:
        id: of the object.
        mesh: in the thing's own frame: x ahead, y left, z up, on the ground below its middle.
        way: where that frame was.
        rigid: whether it kept its shape.
        seconds: when it was of this shape: of one that is not rigid the middle of the sweep, of a
            rigid one when most of it was seen; by the time of its box.
        span: s, from the first beam of that sweep to the last; what is rigid: of all of them.
    """

    id: int
    mesh: Mesh
    way: Way
    rigid: bool
    seconds: float
    span: tuple[float, float]


def shape_of(
    followed: Sequence[Followed],
    sources: Sources,
    moves: Moves,
    options: MoverOptions,
    pictures: Float,
) -> Shape | None:
    """The surface of something that moved; None where too little of it was seen.

    Args:
        followed: the objects as which it was followed.
        sources: the beams.
        moves: those on what moves.
        options: see MoverOptions.
        pictures: (N,) s, when pictures show it, by the time of its box.
    """
    own = np.unique(np.concatenate([one.own for one in followed]))
    if not len(own):
        return None
    scans, seconds = sources.seen.scans_of(moves.beam[own]), moves.seconds[own]
    fast = any(one.fast for one in followed)
    # who is seen by few beams is looked at longer
    for moment in (options.sweep, 2.0 * options.sweep) if moves.planar else (0.0,):
        span = best_moment(seconds, scans, moment, options.near, pictures)
        one = _most_seen(followed, moves, span)
        way = Way.of_track(one.thing)
        look = look_at(own, span, way, fast, sources, moves, options)
        if look is None:
            continue
        mesh = surface_of_look(look, fast or any(one.large for one in followed), options)
        if mesh.areas().sum() >= options.least:
            return Shape(one.object.id, mesh, way, False, 0.5 * sum(look.span), look.span)
    return None


class Glimpse(NamedTuple):
    """What one look saw of a thing.

    Attributes:
        own: beams that ended on it, in its own frame.
        others: those about then that did not.
        span: s, from the first to the last.
    """

    own: Look
    others: Look
    span: tuple[float, float]


def look_at(
    own: Index,
    span: tuple[float, float],
    way: Way,
    fast: bool,
    sources: Sources,
    moves: Moves,
    options: MoverOptions,
) -> Glimpse | None:
    """What was seen of a thing at a time; None where that is of another one for the most part."""
    around = _AROUND if fast else 0.0
    first, last = span[0] - around, span[1] + around
    scans = scans_about(first, last, sources)
    offset = sources.seen.offset
    beams = np.arange(offset[scans.start], offset[scans.stop])
    seconds = seconds_of(beams, sources)
    then = (seconds >= first) & (seconds <= last)
    beams, seconds = beams[then], seconds[then]
    mine = _between(own, moves.seconds, first, last)
    if fast:
        about = moves.between(int(beams[0]), int(beams[-1]) + 1)
        every = _between(np.arange(about.start, about.stop), moves.seconds, first, last)
        place = look_of(beams[:1], seconds[:1], way, sources).origin[0]
        whole = grown(mine, every, way, place, moves, options)
        if len(mine) < _MOSTLY * len(whole):
            return None
        mine = whole
        span = float(moves.seconds[mine].min()), float(moves.seconds[mine].max())
    seen = look_of(moves.beam[mine], moves.seconds[mine], way, sources)
    beside = ~np.isin(beams, moves.beam[mine], assume_unique=True)
    beams, seconds = beams[beside], seconds[beside]
    near = about_as(moves.beam[mine], beams, sources)
    return Glimpse(seen, look_of(beams[near], seconds[near], way, sources), span)


def surface_of_look(look: Glimpse, rigid: bool, options: MoverOptions) -> Mesh:
    """Triangles between its beams."""
    stretch, longest, deepest = options.stretch, options.longest, 0.0
    if rigid:  # its sides are seen at flat angles
        away = np.linalg.norm(look.own.points - look.own.origin, axis=1)
        stretch, longest = np.inf, max(longest, SPACING * float(np.median(away)))
        deepest = _DEEPEST
    mesh = between_beams(look.own, look.others, stretch, longest, deepest)
    return without_islands(mesh, options.island)


def _most_seen(followed: Sequence[Followed], moves: Moves, span: tuple[float, float]) -> Followed:
    """Of some objects the one that most beams met at a time."""
    count = [len(_between(one.own, moves.seconds, *span)) for one in followed]
    return followed[int(np.argmax(count))]


def _between(some: Index, seconds: Float, first: float, last: float) -> Index:
    return some[(seconds[some] >= first) & (seconds[some] <= last)]
