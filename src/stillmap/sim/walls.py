"""Drawing worlds: common pieces of buildings as wall segments x0, y0, x1, y1."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Literal

from stillmap.sim.scene import Point, Segment

Side = Literal["north", "south", "east", "west"]

# unit vectors along a wall and out of the hall through it
_AXES: dict[Side, tuple[Point, Point]] = {
    "south": ((1.0, 0.0), (0.0, -1.0)),
    "north": ((1.0, 0.0), (0.0, 1.0)),
    "west": ((0.0, 1.0), (-1.0, 0.0)),
    "east": ((0.0, 1.0), (1.0, 0.0)),
}


def polyline(points: Sequence[Point], closed: bool = False) -> list[Segment]:
    """Segments from point to point; `closed` joins the last one to the first."""
    ends = [*points[1:], points[0]] if closed else points[1:]
    return [(*a, *b) for a, b in zip(points, ends, strict=closed)]


def box(x: float, y: float, width: float, height: float, angle: float = 0.0) -> list[Segment]:
    """The four sides of a box centred at x, y and turned by `angle` radians."""
    c, s = math.cos(angle), math.sin(angle)
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    halves = [(i * width / 2, j * height / 2) for i, j in corners]
    return polyline([(x + c * u - s * v, y + s * u + c * v) for u, v in halves], closed=True)


def pillar(x: float, y: float, radius: float, sides: int = 8) -> list[Segment]:
    """A column as a regular polygon with corners at `radius`."""
    turns = [2 * math.pi * (k + 0.5) / sides for k in range(sides)]
    corners = [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in turns]
    return polyline(corners, closed=True)


def locate(start: Point, side: Side, along: float, out: float = 0.0) -> Point:
    """The point `along` metres along a wall that begins at `start`, and `out` metres behind it."""
    (ux, uy), (ox, oy) = _AXES[side]
    return (start[0] + along * ux + out * ox, start[1] + along * uy + out * oy)


def wall(
    start: Point, length: float, side: Side, openings: Iterable[Sequence[float]] = ()
) -> list[Segment]:
    """A straight wall along +x or +y whose openings step back to `side`.

    Args:
        start: of the wall.
        length: of the wall.
        side: where its back is.
        openings: (begin, width, depth) of each along the wall, ascending, in metres, and a fourth
            value, true, of those without a wall behind.
    """
    segments: list[Segment] = []
    line = [locate(start, side, 0.0)]
    for begin, width, depth, *is_open in openings:
        end = begin + width
        line += [locate(start, side, begin), locate(start, side, begin, depth)]
        if is_open:
            segments += polyline(line)
            line = []
        line += [locate(start, side, end, depth), locate(start, side, end)]
    segments += polyline([*line, locate(start, side, length)])
    return [s for s in segments if s[:2] != s[2:]]


# how the data files of worlds call them
PIECES: dict[str, Callable[..., list[Segment]]] = {
    "line": lambda *points: polyline(points),
    "box": box,
    "pillar": pillar,
    "wall": wall,
}
