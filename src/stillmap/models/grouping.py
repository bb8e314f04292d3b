"""Things that are one, by how often they hang together in scans that see both.

A track that takes hold of one car and then of the next hangs together with both. So it is not
enough that a chain of tracks links two: those of one whole must hang together with those of the
other, all in all, to become one with it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

MOSTLY = 0.5  # of what is counted
_AT_ONCE = 1000  # scans, after which their pairs are counted


class Scan(NamedTuple):
    """Which things a scan saw: (n,) numbers, the piece that most of each is of, and its beams."""

    there: Index
    piece: Index
    beams: Index


class Pairs(NamedTuple):
    """Things that scans saw at once, as often as there are beams on the one that has fewer.

    Attributes:
        ends: (m, 2) their numbers, the lesser one first; rising.
        met: (m,) how often they hung together.
        both: (m,) how often both were seen.
    """

    ends: Index
    met: Index
    both: Index


def pairs_of(scans: Sequence[Scan], n: int) -> Pairs:
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
    return Pairs(np.stack([key // n, key % n], axis=1), met, both)


def grouped(pairs: Pairs, may: Bool, n: int) -> Index:
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
        pairs.ends.tolist(), pairs.met.tolist(), pairs.both.tolist(), strict=True
    ):
        links[a][b] = links[b][a] = met, both
    candidates = np.flatnonzero(may & (pairs.met > 0))
    for k in candidates[np.argsort(-pairs.met[candidates], kind="stable")].tolist():
        a, b = sorted(whole[pairs.ends[k]].tolist())
        if a == b:
            continue
        met, both = links[a][b]
        if met >= MOSTLY * both:
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
