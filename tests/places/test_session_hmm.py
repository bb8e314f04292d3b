"""The chain over sessions against sums over all histories."""

import itertools

import numpy as np
import pytest

from stillmap.places import place_states
from stillmap.places.place_states import estimate_states, fit_weights, weigh_evidence

SWITCH = place_states._SWITCH


def brute_force(evidence, weights):
    """P(static), P(changing), and P(occupied) per session of one cell, and its likeliest path."""
    S = len(evidence)
    histories = {}
    for path in itertools.product([False, True], repeat=S):
        switches = sum(a != b for a, b in itertools.pairwise(path))
        if not switches:  # static, or free
            continue
        prior = 0.5 * SWITCH**switches * (1 - SWITCH) ** (S - 1 - switches)
        histories[path] = prior * np.exp(
            sum(e for e, there in zip(evidence, path, strict=True) if there)
        )
    static, free, total = np.exp(sum(evidence)), 1.0, sum(histories.values())
    changing = total / (1 - (1 - SWITCH) ** (S - 1))
    joint = np.array([static, free, changing]) * weights
    posterior = joint / joint.sum()
    in_chain = [sum(v for p, v in histories.items() if p[s]) / total for s in range(S)]
    occupied = posterior[0] + posterior[2] * np.array(in_chain)
    return posterior[0], posterior[2], occupied


@pytest.mark.parametrize("S", [2, 3, 5])
def test_states_are_those_of_all_histories_together(S):
    rng = np.random.default_rng(S)
    evidence = rng.normal(0.0, 3.0, (40, S))
    weights = np.array([0.7, 0.2, 0.1])
    found = estimate_states(evidence, weights)
    for k, row in enumerate(evidence):
        static, changing, occupied = brute_force(row, weights)
        np.testing.assert_allclose(found.p_static[k], static, rtol=1e-9)
        np.testing.assert_allclose(found.p_changing[k], changing, rtol=1e-9)
        np.testing.assert_allclose(found.p_occupied[k], occupied, rtol=1e-9)


def test_the_path_is_the_most_probable_history():
    rng = np.random.default_rng(3)
    evidence = rng.normal(0.0, 3.0, (60, 4))
    found = estimate_states(evidence, np.array([0.7, 0.2, 0.1]))

    def log_probability(path, row):
        switches = sum(a != b for a, b in itertools.pairwise(path))
        prior = switches * np.log(SWITCH) + (3 - switches) * np.log(1 - SWITCH)
        return prior + sum(e for e, there in zip(row, path, strict=True) if there)

    for row, path in zip(evidence, found.path.tolist(), strict=True):
        best = max(
            itertools.product([False, True], repeat=4), key=lambda p: log_probability(p, row)
        )
        assert tuple(path) == best


def test_sessions_that_saw_nothing_say_nothing():
    weights = np.array([0.7, 0.2, 0.1])
    seen = estimate_states(np.array([[5.0, -5.0]]), weights)
    more = estimate_states(np.array([[5.0, 0.0, -5.0]]), weights)
    assert not more.observed[0, 1]
    assert abs(more.p_static - seen.p_static) < 0.02
    assert 0.2 < more.p_occupied[0, 1] < 0.8


def test_weights_are_the_shares_of_the_classes():
    rng = np.random.default_rng(0)
    static, free, changing = np.full((600, 4), 6.0), np.full((250, 4), -6.0), np.full((150, 4), 6.0)
    changing[:, 2:] = -6.0
    evidence = np.concatenate([static, free, changing])
    weights = fit_weights(evidence + rng.normal(size=evidence.shape))
    np.testing.assert_allclose(weights, [0.6, 0.25, 0.15], atol=0.03)


def test_neighbours_of_one_history_decide_together():
    # each alone is more probably static surface that was missed; twelve of them are not
    row = np.array([6.0, 6.0, -3.5])
    weights = np.array([0.95, 0.02, 0.03])
    evidence = np.tile(row, (12, 1))
    pairs = np.array(list(itertools.combinations(range(12), 2)))
    alone, together = estimate_states(evidence, weights), estimate_states(evidence, weights, pairs)
    assert (alone.p_changing < 0.5).all()
    assert (together.p_changing > 0.7).all()
    # but not with neighbours of another history
    mixed = np.concatenate([evidence[:1], np.full((11, 3), 6.0)])
    apart = estimate_states(mixed, weights, pairs)
    np.testing.assert_allclose(apart.p_changing[0], alone.p_changing[0])


def test_evidence_grows_with_hits_and_passes_to_a_limit():
    hits = np.array([0, 1, 3, 60, 0, 0, 60], np.float32)
    passes = np.array([0, 0, 0, 0, 1, 60, 20], np.float32)
    nats = weigh_evidence(hits, passes, hits / np.maximum(hits + passes, 1.0))
    assert nats[0] == 0.0
    assert 0.0 < nats[1] < nats[2] < nats[3]
    assert nats[5] < nats[4] < 0.0
    assert nats[6] == nats[3]  # beams graze the cells beside a surface


def test_who_paused_in_a_session_leaves_no_surface():
    # twelve beams ended on somebody, and forty went through before and after
    one = np.array([12.0], np.float32), np.array([40.0], np.float32)
    paused = weigh_evidence(*one, np.array([12.0 / 52.0], np.float32))
    stood = weigh_evidence(*one, np.array([0.9], np.float32))
    assert paused[0] < 0.0 < stood[0]
