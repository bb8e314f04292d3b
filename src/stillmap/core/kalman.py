"""Kalman filters of many things that go on as they went: both axes alike, and all at once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrackStates:
    """Where K things are, and how fast.

    Attributes:
        x: (K, 2) metres.
        v: (K, 2) metres per second.
        P: (K, 3) covariance on either axis: of place, of place with speed, of speed.
    """

    x: Float
    v: Float
    P: Float

    def __len__(self) -> int:
        return len(self.x)

    @property
    def position_std(self) -> Float:
        """(K,) standard deviation of the place on either axis, metres."""
        return np.asarray(np.sqrt(self.P[:, 0]))

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "TrackStates":
        """Some of them."""
        return TrackStates(self.x[chosen], self.v[chosen], self.P[chosen])


def initialize(x: Float, position_std: float, speed_std: float) -> TrackStates:
    """Things at (K, 2) of which nothing is known but that; metres, and metres per second."""
    return TrackStates(
        x, np.zeros_like(x), np.tile([position_std**2, 0.0, speed_std**2], (len(x), 1))
    )


def concatenate(a: TrackStates, b: TrackStates) -> TrackStates:
    """The things of both."""
    return TrackStates(*(np.concatenate([p, q]) for p, q in ((a.x, b.x), (a.v, b.v), (a.P, b.P))))


def predict(motion: TrackStates, dt: float, acceleration: float) -> TrackStates:
    """After so many seconds; back in time where they are negative.

    Args:
        motion: now.
        dt: seconds.
        acceleration: m2/s3, density of white acceleration.
    """
    xx, xv, vv = motion.P.T
    q, t = acceleration, abs(dt)
    P = np.stack(
        [
            xx + 2.0 * dt * xv + dt**2 * vv + q * t**3 / 3.0,
            xv + dt * vv + q * dt * t / 2.0,
            vv + q * t,
        ],
        axis=-1,
    )
    return TrackStates(motion.x + motion.v * dt, motion.v, P)


def update(
    motion: TrackStates, is_observed: NDArray[np.bool_], positions: Float, position_std: float
) -> TrackStates:
    """After some things were seen.

    Args:
        motion: as predicted.
        seen: (K,) which.
        at: (K, 2) where; not looked at where a thing was not seen.
        sigma: metres, of that.
    """
    xx, xv, vv = motion.P.T
    innovation = np.where(is_observed, xx + position_std**2, np.inf)
    gain_x, gain_v = xx / innovation, xv / innovation
    residual = np.where(is_observed[:, None], positions - motion.x, 0.0)
    P = np.stack([xx * (1.0 - gain_x), xv * (1.0 - gain_x), vv - gain_v * xv], axis=-1)
    x, v = motion.x + gain_x[:, None] * residual, motion.v + gain_v[:, None] * residual
    return TrackStates(x, v, P)
