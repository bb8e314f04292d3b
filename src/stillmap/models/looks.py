"""What one look saw of a thing that moves: a scan in space, or planar ones that follow."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.models.frames import Way
from stillmap.models.moments import Look, between_beams
from stillmap.models.options import MoverOptions
from stillmap.models.own import (
    SPACING,
    Moves,
    about_as,
    grown,
    look_of,
    scans_about,
    seconds_of,
)
from stillmap.models.sources import Sources
from stillmap.surface.extraction import without_islands
from stillmap.surface.mesh import Mesh

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_AROUND = 0.03  # s, in which a scan sees the rest of a car
_MOSTLY = 0.1  # of what hangs together is of a track: else another one follows it
DEEPEST = 3.0  # m, the side of a car from its middle to its end


class Glimpse(NamedTuple):
    """What one look saw of a thing.

    Attributes:
        own: beams that ended on it, in its own frame.
        others: those about then that went by it.
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
    """What was seen of a thing at a time; None where most of that is of another one.

    Args:
        own: numbers within `moves` of what ended on it at any time, rising.
        span: s, from when to when.
        way: where its own frame is.
        fast: whether all that hangs together with it is its own.
        sources, moves: the beams, and those on what moves.
        options: see MoverOptions.
    """
    around = _AROUND if fast else 0.0
    first, last = span[0] - around, span[1] + around
    scans, offset = scans_about(first, last, sources), sources.seen.offset
    beams = np.arange(offset[scans.start], offset[scans.stop])
    seconds = seconds_of(beams, sources)
    then = (seconds >= first) & (seconds <= last)
    beams, seconds = beams[then], seconds[then]
    mine = between(own, moves.seconds, first, last)
    if fast:
        about = moves.between(int(beams[0]), int(beams[-1]) + 1)
        every = between(np.arange(about.start, about.stop), moves.seconds, first, last)
        place = look_of(beams[:1], seconds[:1], way, sources).origin[0]
        whole = grown(mine, every, way, place, moves, options)
        if not len(whole) or len(mine) < _MOSTLY * len(whole):
            return None
        mine = whole
        span = float(moves.seconds[mine].min()), float(moves.seconds[mine].max())
    seen = look_of(moves.beam[mine], moves.seconds[mine], way, sources)
    beside = ~np.isin(beams, moves.beam[mine], assume_unique=True)
    beams, seconds = beams[beside], seconds[beside]
    near = about_as(moves.beam[mine], beams, sources)
    return Glimpse(seen, look_of(beams[near], seconds[near], way, sources), span)


def surface_of(look: Glimpse, rigid: bool, deepest: float, options: MoverOptions) -> Mesh:
    """Triangles between its beams.

    Args:
        look: the beams.
        rigid: whether it keeps its shape, as cars do: their sides are seen at flat angles.
        deepest: metres along the line of sight between beams on the side of such a thing.
        options: see MoverOptions.
    """
    stretch, longest = options.stretch, options.longest
    if rigid:
        away = np.linalg.norm(look.own.points - look.own.origin, axis=1)
        stretch, longest = np.inf, max(longest, SPACING * float(np.median(away)))
    mesh = between_beams(look.own, look.others, stretch, longest, deepest if rigid else 0.0)
    return without_islands(mesh, options.island)


def between(some: Index, seconds: Float, first: float, last: float) -> Index:
    """Those of numbers (n,) whose times lie between two."""
    return some[(seconds[some] >= first) & (seconds[some] <= last)]
