"""Probabilistic data association, against numbers worked by hand and against one Kalman filter."""

import numpy as np
import pytest

from stillmap.core import kalman
from stillmap.core.kalman import TrackStates
from stillmap.em import people_tracker as tracker


# S = 0.03 + 0.1^2 = 0.04: one standard deviation of an innovation is 0.2 m, the gate 0.6 m
@pytest.fixture(autouse=True)
def wide_gate(monkeypatch):
    monkeypatch.setattr(tracker, "_GATE", 3.0)


NONE = 0.05 * (1 - 0.9 * (1 - np.exp(-4.5)))  # 0.0055
PEAK = 0.9 / (2 * np.pi * 0.04)  # 3.581 per m2


def tracks(*x, P=(0.03, 0.02, 0.5)):
    x = np.array(x, float).reshape(-1, 2)
    return TrackStates(x, np.tile([1.0, 0.0], (len(x), 1)), np.tile(np.array(P), (len(x), 1)))


def at(*xy):
    return np.array(xy, float).reshape(-1, 2)


def test_one_detection():
    beta = tracker.association_probabilities(tracks((0, 0)), at((0.2, 0)))
    G = PEAK * np.exp(-0.5)
    assert beta == pytest.approx(np.array([[G / (G + NONE)]]))
    assert beta[0, 0] == pytest.approx(0.9975, abs=1e-4)


def test_two_detections_and_none():
    beta = tracker.association_probabilities(tracks((0, 0)), at((0.2, 0), (0, -0.4), (0.61, 0)))
    G = PEAK * np.exp([-0.5, -2.0])
    assert beta[0, :2] == pytest.approx(G / (G.sum() + NONE))
    assert beta[0, 2] == 0.0  # outside the gate
    assert tracker.gate(tracks((0, 0)), at((0.59, 0), (0.61, 0))).tolist() == [[True, False]]


def test_a_detection_between_two_tracks_is_shared():
    two = tracker.association_probabilities(tracks((0, 0), (0.4, 0)), at((0.2, 0)))
    G = PEAK * np.exp(-0.5)
    assert two[:, 0] == pytest.approx(G / (2 * G + NONE))
    # the one beside which a second feature stands needs the first one less
    own = tracker.association_probabilities(tracks((0, 0), (0.4, 0)), at((0.2, 0), (0.65, 0)))
    assert own[0, 0] == pytest.approx(G / (2 * G + NONE))
    assert own[1, 0] < own[0, 0]
    assert own.sum(axis=1).max() < 1.0


def test_one_certain_detection_is_a_kalman_update():
    motion = tracks((0, 0), (5, 5))
    seen, where = np.array([True, True]), at((0.2, 0.1), (5.1, 4.9))
    theirs = kalman.update(motion, seen, where, 0.1)
    ours = tracker.update_pda(motion, where, np.eye(2))
    for name in ("x", "v", "P"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-12)


def test_without_detections_the_prediction_stays():
    motion = tracks((0, 0), (5, 5))
    for where in (at(), at((9, 9))):
        after = tracker.update_pda(motion, where, tracker.association_probabilities(motion, where))
        for name in ("x", "v", "P"):
            np.testing.assert_array_equal(getattr(after, name), getattr(motion, name))


def test_mean_innovation_and_its_spread():
    # two features 0.2 m to either side, each with 0.4, none with 0.2; gains 0.75 and 0.5
    motion = tracks((0, 0))
    after = tracker.update_pda(motion, at((0.2, 0), (-0.2, 0)), np.array([[0.4, 0.4]]))
    np.testing.assert_allclose(after.x, [(0, 0)], atol=1e-15)
    np.testing.assert_allclose(after.v, [(1, 0)], atol=1e-15)
    # per axis: 0.8 S = 0.032 known, of that 0.5 (0.4 + 0.4) 0.2^2 = 0.016 is spread
    less = 0.032 - 0.016
    expected = [0.03 - 0.75**2 * less, 0.02 - 0.75 * 0.5 * less, 0.5 - 0.5**2 * less]
    np.testing.assert_allclose(after.P, [expected])
    one_side = tracker.update_pda(motion, at((0.2, 0), (-0.2, 0)), np.array([[0.6, 0.2]]))
    np.testing.assert_allclose(one_side.x, [(0.75 * 0.08, 0)])
    np.testing.assert_allclose(one_side.v, [(1 + 0.5 * 0.08, 0)])
    assert one_side.P[0, 0] < after.P[0, 0]


def test_no_tracks():
    none = tracks()
    assert tracker.association_probabilities(none, at((1, 1))).shape == (0, 1)
    assert len(tracker.update_pda(none, at((1, 1)), np.zeros((0, 1)))) == 0


def test_gate_and_clutter(monkeypatch):
    monkeypatch.setattr(tracker, "_GATE", 4.0)
    assert tracker.association_probabilities(tracks((0, 0)), at((0.7, 0)))[0, 0] > 0
    beta = []
    for clutter in (0.01, 1.0, 100.0):
        monkeypatch.setattr(tracker, "_CLUTTER", clutter)
        beta.append(tracker.association_probabilities(tracks((0, 0)), at((0.4, 0)))[0, 0])
    assert beta[0] > beta[1] > beta[2]
    assert beta[2] < 0.1
