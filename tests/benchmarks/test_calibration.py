"""Errors of calibration, and how much of them few cells make by chance."""

import numpy as np
import pytest
from calibration import Beams, if_calibrated, joined


def beams(cells, per_cell, seed=0):
    """Calibrated beams: each cell is static, or is not, with its probability."""
    rng = np.random.default_rng(seed)
    cell = np.repeat(np.arange(cells), per_cell)
    p = rng.uniform(0.05, 0.95, cells)
    static = rng.random(cells) < p
    n = len(cell)
    looks, span = np.ones((2, n), np.int32)
    return Beams(p[cell], static[cell], looks, span, np.ones(n), cell)


def test_few_cells_look_uncalibrated_by_chance():
    rng = np.random.default_rng(1)
    few, many = (if_calibrated(beams(n, 10), rng) for n in (40, 4000))
    assert few > 0.12
    assert many < 0.03
    alone = if_calibrated(beams(400, 1), rng)
    together = if_calibrated(beams(40, 10), rng)
    assert together == pytest.approx(np.sqrt(10) * alone, rel=0.4)


def test_runs_keep_their_cells_apart():
    one, other = beams(5, 2), beams(7, 3)
    both = joined([one, other])
    assert len(both.p) == 10 + 21
    assert len(np.unique(both.cell)) == 12
    assert (both.p[:10] == one.p).all()
