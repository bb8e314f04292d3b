"""Where EM with the printed E-step (8) ends when each cell stands alone.

With r = hits / (hits + length of the passages), m = r e after the M-step, and (8) turns e into
p r e / (p r e + (1 - p)(1 - r e)). For p > 1/2 that settles at
m* = max(0, (p (1 + r) - 1) / (2 p - 1)), e* = m* / r: p is a threshold (1 - p) / p on r.
"""

import numpy as np
import pytest
import reference

from stillmap import _core

# hits in a cell and the length of the passages through it, in cells
COUNTS = [(1, 0.0), (5, 1.0), (2, 0.75), (3, 2.0), (2, 3.0), (1, 4.0), (1, 9.0)]


def lanes(counts):
    """Beams in one row of cells for each entry of `counts`; cell 1 of a row is the one hit."""
    points, hit, offset, T = [], [], [0], []

    def scan(x, row, ranges, struck):
        points.extend([[r, 0] for r in ranges])
        hit.extend([struck] * len(ranges))
        offset.append(len(points))
        T.append([[1, 0, x], [0, 1, row + 0.5], [0, 0, 1]])

    for row, (hits, passed) in enumerate(counts):
        whole, part = int(passed), passed % 1
        scan(0, row, [1.5] * hits, True)
        scan(0, row, [2.5] * whole, False)
        if part:
            scan(2 - part, row, [part + 0.5], False)
    return np.array(points, np.float32), np.array(hit), np.array(offset), np.array(T, float)


def settled(kernels, counts, prior, iterations):
    """(len(counts),) e of the hits and m of the cell they end in."""
    points, hit, offset, T = lanes(counts)
    last = reference.em_fixed_poses(points, hit, offset, T, prior, 1.0, iterations, kernels)[-1]
    cells = np.array([[1, row] for row in range(len(counts))])
    alpha, beta = last.grid.alpha_beta(cells).T
    rows = np.repeat(T[:, 1, 2].astype(int), np.diff(offset))
    e = np.array([last.e[hit & (rows == row)].mean() for row in range(len(counts))])
    assert alpha + beta == pytest.approx([h + b for h, b in counts], abs=1e-6)
    return e, reference.occupancy(alpha, beta)


@pytest.mark.parametrize("kernels", [reference, _core])
@pytest.mark.parametrize("prior", [0.6, 0.75, 0.9])
def test_fixed_point(kernels, prior):
    e, m = settled(kernels, COUNTS, prior, 200)
    r = np.array([h / (h + b) for h, b in COUNTS])
    m_star = np.maximum(0, (prior * (1 + r) - 1) / (2 * prior - 1))
    assert 0 < (m_star > 0).sum() <= len(r)
    assert m == pytest.approx(m_star, abs=2e-5)
    assert e == pytest.approx(m_star / r, abs=2e-5)


@pytest.mark.parametrize("kernels", [reference, _core])
def test_fixed_point_in_numbers(kernels):
    # p = 3/4: r = 5/6: (3/4 * 11/6 - 1) / (1/2) = 3/4, e = 9/10
    #          r = 3/5: (3/4 * 8/5 - 1) / (1/2) = 2/5, e = 2/3;  r = 1/5 < 1/3: 0
    e, m = settled(kernels, [(5, 1.0), (3, 2.0), (1, 4.0)], 0.75, 200)
    assert m == pytest.approx([3 / 4, 2 / 5, 0], abs=1e-5)
    assert e == pytest.approx([9 / 10, 2 / 3, 0], abs=1e-5)


@pytest.mark.parametrize("kernels", [reference, _core])
def test_at_the_threshold_it_fades_slowly(kernels):
    # r = (1 - p) / p exactly: no factor below one, e falls like one over the iterations
    counts = [(1, 2.0)]
    early, late = (settled(kernels, counts, 0.75, n)[0][0] for n in (20, 200))
    assert 0 < late < early / 5
    assert late > early / 20


@pytest.mark.parametrize("kernels", [reference, _core])
def test_even_prior_erases_everything_that_was_ever_crossed(kernels):
    e, m = settled(kernels, [(9, 1.0), (1, 0.75), (4, 0.0)], 0.5, 200)
    assert m[:2] == pytest.approx([0, 0], abs=1e-5)
    assert e[2] == m[2] == 0.5  # and of what was not it learns nothing
