"""Which tracks are of one thing: parts of a car are often followed each on its own.

Things that are one, by how often they hang together in scans that see both.

A track that takes hold of one car and then of the next hangs together with both. So it is not
enough that a chain of tracks links two: those of one whole must hang together with those of the
other, all in all, to become one with it.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.objects.segmentation import (
    SPACING,
    DynamicReturns,
    cluster_cells,
    is_fast,
    is_large,
    segment_object,
)
from stillmap.mesh.options import MoverOptions
from stillmap.mesh.texture.occluders import TrackedBox
from stillmap.tracking import MovingObject

Float = NDArray[np.float64]

Bool = NDArray[np.bool_]

Index = NDArray[np.intp]

MAJORITY = 0.5  # of what is counted

_AT_ONCE = 1000  # scans, after which their pairs are counted


class ScanClusters(NamedTuple):
    """Which things a scan saw: (n,) numbers, the piece that most of each is of, and its beams."""

    objects: Index
    cluster: Index
    beams: Index


class PairCounts(NamedTuple):
    """Things that scans saw at once, as often as there are beams on the one that has fewer.

    Attributes:
        ends: (m, 2) their numbers, the lesser one first; rising.
        met: (m,) how often they hung together.
        both: (m,) how often both were seen.
    """

    pairs: Index
    connected: Index
    observed: Index


def count_pairs(scans: Sequence[ScanClusters], n: int) -> PairCounts:
    """All pairs of n things that some scan saw both of."""
    # of so many things most never meet: pairs that were seen, and no square of all
    key, met, both = (np.zeros(0, np.intp) for _ in range(3))
    for first in range(0, len(scans), _AT_ONCE):
        keys, together, seen = [key], [met], [both]
        for there, piece, beams in scans[first : first + _AT_ONCE]:
            a, b = np.triu_indices(len(there), 1)
            fewer = np.minimum(beams[a], beams[b])
            keys.append(there[a] * n + there[b])
            together.append(np.where(piece[a] == piece[b], fewer, 0))
            seen.append(fewer)
        key, number = np.unique(np.concatenate(keys), return_inverse=True)
        met, both = np.zeros(len(key), np.intp), np.zeros(len(key), np.intp)
        np.add.at(met, number, np.concatenate(together))
        np.add.at(both, number, np.concatenate(seen))
    return PairCounts(np.stack([key // n, key % n], axis=1), met, both)


def group_tracks(pairs: PairCounts, may: Bool, n: int) -> Index:
    """(n,) which whole each of n things is of.

    Pairs are asked in the order in which they hang together most, each once. Two wholes become one
    where a pair of them may, and all their pairs together mostly hang together by then.

    Args:
        pairs: all that were seen.
        may: (m,) which of these can be of one whole.
        n: how many there are.
    """
    whole = np.arange(n)
    members = [[k] for k in range(n)]
    # of each whole, with which others it was seen, and how often they hung together
    links: list[dict[int, tuple[int, int]]] = [{} for _ in range(n)]
    for (a, b), met, both in zip(
        pairs.pairs.tolist(), pairs.connected.tolist(), pairs.observed.tolist(), strict=True
    ):
        links[a][b] = links[b][a] = met, both
    candidates = np.flatnonzero(may & (pairs.connected > 0))
    for k in candidates[np.argsort(-pairs.connected[candidates], kind="stable")].tolist():
        a, b = sorted(whole[pairs.pairs[k]].tolist())
        if a == b:
            continue
        met, both = links[a][b]
        if met >= MAJORITY * both:
            _join(a, b, links)
            members[a] += members[b]
            whole[members[b]] = a
    return whole


def _join(a: int, b: int, links: list[dict[int, tuple[int, int]]]) -> None:
    """What the second whole was seen with, the first one now was."""
    links[a].pop(b)
    for other, (met, both) in links[b].items():
        if other == a:
            continue
        m, n = links[a].get(other, (0, 0))
        links[a][other] = links[other][a] = m + met, n + both
        links[other].pop(b)
    links[b].clear()


_LOOKS = 9  # times at which velocities are compared

_MUCH_MORE = 2.0  # times as many beams has that of which something is left over

_ALIKE = 0.5  # of the faster one's speed may velocities differ

_SLOW = 1.0  # m/s, or by that

_NEAR = 10.0  # m, up to where beams are as near each other; then up to twice that, and so on

_FLAT = 2.0  # times as far apart along the line of sight: sides of cars, at flat angles

_CELLS = 3.0  # of so many edges is the way between what hangs together


class ObjectTrack(NamedTuple):
    """An object and what met it.

    Attributes:
        object: as it was followed.
        thing: the same as a box on its way.
        own: numbers within `Moves` of the beams that ended on it, rising.
        fast: whether it is faster than people are.
        large: whether it is longer or wider than people are.
    """

    object: MovingObject
    box: TrackedBox
    returns: Index
    is_fast: bool
    is_large: bool


def collect_tracks(
    sources: MeshInputs, moves: DynamicReturns, options: MoverOptions
) -> list[ObjectTrack]:
    """The objects that have a box, each with its beams."""
    things = {thing.box.object_id: thing for thing in sources.boxes}
    out = []
    for one in sources.objects:
        if one.id in things:
            thing = things[one.id]
            own = segment_object(one, thing, moves, sources, options)
            out.append(
                ObjectTrack(one, thing, own, is_fast(thing, options), is_large(thing, options))
            )
    return out


def merge_tracks(
    followed: Sequence[ObjectTrack],
    moves: DynamicReturns,
    sources: MeshInputs,
    options: MoverOptions,
) -> list[list[ObjectTrack]]:
    """The same, those together that are parts of one thing.

    Of two that are of one velocity, one of them faster than people, and mostly hang together in
    scans that saw both, counted by beams; `grouped` says of more than two. What is of another
    velocity, and in most scans hangs together with more beams of something fast, is no thing, but
    what was left over of those that passed: it is left out.
    """
    n = len(followed)
    quick = np.array([one.is_fast for one in followed], np.bool_)
    if moves.is_planar or not quick.any():
        return [[one] for one in followed]
    scans = list(_scans(followed, moves, sources, options))
    pairs = count_pairs(scans, n)
    alike = quick[pairs.pairs].any(axis=1) & (pairs.connected > 0)
    some = np.flatnonzero(alike)
    alike[some] = [_alike(followed[a], followed[b]) for a, b in pairs.pairs[some].tolist()]
    whole = group_tracks(pairs, alike & (pairs.connected >= MAJORITY * pairs.observed), n)
    groups: dict[int, list[ObjectTrack]] = {}
    for k in np.flatnonzero(~_left_over(scans, whole, quick, pairs.pairs[alike])).tolist():
        groups.setdefault(int(whole[k]), []).append(followed[k])
    return list(groups.values())


def _scans(
    followed: Sequence[ObjectTrack],
    moves: DynamicReturns,
    sources: MeshInputs,
    options: MoverOptions,
) -> Iterator[ScanClusters]:
    """The scans that saw something fast."""
    n, seen = len(followed), sources.deskewed
    quick = np.array([one.is_fast for one in followed], np.bool_)
    number = np.full(max(one.object.id for one in followed) + 2, n, np.intp)  # last: nobody
    number[[one.object.id for one in followed]] = np.arange(n)
    for scan, place in enumerate(seen.T_map_sensor(sources.poses)[:, :3, 3]):
        some = moves.in_beam_range(int(seen.offset[scan]), int(seen.offset[scan + 1]))
        whose = number[moves.owner[some]]
        if not quick[whose[whose < n]].any():
            continue
        piece = cluster_points(moves.ends[some], place, options.link)
        count = np.zeros((n + 1, int(piece.max()) + 1), np.intp)
        np.add.at(count, (whose, piece), 1)
        there = np.flatnonzero(count[:n].any(axis=1))
        yield ScanClusters(there, count[there].argmax(axis=1), count[there].max(axis=1))


def _left_over(scans: Sequence[ScanClusters], whole: Index, quick: Bool, alike: Index) -> Bool:
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
    return (less >= MAJORITY * times) & (times > 0)


def cluster_points(points: Float, place: Float, link: float) -> Index:
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
            piece = cluster_cells(squeezed, reach / _CELLS, reach)
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


def _alike(one: ObjectTrack, other: ObjectTrack) -> bool:
    """Whether they are of one velocity when both are seen."""
    a, b = one.box.box, other.box.box
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
