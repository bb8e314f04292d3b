"""Support by static surfels on a line: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference
from marks import slow_params
from surfel_maps import assert_same_bits, fit_both, fit_surfels, order, together

from stillmap import _core

LINES = {"radius": 20.0, "gap": 3.0, "half_width": 1.2}


def end_points(seed):
    """Of a wall, a slanted one, and stray points on both sides of the origin."""
    rng = np.random.default_rng(seed)
    along = rng.uniform(-2.0, 2.0, 200)
    wall = np.column_stack([along, 0.5 + rng.normal(0.0, 0.02, 200)])
    slanted = np.column_stack([along, -0.3 * along]) + rng.normal(0.0, 0.01, (200, 2))
    return np.concatenate([wall, slanted, rng.uniform(-2.0, 2.0, (80, 2))])


@pytest.mark.parametrize("seed", [0, *slow_params(1, 2)])
@pytest.mark.parametrize("changes", [{}, {"gap": 0.0}, {"radius": 1.5, "gap": 1.0}])
def test_agreement(seed, changes):
    core, plain = fit_both("SurfelMap2D", 0.05, *together(end_points(seed)))
    p = np.random.default_rng(seed).uniform(0.0, 1.0, plain.size).astype(np.float32)
    of_core, of_plain = order(core), order(plain)
    p_of_core = np.empty_like(p)
    p_of_core[of_core] = p[of_plain]
    found = _core.line_support(core, p_of_core, **{**LINES, **changes})
    expected = reference.line_support(plain, p, **{**LINES, **changes})
    assert found.dtype == np.float32
    assert np.ptp(expected) > 1.0
    np.testing.assert_allclose(found[of_core], expected[of_plain], rtol=1e-5, atol=1e-6)


def test_a_wall_supports_itself_and_nothing_beside_it():
    x = np.arange(-1.5, 1.5, 0.05) + 0.025
    wall = np.column_stack([x, np.full_like(x, 0.025)])
    alone = np.array([[0.025, 0.625]])  # the only one there
    surfels = fit_surfels(_core, "SurfelMap2D", 0.05, *together([*wall, *alone]))
    found = _core.line_support(surfels, np.ones(surfels.size, np.float32), **LINES)
    cells = surfels.surfels()[0]
    on_wall = cells[:, 1] == 0
    middle = on_wall & (cells[:, 0] == 0)
    assert found[middle] == 2 * (20 - 2)  # both directions, without the gap
    assert found[~on_wall] <= 6  # where a line crosses the wall
    # what is dynamic supports nothing
    none = _core.line_support(surfels, np.zeros(surfels.size, np.float32), **LINES)
    assert not none.any()


def test_threads_change_nothing():
    rng = np.random.default_rng(4)
    ends = together(rng.uniform(-9.0, 9.0, (60000, 2)))
    surfels = fit_surfels(_core, "SurfelMap2D", 0.05, *ends)
    assert surfels.size > 20000  # enough for threads to be used
    p = rng.uniform(0.0, 1.0, surfels.size).astype(np.float32)
    assert_same_bits(lambda n: [_core.line_support(surfels, p, **LINES, threads=n)], 2, 3)
