"""Filters of many things at once, against one with whole matrices."""

import numpy as np
import pytest

from stillmap.core import kalman


def whole(motion, k):
    """State (4,) x, y, vx, vy and covariance (4, 4) of one thing."""
    xx, xv, vv = motion.P[k]
    eye = np.eye(2)
    P = np.block([[xx * eye, xv * eye], [xv * eye, vv * eye]])
    return np.concatenate([motion.x[k], motion.v[k]]), P


def some(rng, K=4):
    x = rng.normal(size=(K, 2))
    motion = kalman.initialize(x, 0.2, 1.5)
    motion = kalman.predict(motion, 0.3, 0.7)  # place and speed depend on one another
    return kalman.update(motion, np.ones(K, bool), x + rng.normal(0, 0.3, x.shape), 0.1)


@pytest.mark.parametrize("dt", [0.0, 0.2, 3.0, -0.5])
def test_prediction(dt):
    motion = some(np.random.default_rng(0))
    found, q, t = kalman.predict(motion, dt, 0.7), 0.7, abs(dt)
    eye = np.eye(2)
    F = np.block([[eye, dt * eye], [0 * eye, eye]])
    Q = q * np.block([[t**3 / 3 * eye, dt * t / 2 * eye], [dt * t / 2 * eye, t * eye]])
    for k in range(len(motion)):
        state, P = whole(motion, k)
        ours, ours_P = whole(found, k)
        np.testing.assert_allclose(ours, F @ state, atol=1e-12)
        np.testing.assert_allclose(ours_P, F @ P @ F.T + Q, atol=1e-12)


def test_update():
    rng = np.random.default_rng(1)
    motion = some(rng)
    at, seen = rng.normal(size=(4, 2)), np.array([True, False, True, True])
    found = kalman.update(motion, seen, at, 0.12)
    H, R = np.eye(2, 4), 0.12**2 * np.eye(2)
    for k in range(4):
        state, P = whole(motion, k)
        if seen[k]:
            gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            state, P = state + gain @ (at[k] - H @ state), P - gain @ H @ P
        ours, ours_P = whole(found, k)
        np.testing.assert_allclose(ours, state, atol=1e-12)
        np.testing.assert_allclose(ours_P, P, atol=1e-12)
