"""Motion in space from sweep to sweep: nearly steady, as odometry says where there is some.

The state is the pose of the base and its twist (velocity, rate of turn in its own frame); errors
are d = (pose, twist), T Exp(d_pose), in the frame of the base.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2, se3
from stillmap.slam import motion_model
from stillmap.slam.motion_model import MotionOptions

Float = NDArray[np.float64]

_LEAST = 1e-3  # seconds between two sweeps: less is the same instant
_HELD = 1e-4  # m and rad, standard deviation of the first pose, which is the map's
_GATE = 25.0  # chi-square of 6 degrees at which odometry is disbelieved: one in three thousand


@dataclass(frozen=True, eq=False)
class State:
    """Where a robot is and how it moves.

    Attributes:
        T_map_base: (4, 4).
        twist: (6,) m/s and rad/s in the frame of the base.
        covariance: (12, 12) of both, see above.
    """

    T_map_base: Float
    twist: Float
    covariance: Float


def initial_state(twist: Float, speed: float, turn: float) -> State:
    """The first pose is the origin; its twist (6,) is known to m/s and rad/s."""
    sigma = np.array([_HELD] * 6 + [speed] * 3 + [turn] * 3)
    return State(np.eye(4), twist, np.diag(sigma**2))


def predict(state: State, seconds: float, acceleration: float, turn: float) -> State:
    """The state that many seconds later, if nothing but noise accelerates it.

    White acceleration (m/s^2, rad/s^2: how much the twist changes in one step, per second) makes
    covariance q dt^3/3, q dt^2/2, q dt with q = a^2 dt (Barfoot, State Estimation for Robotics,
    Sect. 11.1); the error of the pose is carried into the new frame by the adjoint.
    """
    dt = max(seconds, _LEAST)
    step = se3.exp(dt * state.twist)
    F = np.eye(12)
    F[:6, :6] = se3.adjoint(se2.inverse(step))
    F[:6, 6:] = dt * np.eye(6)
    a2 = np.diag(np.square([acceleration] * 3 + [turn] * 3))
    Q = np.block([[a2 * dt**4 / 3, a2 * dt**3 / 2], [a2 * dt**3 / 2, a2 * dt**2]])
    P = F @ state.covariance @ F.T + Q
    return State(se3.normalize(state.T_map_base @ step), state.twist, P)


def update_with_odometry(
    state: State, increment: Float, seconds: float, options: MotionOptions
) -> State:
    """What odometry makes of the twist before a step: a Kalman update, gated.

    Args:
        state: before the step.
        increment: (4, 4) motion until the next sweep, as odometry has it.
        seconds: it took.
        options: how sure odometry is.
    """
    dt = max(seconds, _LEAST)
    moved = se3.log(increment)
    sigmas = motion_model.odometry_std(
        float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:])), options
    )
    R = np.diag(np.square(np.repeat(sigmas, 3) / dt))
    P = state.covariance
    S = P[6:, 6:] + R
    innovation = moved / dt - state.twist
    if innovation @ np.linalg.solve(S, innovation) > _GATE:
        return state
    K = np.linalg.solve(S, P[6:]).T
    d = K @ innovation
    T = se3.normalize(state.T_map_base @ se3.exp(d[:6]))
    return State(T, state.twist + d[6:], P - K @ P[6:])
