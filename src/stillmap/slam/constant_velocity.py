"""Constant-velocity model in 3D, corrected by odometry where there is some.

State: pose of the base and its twist (velocity, angular velocity) in the base frame. Errors are
d = (pose, twist), T Exp(d_pose), in the base frame.
"""

from dataclasses import dataclass

import numpy as np

from stillmap.core import se2, se3
from stillmap.core.array_types import Float
from stillmap.slam import motion_model
from stillmap.slam.options import OdometryOptions

# s between two sweeps; less counts as the first, more as the second: whoever has not been seen for
# so long may have done anything, and most likely stands near
MIN_STEP, _MAX_STEP = 1e-3, 10.0
_INITIAL_POSE_STD = 1e-4  # m and rad; the first pose defines the map frame
_MAX_ODOMETRY_CHI2 = 25.0  # 6 degrees of freedom; exceeded once in three thousand steps
_ACCELERATION, _ANGULAR_ACCELERATION = 3.0, 3.0  # std, m/s^2 and rad/s^2


@dataclass(frozen=True, eq=False)
class State:
    """Pose and motion of the robot.

    Attributes:
        T_map_base: (4, 4).
        twist: (6,) m/s and rad/s in the base frame.
        covariance: (12, 12) of pose and twist.
    """

    T_map_base: Float
    twist: Float
    covariance: Float


def initial_state(twist: Float, speed_std: float, turn_rate_std: float) -> State:
    """The state at the origin with a twist (6,) known to m/s and rad/s."""
    std = np.array([_INITIAL_POSE_STD] * 6 + [speed_std] * 3 + [turn_rate_std] * 3)
    return State(np.eye(4), twist, np.diag(std**2))


def predict(state: State, seconds: float) -> State:
    """The state that many seconds later.

    White acceleration a (std of the change of the twist per second within one step) adds the
    covariance q dt^3/3, q dt^2/2, q dt with q = a^2 dt (Barfoot, State Estimation for Robotics,
    Sect. 11.1); the adjoint transforms the error of the pose into the new frame.
    """
    dt = float(np.clip(seconds, MIN_STEP, _MAX_STEP))
    step = se3.exp(dt * state.twist)
    F = np.eye(12)
    F[:6, :6] = se3.adjoint(se2.inverse(step))
    F[:6, 6:] = dt * np.eye(6)
    a2 = np.diag(np.square([_ACCELERATION] * 3 + [_ANGULAR_ACCELERATION] * 3))
    Q = np.block([[a2 * dt**4 / 3, a2 * dt**3 / 2], [a2 * dt**3 / 2, a2 * dt**2]])
    P = F @ state.covariance @ F.T + Q
    return State(se3.normalize(state.T_map_base @ step), state.twist, P)


def update_with_odometry(
    state: State, increment: Float, seconds: float, options: OdometryOptions
) -> State:
    """Gated Kalman update of the twist before a step.

    Args:
        state: before the step.
        increment: (4, 4) odometry until the next sweep.
        seconds: duration of the step.
        options: noise of odometry.
    """
    dt = float(np.clip(seconds, MIN_STEP, _MAX_STEP))
    moved = se3.log(increment)
    std = motion_model.odometry_std(
        float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:])), options
    )
    R = np.diag(np.square(np.repeat(std, 3) / dt))
    P = state.covariance
    S = P[6:, 6:] + R
    innovation = moved / dt - state.twist
    if innovation @ np.linalg.solve(S, innovation) > _MAX_ODOMETRY_CHI2:
        return state
    K = np.linalg.solve(S, P[6:]).T
    d = K @ innovation
    T = se3.normalize(state.T_map_base @ se3.exp(d[:6]))
    return State(T, state.twist + d[6:], P - K @ P[6:])
