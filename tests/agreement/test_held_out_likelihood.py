"""Held-out likelihood: kernel against twin, and normalisation of the density."""

import numpy as np
import pytest
import reference
from surfel_maps import assert_same_bits

from stillmap import _core

MODEL = {"stopping_rate": 4.0, "range_std": 0.08, "late_share": 0.4}
MODEL |= {"mean_delay": 0.2, "outlier_share": 0.02}


@pytest.fixture
def held(beams):
    return np.arange(len(beams.T_map_sensor)) % 3 == 2


def filled(kernels, beams, held):
    shares = getattr(kernels, f"StaticFractionGrid{beams.dimension}D")(beams.resolution)
    shares.add(*beams.weighted, held)
    return shares


def test_rates(beams, held):
    core, plain = filled(_core, beams, held), filled(reference, beams, held)
    assert core.resolution == plain.resolution
    assert core.end_rate == pytest.approx(plain.end_rate, rel=1e-6)
    assert core.dynamic_rate == pytest.approx(plain.dynamic_rate, rel=1e-6)
    assert 0 < core.dynamic_rate < core.end_rate


@pytest.mark.parametrize(
    "changes", [{}, {"late_share": 0.0}, {"late_share": 1.0}, {"range_std": 0.5}]
)
def test_scores(beams, held, changes):
    core, plain = filled(_core, beams, held), filled(reference, beams, held)
    scans = *beams.arguments, held
    model = {**MODEL, **changes}
    ours = _core.score_held_out(core, *scans, **model)
    expected = reference.score_held_out(plain, *scans, **model)
    assert ours.shape == expected.shape == (len(held), 2)
    assert not ours[~held].any()
    assert expected[:, 1].sum() > 20
    assert np.ptp(expected[held, 0]) > 1
    np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-5)


def test_any_number_of_threads_gives_the_same_bits(beams, held):
    asked = (filled(_core, beams, held), *beams.arguments, held)
    assert_same_bits(lambda n: [_core.score_held_out(*asked, **MODEL, threads=n)], 2, 3, 64)


def wall_and_clutter(kernels, dimension):
    """Returns around 3 m (e = 0.7) and 4 m (e = 1) along x, dynamic ones before them."""
    rng = np.random.default_rng(8)
    x = np.concatenate([rng.normal(3, 0.1, 40), rng.normal(4, 0.1, 40), rng.uniform(1, 3, 20)])
    points = np.zeros((len(x), dimension), np.float32)
    points[:, 0] = x
    points[:, 1:] = rng.normal(scale=0.05, size=(len(x), dimension - 1))
    e = np.repeat([0.7, 1.0, 0.0], [40, 40, 20]).astype(np.float32)
    shares = getattr(kernels, f"StaticFractionGrid{dimension}D")(0.1)
    hit, offset, T = np.ones(len(x), bool), np.array([0, len(x)]), np.eye(dimension + 1)[None]
    shares.add(points, hit, e, offset, T, np.array([False]))
    return shares


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(
    "model", [MODEL, {**MODEL, "stopping_rate": 30.0}, {**MODEL, "late_share": 1.0}]
)
def test_density_integrates_to_one(dimension, model):
    shares = wall_and_clutter(_core, dimension)
    step, longest = 0.002, 12.0
    z = np.append(np.arange(step / 2, longest, step), longest)
    direction = np.array([1.0, 0.02, 0.01][:dimension])
    points = (z[:, None] * direction / np.linalg.norm(direction)).astype(np.float32)
    hit = np.append(np.ones(len(z) - 1, bool), False)
    n = len(z)
    gain, count = _core.score_held_out(
        shares, points, hit, np.arange(n + 1), np.tile(np.eye(dimension + 1), (n, 1, 1)),
        np.ones(n, bool), **model,
    ).T  # fmt: skip
    assert (count == 1).all()
    q = shares.end_rate
    log_q = np.where(hit, np.log(q), 0.0) - q * np.linalg.norm(points, axis=1)
    p = np.exp(gain + log_q)
    assert p[:-1].sum() * step + p[-1] == pytest.approx(1.0, abs=2e-3)
    assert p[:-1].max() > 3 * np.exp(log_q[:-1]).max()  # the map is informative


def test_returns_near_the_largest_cell():
    # the traversal continues behind a return and would leave the range of cell indices
    points = np.array([[2.0**24 - 1, 0.5]], np.float32)
    args = points, np.array([True]), np.array([0, 1]), np.eye(3)[None], np.array([True])
    with pytest.raises(ValueError, match="too far"):
        _core.score_held_out(_core.StaticFractionGrid2D(1.0), *args, **{**MODEL, "range_std": 10.0})
