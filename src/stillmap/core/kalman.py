"""Constant-velocity Kalman filters, vectorized over K tracks; all D axes share P."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float

SPEED_STD = 1.0  # m/s, of a new track: people walk


@dataclass(frozen=True, eq=False)
class TrackStates:
    """States of K tracks.

    Attributes:
        x: (K, D) positions, m.
        v: (K, D) velocities, m/s.
        P: (K, 3) covariance per axis: position, position-velocity, velocity.
    """

    x: Float
    v: Float
    P: Float

    def __len__(self) -> int:
        return len(self.x)

    @property
    def position_std(self) -> Float:
        """(K,) standard deviation of the position per axis, m."""
        return np.asarray(np.sqrt(self.P[:, 0]))

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "TrackStates":
        """The states of a subset of tracks."""
        return TrackStates(self.x[chosen], self.v[chosen], self.P[chosen])


def initialize(x: Float, position_std: float, speed_std: float = SPEED_STD) -> TrackStates:
    """States at positions x (K, D) with zero velocity; standard deviations in m and m/s."""
    P = np.tile([position_std**2, 0.0, speed_std**2], (len(x), 1))
    return TrackStates(x, np.zeros_like(x), P)


def concatenate(a: TrackStates, b: TrackStates) -> TrackStates:
    """Concatenate two sets of tracks."""
    return TrackStates(*(np.concatenate([p, q]) for p, q in ((a.x, b.x), (a.v, b.v), (a.P, b.P))))


def predict(states: TrackStates, dt: float | Float, acceleration: float) -> TrackStates:
    """Predict the states after dt.

    Args:
        states: current states.
        dt: s, of all or (K,) of each; negative: backwards in time.
        acceleration: spectral density of white acceleration noise, m2/s3.
    """
    xx, xv, vv = states.P.T
    q, t = acceleration, np.abs(dt)
    P = np.stack(
        [
            xx + 2.0 * dt * xv + dt**2 * vv + q * t**3 / 3.0,
            xv + dt * vv + q * dt * t / 2.0,
            vv + q * t,
        ],
        axis=-1,
    )
    return TrackStates(states.x + states.v * np.expand_dims(dt, -1), states.v, P)


def update(
    states: TrackStates, is_observed: NDArray[np.bool_], positions: Float, position_std: float
) -> TrackStates:
    """Update the states with position measurements.

    Args:
        states: predicted states.
        is_observed: (K,) mask of the tracks with a measurement.
        positions: (K, D) measured positions, m; ignored where not observed.
        position_std: standard deviation of a measured position, m.
    """
    xx, xv, vv = states.P.T
    innovation = np.where(is_observed, xx + position_std**2, np.inf)
    gain_x, gain_v = xx / innovation, xv / innovation
    residual = np.where(is_observed[:, None], positions - states.x, 0.0)
    P = np.stack([xx * (1.0 - gain_x), xv * (1.0 - gain_x), vv - gain_v * xv], axis=-1)
    x, v = states.x + gain_x[:, None] * residual, states.v + gain_v[:, None] * residual
    return TrackStates(x, v, P)
