"""Which things are one, by how often they hang together."""

import numpy as np

from stillmap.mesh.merging import PairCounts, group_tracks


def _pairs(*rows: tuple[int, int, int, int]) -> PairCounts:
    table = np.array(rows, np.intp).reshape(-1, 4)
    return PairCounts(table[:, :2], table[:, 2], table[:, 3])


def _wholes(pairs: PairCounts, n: int, may: list[bool] | None = None) -> list[list[int]]:
    allowed = np.ones(len(pairs.connected), np.bool_) if may is None else np.array(may)
    whole = group_tracks(pairs, allowed, n)
    return [np.flatnonzero(whole == k).tolist() for k in np.unique(whole)]


def test_what_always_hangs_together_is_one_however_long_the_chain() -> None:
    assert _wholes(_pairs((0, 1, 9, 9), (1, 2, 8, 9), (2, 3, 9, 9)), 4) == [[0, 1, 2, 3]]


def test_a_link_between_two_that_are_seen_apart_joins_the_one_it_is_nearer_to() -> None:
    pairs = _pairs((0, 1, 0, 100), (0, 2, 30, 40), (1, 2, 20, 40))
    assert _wholes(pairs, 3) == [[0, 2], [1]]
    assert _wholes(pairs._replace(connected=np.array([0, 20, 30])), 3) == [[0], [1, 2]]


def test_wholes_are_weighed_against_each_other() -> None:
    # 0 with 1 and 2 with 3 first; then 1 and 2 may, but 0 and 3 are apart
    rows = [(0, 1, 50, 50), (2, 3, 40, 40), (1, 2, 30, 30), (0, 3, 0, 31)]
    assert _wholes(_pairs(*rows), 4) == [[0, 1], [2, 3]]
    rows[-1] = (0, 3, 0, 30)
    assert _wholes(_pairs(*rows), 4) == [[0, 1, 2, 3]]
