"""Mixture weights fitted by EM."""

import numpy as np
import pytest

from stillmap.em.mixture import fit_weights, posterior_static

N_STATIC = 2


def members(rng, shares, n, spread=2.0):
    """(n, C) likelihoods, relative to the best, of classes that are centres along a line."""
    kind = rng.choice(len(shares), n, p=shares)
    x = rng.normal(kind * spread, 1.0)
    log_p = -0.5 * (x[:, None] - spread * np.arange(len(shares))) ** 2
    return np.exp(log_p - log_p.max(axis=1, keepdims=True)).astype(np.float32), kind


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("start", [0.1, 0.5, 0.95])
def test_no_iteration_lowers_the_likelihood(seed, start):
    rng = np.random.default_rng(seed)
    likelihood, _ = members(rng, [0.5, 0.2, 0.2, 0.1], 300)

    def objective(shares):
        # one pseudo member per class, shared within the static and within the moving classes
        s, m = shares[:N_STATIC], shares[N_STATIC:]
        pseudo = np.log(s / s.sum()).sum() + np.log(m / m.sum()).sum()
        return float(np.log(likelihood.astype(float) @ shares).sum()) + pseudo

    values = [
        objective(fit_weights(likelihood, N_STATIC, start, max_iterations=n, tolerance=-1.0))
        for n in (1, 2, 3, 5, 8, 13, 50, 100)
    ]
    assert np.diff(values).min() > -1e-9 * abs(values[0])
    assert values[-1] > values[0] + 0.1


def test_known_weights_are_found():
    true = np.array([0.45, 0.3, 0.2, 0.05])
    likelihood, kind = members(np.random.default_rng(1), true, 40000, spread=2.5)
    found = fit_weights(likelihood, N_STATIC, 0.5)
    assert found == pytest.approx(true, abs=0.012)
    assert found[:N_STATIC].sum() == pytest.approx(0.75, abs=0.01)
    assert found.sum() == pytest.approx(1.0)
    p = posterior_static(likelihood, found, N_STATIC)
    assert p.dtype == np.float32
    for low in np.arange(0.0, 1.0, 0.2):
        these = (p >= low) & (p < low + 0.2)
        assert p[these].mean() == pytest.approx((kind[these] < N_STATIC).mean(), abs=0.04)


@pytest.mark.parametrize("start", [0.3, 0.9])
@pytest.mark.parametrize("rows", [0, 1])
def test_rows_that_say_nothing_leave_the_initial_weight(start, rows):
    likelihood = np.ones((rows, 4), np.float32)
    found = fit_weights(likelihood, N_STATIC, start)
    assert found[:N_STATIC].sum() == pytest.approx(start)
    assert found.sum() == pytest.approx(1.0)
    assert posterior_static(likelihood, found, N_STATIC).shape == (rows,)


@pytest.mark.parametrize("sure", range(4))
def test_rows_of_one_class(sure):
    likelihood = np.full((1, 4), 1e-30, np.float32)
    likelihood[0, sure] = 1.0
    found = fit_weights(np.repeat(likelihood, 50, axis=0), N_STATIC, 0.5)
    assert (found > 0).all()  # what was never seen is not impossible
    assert found.sum() == pytest.approx(1.0)
    static = sure < N_STATIC
    assert (found[:N_STATIC].sum() > 0.99) == static
    assert (found[:N_STATIC].sum() < 0.01) == (not static)
    assert (posterior_static(likelihood, found, N_STATIC)[0] > 0.5) == static


@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_rare_classes_keep_their_bound(share):
    """Without it, a class that describes badly aligned walls takes over."""
    shares = np.array([0.6, 0.4, 0.0, 0.0]) * (1.0 - share) + np.array([0, 0, 0, share])
    likelihood, _ = members(np.random.default_rng(5), shares, 4000)
    rare = np.array([False, False, False, True])
    free = fit_weights(likelihood, N_STATIC, 0.9)
    bounded = fit_weights(likelihood, N_STATIC, 0.9, rare=rare)
    assert bounded.sum() == pytest.approx(1.0)
    assert bounded[3] <= 0.1 + 1e-9
    if share < 0.1:  # not reached
        np.testing.assert_allclose(bounded, free)
    else:
        assert free[3] > 0.3
        assert bounded[3] == pytest.approx(0.1)
        assert bounded[:N_STATIC].sum() > free[:N_STATIC].sum()
