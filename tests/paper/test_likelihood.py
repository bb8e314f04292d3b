"""Equations (1) to (5) and (7) on a lane whose occupancies are m = 0, 1/5, 0, 3/4, unknown."""

from math import exp, log

import numpy as np
import pytest

P = 0.9


def terms(lane, grid, ranges, hit, e, scans=1, prior=P):
    points, struck, offset, T = lane.beams(ranges, hit, scans)
    e = np.array(e, np.float32)
    return lane.impl.log_likelihood(grid, points, struck, e, offset, T, prior)


@pytest.mark.parametrize(
    ("end", "hit", "c", "likelihood"),
    [
        (3.5, True, 1, 3 / 5),  # 1 * 4/5 * 1 * 3/4: static, m of the end cell
        (3.5, True, 0, 1 / 5),  # 1 * 4/5 * 1 * 1/4: dynamic, 1 - m of the end cell
        (1.5, True, 1, 1 / 5),  # 1 * 1/5
        (1.5, True, 0, 4 / 5),  # 1 * 4/5
        (0.5, True, 0, 1.0),  # 1 - m of the first cell; no cell was passed
        (3.5, False, 1, 4 / 5),  # maximum range: the end cell says nothing ...
        (3.5, False, 0, 4 / 5),  # ... whatever c is
        (4.5, False, 1, 1 / 5),  # 1 * 4/5 * 1 * 1/4
    ],
)
def test_equation_1_likelihood_of_one_beam(lane, end, hit, c, likelihood):
    t = terms(lane, lane.known_map(), [end], [hit], [c])
    assert exp(t[0, 0] + t[0, 1]) == pytest.approx(likelihood, rel=1e-6)


def test_equation_1_impossible_beam_is_floored(lane):
    # static in a cell with m = 0: likelihood 0, of which the logarithm is taken of 1e-12
    t = terms(lane, lane.known_map(), [2.5], [True], [1])
    assert t[0, 0] == pytest.approx(log(1e-12), rel=1e-9)
    assert t[0, 1] == pytest.approx(log(4 / 5), rel=1e-6)


def test_equation_1_unknown_cells_say_nothing(lane):
    # cells 4, 5 and 6 were never looked at
    t = terms(lane, lane.known_map(), [6.5, 6.5], [True, False], [0.3, P])
    assert t[0, 0] == 0
    assert t[0, 1] == pytest.approx(2 * log(4 / 5 * 1 / 4), rel=1e-6)


def test_equations_3_and_4_sum_over_beams_and_scans(lane):
    # (3): the product over scans t and beams n, each with its own p(c_{t,n}); NOTES: the N in
    # front of the sum over t in (4) is a slip for the sum over n
    #   scan 0: hit in cell 3 with c = 1: 3/5, p(c) = .9;  hit in cell 1 with c = 0: 4/5, p(c) = .1
    #   scan 1: hit in cell 3 with c = 0: 1/5, p(c) = .1;  maximum range, c = 1: 1/5, p(c) = .9
    t = terms(lane, lane.known_map(), [3.5, 1.5, 3.5, 4.5], [1, 1, 1, 0], [1, 0, 0, 1], scans=2)
    assert np.exp(t[:, :3].sum(axis=1)) == pytest.approx(
        [3 / 5 * 0.9 * 4 / 5 * 0.1, 1 / 5 * 0.1 * 1 / 5 * 0.9], rel=1e-5
    )
    assert t[:, 3] == pytest.approx([0, 0])  # c is known: no entropy


def test_equation_5_expected_log_likelihood(lane):
    # e = 1/4 in cell 3: 1/4 ln 3/4 + 3/4 ln 1/4; e = 1/2 in cell 1: 1/2 ln 1/5 + 1/2 ln 4/5;
    # zeta = 1: no end-point term. Passed: 4/5, nothing, 4/5 and 1/4
    t = terms(lane, lane.known_map(), [3.5, 1.5, 4.5], [1, 1, 0], [0.25, 0.5, P])
    assert t[0, 0] == pytest.approx(
        0.25 * log(0.75) + 0.75 * log(0.25) + 0.5 * log(0.2) + 0.5 * log(0.8), rel=1e-6
    )
    assert t[0, 1] == pytest.approx(log(0.8) + log(0.8) + log(0.25), rel=1e-6)


def test_equation_5_is_the_mean_of_equation_4(lane):
    # expectation over c in {0, 1}^2 with P(c_0 = 1) = 1/4, P(c_1 = 1) = 1/2
    grid, ranges, hit = lane.known_map(), [3.5, 1.5], [1, 1]
    mean = sum(
        (0.25 if a else 0.75) * 0.5 * terms(lane, grid, ranges, hit, [a, b])[0, :3].sum()
        for a in (0, 1)
        for b in (0, 1)
    )
    expected = terms(lane, grid, ranges, hit, [0.25, 0.5])
    assert expected[0, :3].sum() == pytest.approx(mean, rel=1e-9)


def test_equation_7_prior_of_the_expectations(lane):
    # per beam e ln p + (1 - e) ln(1 - p), maximum range included, unusable beams not
    ranges, hit, e = [3.5, 1.5, 4.5, np.nan], [1, 1, 0, 0], [0.25, 1, P, np.nan]
    t = terms(lane, lane.known_map(), ranges, hit, e)
    # (0.25 + 1 + 0.9) ln .9 + (0.75 + 0 + 0.1) ln .1 = 2.15 ln .9 + 0.85 ln .1 = -2.18372...
    assert t[0, 2] == pytest.approx(2.15 * log(0.9) + 0.85 * log(0.1), rel=1e-6)
    assert t[0, 2] == pytest.approx(-2.183723, abs=2e-6)


def test_entropy_of_the_expectations(lane):
    # 1/2: ln 2;  1/4: 1/4 ln 4 + 3/4 ln 4/3 = 0.562335;  0 and 1: nothing
    for grid in (lane.known_map(), lane.grid()):  # it has nothing to do with the map
        t = terms(lane, grid, [3.5] * 4, [1] * 4, [0.5, 0.25, 0, 1])
        assert t[0, 3] == pytest.approx(0.693147 + 0.562335, abs=1e-6)


def test_bound_is_the_log_evidence_when_e_is_the_posterior(lane):
    # after (8) the four terms add up to ln p(z | x, m); a hit in cell 3:
    # 4/5 (.9 * 3/4 + .1 * 1/4) = .56, in cell 1: .9 * 1/5 + .1 * 4/5 = .26, at maximum range:
    # 4/5 * 1/4 = .2
    grid = lane.known_map()
    points, hit, offset, T = lane.beams([3.5, 1.5, 4.5], [1, 1, 0])
    e = lane.impl.e_step(grid, points, hit, offset, T, P)
    bound = lane.impl.log_likelihood(grid, points, hit, e, offset, T, P).sum()
    assert exp(bound) == pytest.approx(0.56 * 0.26 * 0.2, rel=1e-6)


def test_likelihood_of_nothing(lane):
    assert terms(lane, lane.known_map(), [], [], []).tolist() == [[0, 0, 0, 0]]
