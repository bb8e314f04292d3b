"""Two-state chains of one surfel in front of a sensor: kernel against twin."""

from itertools import pairwise, product
from math import log

import numpy as np
import pytest
from reference.observation import HIT
from reference.occupancy_hmm import chain_log_likelihood
from surfel_maps import fit_surfels

from stillmap import _core
from stillmap.em.observations import HmmClasses

CLASSES = HmmClasses(view_rho=(0.65,)).grid()


def lane(seen, rho, tau, turn, detection, seconds=1.0, at=None):
    """Log likelihood per class of one surfel with observations (time bin, whether it is a hit).

    The sensor is at x = `at` in each time bin and looks along x.
    """
    offset = np.array([0, 3])  # shorter runs without a return would be skipped
    yes, no = np.ones(3, bool), np.zeros(3, bool)

    def beams(x, end):
        T = np.eye(3)[None].copy()
        T[0, :2, 2] = x, 0.05
        return np.array([[end - x, 0]] * 3, np.float32), T

    ends, T = beams(0.0, 1.05)
    surface = fit_surfels(_core, "SurfelMap2D", 0.1, ends, yes, offset, T)
    model = {"rho": rho, "tau": tau, "view_angle": turn, "p_detection": detection}
    lengths = {"lateral_std": 0.01, "margin": 0.1, "hit_radius": 0.05, "end_margin": 0.3}
    hmm = _core.OccupancyHmm2D(surface, bin_seconds=seconds, **model, **lengths)
    for (n, hit), x in zip(seen, [0.0] * len(seen) if at is None else at, strict=True):
        points, T = beams(x, 1.05 if hit else 4)
        hmm.add(points, yes if hit else no, offset, T, np.array([n]))
    return np.array([hmm.likelihood(one)[1][0] for one in np.eye(len(rho), dtype=bool)])


def stays_for_half_a_cell(at):
    """Robot positions, constant while it moves less than a step."""
    out = list(at[:1])
    for x in at[1:]:
        out.append(x if abs(x - out[-1]) >= 0.05 else out[-1])
    return out


def chain(seen, rho, tau, turn, detection, seconds=1.0, at=None):
    at = stays_for_half_a_cell([0.0] * len(seen) if at is None else at)
    turned = [0.0, *(abs(b - a) / max(abs(1.05 - b), 0.1) for a, b in pairwise(at))]
    observations = [
        (n * seconds, HIT if hit else 1.0, v) for (n, hit), v in zip(seen, turned, strict=True)
    ]
    return np.array(
        [
            chain_log_likelihood(observations, r, t, detection, v) - log(r * detection)
            for r, t, v in zip(rho, tau, turn, strict=True)
        ]
    )


def random_looks(seed, n, stays):
    """Runs of hits and misses; mostly gaps of one time bin, some very long."""
    rng = np.random.default_rng(seed)
    hit = np.logical_xor.accumulate(rng.random(n) > stays)
    gaps = np.where(rng.random(n) < 0.9, 1, rng.choice([2, 5, 63, 64, 65, 300, 10**6], n))
    return list(zip(np.cumsum(gaps).tolist(), hit.tolist(), strict=True))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("n", "stays"), [(1, 0.5), (12, 0.5), (60, 0.8), (300, 0.97)])
@pytest.mark.parametrize("seconds", [1.0, 0.2])
def test_a_chain(seed, n, stays, seconds):
    seen = random_looks(seed, n, stays)
    found = lane(seen, *CLASSES, 0.97, seconds)
    expected = chain(seen, *CLASSES, 0.97, seconds)
    over_time = np.isinf(CLASSES[2])  # as exact as the best class, however unlikely
    np.testing.assert_allclose(found[over_time], expected[over_time], rtol=1e-5, atol=0.1)
    likely = expected > expected.max() - 20  # further down it only has to stay there
    np.testing.assert_allclose(found[likely], expected[likely], atol=0.1)
    assert (found[~likely] < found.max() - 18).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("step", [0.0, 0.08, 0.3])
def test_chain_over_the_view_angle(seed, step):
    seen = random_looks(seed, 100, 0.8)
    at = np.random.default_rng(seed).uniform(-step, step, len(seen)).cumsum().clip(-3, 0.6)
    found, expected = (f(seen, *CLASSES, 0.97, at=at) for f in (lane, chain))
    likely = expected > expected.max() - 20
    np.testing.assert_allclose(found[likely], expected[likely], atol=0.1)
    views = np.isfinite(CLASSES[2])
    assert views.sum() == 1
    # with an unchanged view the state stays the same
    still = chain(seen, *CLASSES, 0.97)
    assert (still[views] < still.max() - 10).all()
    assert (expected[views] > still[views] + 10).all() == (step > 0.0)
    assert (expected[~views] == still[~views]).all()


def test_very_unlikely_classes():
    """Hundreds of nats below the best class, yet as exact as without the others."""
    seen = random_looks(3, 4000, 0.9)
    turn = CLASSES[2]
    all_of_them = lane(seen, *CLASSES, 0.97)
    poor = np.flatnonzero(np.isinf(turn) & (all_of_them < all_of_them.max() - 200))
    assert len(poor) >= 5
    alone = lane(seen, *(np.array(values)[poor].tolist() for values in CLASSES), 0.97)
    assert np.ptp(alone) > 20
    np.testing.assert_allclose(all_of_them[poor], alone, rtol=1e-9)
    np.testing.assert_allclose(alone, chain(seen, *CLASSES, 0.97)[poor], rtol=1e-4)


@pytest.mark.parametrize("detection", [0.6, 0.8, 0.9, 0.99])
@pytest.mark.parametrize("misses", [3, 6, 20, 200])
def test_many_misses(detection, misses):
    seen = [(0, True), *((1 + i, False) for i in range(misses)), (1 + misses, True)]
    found, expected = lane(seen, *CLASSES, detection), chain(seen, *CLASSES, detection)
    likely = expected > expected.max() - 20
    np.testing.assert_allclose(found[likely], expected[likely], atol=0.1)


def test_chain_by_all_state_sequences():
    # the forward algorithm against the sum over every sequence of empty and occupied
    rng = np.random.default_rng(3)
    for rho, tau, detection in ((0.3, 2.0, 0.9), (0.95, 10.0, 0.6)):
        times = np.cumsum(rng.exponential(2.0, 8))
        seen = [(t, HIT if rng.random() < 0.4 else rng.uniform(), 0.0) for t in times]
        total = 0.0
        for states in product((0, 1), repeat=len(seen)):
            p = (1 - rho, rho)[states[0]]
            for i in range(1, len(seen)):
                kept = np.exp(-(times[i] - times[i - 1]) / tau)
                p *= kept * (states[i] == states[i - 1]) + (1 - kept) * (1 - rho, rho)[states[i]]
            for state, (_, reliability, _) in zip(states, seen, strict=True):
                hit = reliability == HIT
                p *= (float(not hit), detection if hit else 1 - detection * reliability)[state]
            total += p
        assert chain_log_likelihood(seen, rho, tau, detection) == pytest.approx(log(total))
