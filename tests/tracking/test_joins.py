"""Pieces of paths that somebody made up: which are joined, and how surely."""

import itertools

import numpy as np
import pytest

from stillmap.tracking.joins import Detections, compute_marginals, join_pieces

PERIOD = 0.2


def join(*pieces, is_fast=False):
    """Join pieces (first time, last time, place at time 0, velocity, width)."""
    rng = np.random.default_rng(3)
    columns = []
    for number, (first, last, x, v, width) in enumerate(pieces):
        t = np.arange(first, last, PERIOD)
        xy = np.array(x) + t[:, None] * np.array(v) + rng.normal(0.0, 0.03, (len(t), 2))
        columns.append((np.full(len(t), number), t, xy, np.full(len(t), width)))
    detections = Detections._make(np.concatenate(column) for column in zip(*columns, strict=True))
    mover, p = join_pieces(detections, np.full(len(pieces), is_fast), PERIOD)
    return mover.tolist(), p


BEFORE = (0, 3, (0, 0), (1, 0), 0.4)
ONE, OTHER = ((-4, 0), (1, 0.3), 0.4), ((4, 0), (-1, 0.3), 0.4)  # they meet at 4 s


@pytest.mark.parametrize(
    ("pieces", "expected", "least", "most"),
    [
        ([BEFORE, (4.4, 8, *BEFORE[2:])], [0, 0], 0.9, 0.999),
        ([BEFORE, (4.4, 8, (0, 3), (1, 0), 0.4)], [0, 1], 1.0, 1.0),  # who appears elsewhere
        # the nearest piece is that of the other: velocities say who is who
        (
            [(0, 3.5, *ONE), (0, 3.5, *OTHER), (4.5, 8, *OTHER), (4.5, 8, *ONE)],
            [0, 1, 1, 0],
            0.9,
            1.0,
        ),
        # each piece goes on in one
        ([BEFORE, *((3.6, 8, (0, y), (1, 0), 0.4) for y in (0.0, 0.3, -0.3))], [0, 0, 2, 3], 0, 1),
    ],
)
def test_who_goes_on_as_whom(pieces, expected, least, most):
    mover, p = join(*pieces)
    assert mover == expected
    assert ((p[: len(pieces) // 2] >= least) & (p[: len(pieces) // 2] <= most)).all()


def test_who_could_be_either_is_joined_without_certainty():
    mover, p = join(
        *((0, 3, (0, y), (1, 0), 0.4) for y in (0.2, -0.2)),
        *((4.6, 8, (0, y), (1, 0), 0.4) for y in (0.05, -0.05)),
    )
    assert sorted(mover) == [0, 0, 1, 1]
    assert (p[:2] < 0.8).all()


@pytest.mark.parametrize("thin_first", [True, False])
def test_width_decides_where_motion_does_not(thin_first):
    before, after = [(0, 3), (4.4, 8)]
    widths = (0.1, 0.6) if thin_first else (0.6, 0.1)
    pieces = [(*before, (0, y), (1, 0), w) for y, w in zip((0.1, -0.1), widths, strict=True)]
    pieces += [(*after, (0, 0), (1, 0), w) for w in (0.1, 0.6)]
    mover, _ = join(*pieces)
    assert mover == ([0, 1, 0, 1] if thin_first else [0, 1, 1, 0])


def test_a_vehicle_that_is_hidden_is_the_same():
    pieces = ((0, 2, (0, 0), (9, 0), 1.0), (3, 5, (0, 0), (9, 0), 1.0))
    assert join(*pieces, is_fast=True)[0] == [0, 0]


def test_nothing_to_join():
    detections = Detections(np.zeros(0, int), np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    mover, p = join_pieces(detections, np.zeros(0, bool), PERIOD)
    assert len(mover) == len(p) == 0


@pytest.mark.parametrize("seed", range(3))
def test_marginals_are_near_those_of_all_hypotheses(seed):
    ratio = np.exp(np.random.default_rng(seed).normal(1.0, 2.0, (3, 3)))
    weight, sums = 0.0, np.zeros((3, 3))
    for columns in itertools.product((-1, 0, 1, 2), repeat=3):
        used = [(i, j) for i, j in enumerate(columns) if j >= 0]
        if len({j for _, j in used}) < len(used):
            continue
        product = float(np.prod([ratio[i, j] for i, j in used]))
        weight += product
        for i, j in used:
            sums[i, j] += product
    before, after = np.divmod(np.arange(9), 3)
    found = compute_marginals(before, after + 3, np.log(ratio).ravel(), 6)
    np.testing.assert_allclose(found, (sums / weight).ravel(), atol=0.1)


def test_marginals_of_one_with_two_successors_are_exact():
    log_ratio = np.array([1.0, 2.0])
    found = compute_marginals(np.zeros(2, int), np.array([1, 2]), log_ratio, 3)
    np.testing.assert_allclose(found, np.exp(log_ratio) / (1.0 + np.exp(log_ratio).sum()))


@pytest.mark.parametrize("seed", range(5))
def test_marginals_of_likely_joins_are_probabilities(seed):
    # sums of such ratios less one of their terms are negative by rounding
    before, after = np.triu_indices(5, 1)
    log_ratio = np.random.default_rng(seed).uniform(20.0, 60.0, len(before))
    found = compute_marginals(before, after, log_ratio, 5)
    assert (found >= 0.0).all()
    assert np.bincount(before, found).max() <= 1.0 + 1e-9
