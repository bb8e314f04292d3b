"""Which tracks are of one thing: parts of a car are often followed each on its own."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from stillmap.models.grouping import MOSTLY, Scan, grouped, pairs_of
from stillmap.models.options import MoverOptions
from stillmap.models.own import SPACING, Moves, fast, large, own_moves, pieces_of_cells
from stillmap.models.sources import Sources
from stillmap.objects import MovingObject
from stillmap.texture.things import Thing

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

_LOOKS = 9  # times at which velocities are compared
_MUCH_MORE = 2.0  # times as many beams has that of which something is left over
_ALIKE = 0.5  # of the faster one's speed may velocities differ
_SLOW = 1.0  # m/s, or by that
_NEAR = 10.0  # m, up to where beams are as near each other; then up to twice that, and so on
_FLAT = 2.0  # times as far apart along the line of sight: sides of cars, at flat angles
_CELLS = 3.0  # of so many edges is the way between what hangs together


class Followed(NamedTuple):
    """An object and what met it.

    Attributes:
        object: as it was followed.
        thing: the same as a box on its way.
        own: numbers within `Moves` of the beams that ended on it, rising.
        fast: whether it is faster than people are.
        large: whether it is longer or wider than people are.
    """

    object: MovingObject
    thing: Thing
    own: Index
    fast: bool
    large: bool


def followed_of(sources: Sources, moves: Moves, options: MoverOptions) -> list[Followed]:
    """The objects that have a box, each with its beams."""
    things = {thing.box.thing: thing for thing in sources.things}
    out = []
    for one in sources.objects:
        if one.id in things:
            thing = things[one.id]
            own = own_moves(one, thing, moves, sources, options)
            out.append(Followed(one, thing, own, fast(thing, options), large(thing, options)))
    return out


def wholes_of(
    followed: Sequence[Followed], moves: Moves, sources: Sources, options: MoverOptions
) -> list[list[Followed]]:
    """The same, those together that are parts of one thing.

    Of two that are of one velocity, one of them faster than people, and mostly hang together in
    scans that saw both, counted by beams; `grouped` says of more than two. What is of another
    velocity, and in most scans hangs together with more beams of something fast, is no thing, but
    what was left over of those that passed: it is left out.
    """
    n = len(followed)
    quick = np.array([one.fast for one in followed], np.bool_)
    if moves.planar or not quick.any():
        return [[one] for one in followed]
    scans = list(_scans(followed, moves, sources, options))
    pairs = pairs_of(scans, n)
    alike = quick[pairs.ends].any(axis=1) & (pairs.met > 0)
    some = np.flatnonzero(alike)
    alike[some] = [_alike(followed[a], followed[b]) for a, b in pairs.ends[some].tolist()]
    whole = grouped(pairs, alike & (pairs.met >= MOSTLY * pairs.both), n)
    groups: dict[int, list[Followed]] = {}
    for k in np.flatnonzero(~_left_over(scans, whole, quick, pairs.ends[alike])).tolist():
        groups.setdefault(int(whole[k]), []).append(followed[k])
    return list(groups.values())


def _scans(
    followed: Sequence[Followed], moves: Moves, sources: Sources, options: MoverOptions
) -> Iterator[Scan]:
    """The scans that saw something fast."""
    n, seen = len(followed), sources.seen
    quick = np.array([one.fast for one in followed], np.bool_)
    number = np.full(max(one.object.id for one in followed) + 2, n, np.intp)  # last: nobody
    number[[one.object.id for one in followed]] = np.arange(n)
    for scan, place in enumerate(seen.T_map_sensor(sources.poses)[:, :3, 3]):
        some = moves.between(int(seen.offset[scan]), int(seen.offset[scan + 1]))
        whose = number[moves.owner[some]]
        if not quick[whose[whose < n]].any():
            continue
        piece = hanging_together(moves.ends[some], place, options.link)
        count = np.zeros((n + 1, int(piece.max()) + 1), np.intp)
        np.add.at(count, (whose, piece), 1)
        there = np.flatnonzero(count[:n].any(axis=1))
        yield Scan(there, count[there].argmax(axis=1), count[there].max(axis=1))


def _left_over(scans: Sequence[Scan], whole: Index, quick: Bool, alike: Index) -> Bool:
    """(n,) which ones in most scans hang together with more beams of another whole that is fast.

    Args:
        scans: that saw something fast.
        whole: (n,) of each.
        quick: (n,) which are fast.
        alike: (m, 2) pairs of one velocity: those go on beside each other, as cars in a row.
    """
    n = len(whole)
    both_ways = np.concatenate([alike, alike[:, ::-1]])
    beside = np.unique(both_ways[:, 0] * n + both_ways[:, 1])
    less, times = np.zeros(n, np.intp), np.zeros(n, np.intp)
    for there, piece, beams in scans:
        mine = np.bincount(whole[there], beams)[whole[there]]
        more = (piece[:, None] == piece) & quick[there] & (mine > _MUCH_MORE * mine[:, None])
        more &= whole[there][:, None] != whole[there]
        more &= ~np.isin(there[:, None] * n + there, beside)
        less[there] += more.any(axis=1)
        times[there] += 1
    return (less >= MOSTLY * times) & (times > 0)


def hanging_together(points: Float, place: Float, link: float) -> Index:
    """(n,) which points (n, 3) hang together: no farther apart than beams are, and `link` metres.

    Args:
        points: metres.
        place: (3,) where the sensor was.
        link: metres.
    """
    n, away = len(points), np.linalg.norm(points - place, axis=1)
    rows, columns, first = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)], n
    near, far = 0.0, _NEAR
    while near <= away.max(initial=0.0):
        reach = link + SPACING * far
        some = np.flatnonzero((away >= near - reach) & (away <= far + reach))
        if len(some):
            squeezed = place + (points[some] - place) * _squeeze(away[some], near, far)[:, None]
            piece = pieces_of_cells(squeezed, reach / _CELLS, reach)
            rows.append(some)
            columns.append(first + piece)
            first += int(piece.max()) + 1
        near, far = far, 2.0 * far
    row, column = np.concatenate(rows), np.concatenate(columns)
    graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), (first, first))
    return np.asarray(connected_components(graph, directed=False)[1][:n], np.intp)


def _squeeze(away: Float, near: float, far: float) -> Float:
    """(n,) by how much points have to come nearer to lie `_FLAT` times as close in range.

    Across the line of sight they stay as far apart as they are, halfway between two ranges.
    """
    halfway = 0.5 * (near + far)
    return (halfway + (away - halfway) / _FLAT) / np.maximum(away, 1e-9)


def _alike(one: Followed, other: Followed) -> bool:
    """Whether they are of one velocity when both are seen."""
    a, b = one.thing.box, other.thing.box
    first, last = max(a.seconds[0], b.seconds[0]), min(a.seconds[-1], b.seconds[-1])
    if first > last:
        first = last = 0.5 * (first + last)
    at = np.linspace(first, last, _LOOKS)
    u, v = (
        np.stack([np.interp(at, box.seconds, column) for column in box.velocity.T], axis=1)
        for box in (a, b)
    )
    apart = np.linalg.norm(u - v, axis=1)
    speed = np.maximum(np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1))
    return bool(np.median(apart - np.maximum(_ALIKE * speed, _SLOW)) <= 0.0)
