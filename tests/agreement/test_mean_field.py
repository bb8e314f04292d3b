"""Mean-field smoothing: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference
from marks import slow_params
from surfel_maps import fit_both, order

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
    surface = _core.SurfelMap3D(0.4)
    surface.add_end_points(ends, np.ones(60000, bool), offset, T, look)
    surface.fit()
    assert surface.size > 20000  # enough for threads to be used
    own = rng.normal(1.0, 2.0, surface.size).astype(np.float32)
    once = _core.smooth_mean_field(surface, own, **MEAN_FIELD)
    for threads in (2, 3):
        assert (
            _core.smooth_mean_field(surface, own, **MEAN_FIELD, threads=threads).tobytes()
            == once.tobytes()
        )


def car_beside_wall(at_car, at_wall):
    """The side of a car of 3 m before a wall; each hit in the given looks, in every cell.

    Returns the surface and which elements are of the car; element i is in column x.
    """
    surface = _core.SurfelMap3D(0.2)
    x, z = (a.ravel() for a in np.meshgrid(np.arange(15) * 0.2 + 0.1, np.arange(8) * 0.2 + 0.1))
    for y, looks in ((2.1, at_car), (4.1, at_wall)):
        ends = np.column_stack([x, np.full_like(x, y), z]).astype(np.float32)
        for look in looks:
            one = np.array([look])
            surface.add_end_points(
                ends, np.ones(len(ends), bool), np.array([0, len(ends)]), np.eye(4)[None], one
            )
    surface.fit()
    cells = surface.surfels()[0]
    return surface, cells[:, 1] == 10, cells[:, 0]


def test_disjoint_time_spans_do_not_interact():
    # the same, but the rest was hit before the mover came
    surface, car, x = car_beside_wall([5, 6, 7], [0, 9])
    other = _core.SurfelMap3D(0.2)
    cells = surface.surfels()[0]
    for early in (False, True):
        of = (car & (x >= 4)) if early else (car & (x < 4))
        ends = ((cells[of] + 0.5) * 0.2).astype(np.float32)
        for look in [0, 4] if early else [5, 6, 7]:
            other.add_end_points(
                ends,
                np.ones(len(ends), bool),
                np.array([0, len(ends)]),
                np.eye(4)[None],
                np.array([look]),
            )
    other.fit()
    x = other.surfels()[0][:, 0]
    own = np.where(x < 4, -4.0, 1.5).astype(np.float32)
    p = _core.smooth_mean_field(other, own, **MEAN_FIELD)
    np.testing.assert_array_equal(p > 0.5, x >= 4)
