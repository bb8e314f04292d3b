"""Fig. 2: e starts at the prior; map and expectations are estimated in turn."""

from itertools import pairwise

import pytest
from reference import em_fixed_poses


def test_figure_2_two_rounds_by_hand(lane):
    # cell 3 is hit 4 times and passed once, p = 4/5
    #   M: alpha = 4 * 4/5, beta = 4 * 1/5 + 1, m = 16/25
    #   E: .8 * .64 / (.8 * .64 + .2 * .36) = .512 / .584 = 64/73
    #   M: m = 4/5 * 64/73 = 256/365
    #   E: .8 * 256 / (.8 * 256 + .2 * 109) = 204.8 / 226.6 = 1024/1133
    beams = lane.beams([3.5, 3.5, 3.5, 3.5, 4.5], [1, 1, 1, 1, 0])
    first, second = em_fixed_poses(*beams, 0.8, lane.resolution, 2, lane.impl)
    assert lane.alpha_beta(first.grid, [3])[0] == pytest.approx([3.2, 1.8], abs=1e-6)
    assert first.e == pytest.approx([64 / 73] * 4 + [0.8], abs=1e-6)
    assert lane.alpha_beta(second.grid, [3])[0] == pytest.approx([256 / 73, 5 - 256 / 73], abs=1e-6)
    assert second.e == pytest.approx([1024 / 1133] * 4 + [0.8], abs=1e-6)


def test_figure_2_likelihood_rises(lane):
    beams = lane.beams([3.5, 3.5, 3.5, 3.5, 4.5], [1, 1, 1, 1, 0])
    history = em_fixed_poses(*beams, 0.8, lane.resolution, 6, lane.impl)
    bounds = [b for step in history for b in (step.bound_after_m, step.bound)]
    assert all(b > a for a, b in pairwise(bounds))
    # ln p(z | x, m) of the first map: 4 hits of .8 * .64 + .2 * .36 = .584, one passage of .36
    assert bounds[1] == pytest.approx(-3.173068, abs=2e-6)


def test_figure_2_somebody_passing_fades_and_a_wall_stays(lane):
    # one hit in cell 1 among 20 passages, ten hits in cell 5, which nothing passes
    beams = lane.beams([1.5] + [5.5] * 10 + [4.5] * 10, [1] * 11 + [0] * 10)
    last = em_fixed_poses(*beams, 0.8, lane.resolution, 10, lane.impl)[-1]
    assert last.e[0] < 1e-6
    assert last.e[1:11] == pytest.approx(1, abs=1e-5)
