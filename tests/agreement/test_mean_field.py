"""Mean-field smoothing: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference
from marks import slow_params
from surfel_maps import assert_same_bits, fit_both, fit_surfels, order, together

from stillmap import _core
from stillmap.em.spatial_coupling import _MEAN_FIELD as MEAN_FIELD


def surfaces(seed):
    """Surfel maps of a wall, the ground and stray points, with random time bins."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack([rng.normal(4.0, 0.02, 400), *rng.uniform(-1.5, 1.5, (2, 400))])
    ground = np.column_stack([*rng.uniform(-1.5, 1.5, (2, 300)), rng.normal(-1.5, 0.02, 300)])
    ends = np.concatenate([wall, ground, rng.uniform(-2, 4, (60, 3))]).astype(np.float32)
    look = np.sort(rng.integers(0, 30, len(ends)))
    T = np.tile(np.eye(4), (len(ends), 1, 1))
    beams = rng.permutation(ends), np.ones(len(ends), bool), np.arange(len(ends) + 1), T
    return fit_both("SurfelMap3D", 0.3, *beams, look)


@pytest.mark.parametrize("seed", [0, *slow_params(1, 2)])
@pytest.mark.parametrize("changes", [{}, {"radius": 1.0, "tolerance": 0.0}, {"max_iterations": 1}])
def test_agreement(seed, changes):
    core, plain = surfaces(seed)
    own = np.random.default_rng(seed + 7).normal(1.0, 3.0, plain.size).astype(np.float32)
    of_core, of_plain = order(core), order(plain)
    np.testing.assert_array_equal(core.hit_spans[of_core], plain.hit_spans[of_plain])
    log_odds = np.empty(plain.size, np.float32)
    log_odds[of_core] = own[of_plain]
    found = _core.smooth_mean_field(core, log_odds, **{**MEAN_FIELD, **changes})
    expected = reference.smooth_mean_field(plain, own, **{**MEAN_FIELD, **changes})
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[of_core], expected[of_plain], atol=2e-5)
    assert np.mean((expected > 0.5) != (own > 0.0)) > 0.02  # some labels change


def test_threads_change_nothing():
    rng = np.random.default_rng(3)
    ends = rng.uniform(-9, 9, (60000, 3)).astype(np.float32)
    T = np.tile(np.eye(4), (100, 1, 1))
    offset, look = np.arange(0, 60001, 600), np.arange(100)
    beams = ends, np.ones(60000, bool), offset, T, look
    surface = fit_surfels(_core, "SurfelMap3D", 0.4, *beams)
    assert surface.size > 20000  # enough for threads to be used
    own = rng.normal(1.0, 2.0, surface.size).astype(np.float32)
    assert_same_bits(
        lambda n: [_core.smooth_mean_field(surface, own, **MEAN_FIELD, threads=n)], 2, 3
    )


def test_disjoint_time_spans_do_not_interact():
    """A car of 3 m side by side with what was hit before it came."""
    surface = _core.SurfelMap3D(0.2)
    x, z = (a.ravel() for a in np.meshgrid(np.arange(15) * 0.2 + 0.1, np.arange(8) * 0.2 + 0.1))
    ends = np.column_stack([x, np.full_like(x, 2.1), z])
    for of, looks in ((x < 0.8, (5, 6, 7)), (x >= 0.8, (0, 4))):
        for look in looks:
            surface.add_end_points(*together(ends[of]), np.array([look]))
    surface.fit()
    column = surface.surfels()[0][:, 0]
    own = np.where(column < 4, -4.0, 1.5).astype(np.float32)
    p = _core.smooth_mean_field(surface, own, **MEAN_FIELD)
    np.testing.assert_array_equal(p > 0.5, column >= 4)
