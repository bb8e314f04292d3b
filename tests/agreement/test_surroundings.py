"""Misses while something is hit around a surfel: kernel against twin on small rooms in space."""

from itertools import pairwise

import numpy as np
import pytest
import reference
from surfel_maps import assert_same_bits, order

from stillmap import _core

EDGES = [0.4, 0.9]  # m: one cell and two


@pytest.fixture(scope="module")
def room(a_room):
    return a_room(2, 3, 0.4, 16, 150)


def counted(room, kernels, edge, cuts=(), threads=1):
    surface = room.surface(kernels)
    hmm = room.hmm(kernels, surface, [0.5], [1.0], p_detection=0.5)
    hmm.track_surroundings(edge)
    for first, last in pairwise([0, *cuts, len(room.time_bin)]):
        hmm.add(*room.scans(first, last), room.time_bin[first:last], threads)
    return hmm.miss_counts()[order(surface)]


@pytest.mark.parametrize("edge", EDGES)
def test_miss_counts(room, edge):
    core, plain = counted(room, _core, edge), counted(room, reference, edge)
    assert core.dtype == np.float32
    error = np.abs(core - plain)
    assert np.quantile(error, 0.95) < 0.03
    assert error.max() < 0.2  # observations near the thresholds
    misses, surrounded = plain.T
    assert (surrounded <= misses).all()
    assert (surrounded > 0.5).sum() > 10
    assert (misses - surrounded > 0.5).sum() >= (5 if edge < 0.9 else 1)


def test_wider_surroundings_are_hit_more_often(room):
    near, far = (counted(room, _core, edge)[:, 1].sum() for edge in EDGES)
    assert far > 1.2 * near


def test_threads_and_chunks_give_the_same_bits(room):
    bins = [int(np.searchsorted(room.time_bin, room.time_bin[c])) for c in (3, 8)]
    assert_same_bits(lambda n: [counted(room, _core, 0.9, bins if n > 1 else (), n)], 2, 5)


def test_surroundings_change_no_likelihood(room):
    with_them, without = (
        room.hmm(_core, room.surface(_core), [0.9, 0.1], [9.0, 1.0], p_detection=0.9)
        for _ in range(2)
    )
    with_them.track_surroundings(0.9)
    for hmm in (with_them, without):
        hmm.add(*room.beams.arguments, room.time_bin)
    for a, b in zip(with_them.likelihood(), without.likelihood(), strict=True):
        assert a.tobytes() == b.tobytes()
    every = with_them.miss_counts()
    np.testing.assert_array_equal(with_them.miss_counts((3, 20, 4)), every[3:20:4])
