"""The motion prior p(x_t | u_{t-1}, x_{t-1}) of (9), with and without odometry.

With odometry, a Gaussian whose standard deviation grows with travel and rotation (Thrun et al.,
Probabilistic Robotics, ch. 5). Without, a constant-velocity model with a running variance.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Int64
from stillmap.slam.options import OdometryOptions

MIN_INCREMENT_STD = 0.02, 0.02  # m, rad: of an increment without motion
_TRANSLATION_FLOOR, _ROTATION_FLOOR = MIN_INCREMENT_STD
# odometry that restarts elsewhere leaps: beyond this many m and times the usual step
MIN_LEAP, _LEAP_RATIO = 1.0, 5.0
_FAULT_STDS = 3.0  # of the options, beyond which an increment is at fault
# constant-velocity model: std before any residual is known (m, rad), weight of the last residual
_INITIAL_TRANSLATION, _INITIAL_ROTATION, _FORGETTING = 0.5, 0.5, 0.1
_ACCELERATION, _ANGULAR_ACCELERATION = 2.0, 4.0  # m/s^2, rad/s^2 that may occur between two scans
# odometry noise learned from innovations: weight of the last one, share of the options' std that
# it has at least, Kalman gain from which a direction counts, std beyond which an innovation is cut
# odometry's information is discounted as much as that of the beams: they share their errors
_INFLATION = 2.2
_NOISE_RATE, _MIN_NOISE_SHARE, _MIN_GAIN, _MAX_INNOVATION = 0.05, 0.1, 0.1, 3.0
# s after which a velocity that no scan corrected says nothing any more
_VELOCITY_TIME = 5.0
UNIFORM_ROTATION = math.pi / math.sqrt(3.0)  # rad, std of a heading of which nothing is known
_MAX_UNANNOUNCED = 0.15  # m and rad, upper limit of the motion that these explain


@dataclass(frozen=True)
class MotionPrior:
    """A Gaussian on the next pose.

    Attributes:
        T_map_base: (3, 3) mean.
        information: (3, 3) inverse covariance of x, y (map frame) and heading.
        translation_std: m, the larger standard deviation of x, y.
        rotation_std: rad.
        is_odometry: whether the mean comes from odometry.
    """

    T_map_base: Float
    information: Float
    translation_std: float
    rotation_std: float
    is_odometry: bool = False

    def residual(self, T_map_base: Float) -> Float:
        """(3,) x, y in m and heading in rad from the mean to a pose (3, 3)."""
        d = se2.parameters(T_map_base) - se2.parameters(self.T_map_base)
        d[2] = se2.wrap(d[2])
        return d

    def cost(self, T_map_base: Float) -> float:
        """Negative log density at a pose (3, 3), up to a constant."""
        d = self.residual(T_map_base)
        return 0.5 * float(d @ self.information @ d)


@dataclass(frozen=True, eq=False)
class OdometrySteps:
    """Odometry increments between successive scans.

    Attributes:
        increments: (T - 1, 3, 3).
        plausible: (T - 1,) False where odometry leaps.
    """

    increments: Float
    plausible: Bool


@dataclass(frozen=True)
class VelocityNoise:
    """Running standard deviation of the constant-velocity model's residuals.

    Attributes:
        translation: m, along x and y.
        rotation: rad.
    """

    translation: float = _INITIAL_TRANSLATION
    rotation: float = _INITIAL_ROTATION

    def update(self, d: Float, seconds: float) -> "VelocityNoise":
        """After a residual d (3,) in m, m, rad, with `seconds` between scans."""
        kept, new = 1.0 - _FORGETTING, _FORGETTING
        translation = np.sqrt(kept * self.translation**2 + new * 0.5 * (d[0] ** 2 + d[1] ** 2))
        rotation = np.sqrt(kept * self.rotation**2 + new * d[2] ** 2)
        return VelocityNoise(
            max(float(translation), _unannounced_motion(_ACCELERATION, seconds)),
            max(float(rotation), _unannounced_motion(_ANGULAR_ACCELERATION, seconds)),
        )


@dataclass(frozen=True)
class OdometryNoise:
    """Standard deviation of odometry increments, learned from scan matching.

    A running estimate from the innovations, the differences between odometry and what the scans
    alone say, which are those of the posterior divided by the Kalman gain. Directions count by
    their gain: along a bare wall nothing is learned.

    Attributes:
        translation, rotation: standard deviations as shares of those of the options.
    """

    translation: float = 1.0
    rotation: float = 1.0

    def inflated_shares(self) -> tuple[float, float]:
        """The shares that priors have, of translation and rotation."""
        translation, rotation = _INFLATION * self.translation, _INFLATION * self.rotation
        return min(translation, 1.0), min(rotation, 1.0)

    def update(self, prior: MotionPrior, T_map_base: Float, covariance: Float) -> "OdometryNoise":
        """After a scan with that prior and posterior: pose (3, 3), covariance (3, 3)."""
        # of the translation without what the error of the heading adds to it, and of the heading
        whiten = np.linalg.cholesky(prior.information).T
        left, vectors = np.linalg.eigh(whiten @ covariance @ whiten.T)  # 1 - gain
        gain = (1.0 - left).clip(0.0)
        residual = vectors.T @ (whiten @ prior.residual(T_map_base))
        innovation = np.abs(residual / gain.clip(_MIN_GAIN)).clip(max=_MAX_INNOVATION)
        excess = (vectors**2 * gain) @ (np.square(_INFLATION * innovation) - 1.0)
        return OdometryNoise(
            _learn_share(self.translation, 0.5 * float(excess[0] + excess[1])),
            _learn_share(self.rotation, float(excess[2])),
        )


def blind_drift(prior: MotionPrior, covariance: Float) -> Float:
    """Covariance (3, 3) that a step adds to the pose in the map, x, y (map axes) and heading.

    The noise of the step times the square of the Kalman filter's 1 - gain: all of it where the scan
    says nothing, almost none where it fixes the pose.

    Args:
        prior: of the step.
        covariance: (3, 3) of the posterior.
    """
    out: Float = covariance @ prior.information @ covariance
    return out / _INFLATION**2 if prior.is_odometry else out


def unmeasured_variance(prior: MotionPrior, covariance: Float, seconds: float) -> float:
    """Variance in m^2 that a step adds to the length of the way, in its least known direction.

    The variance of the step times r^2, r the share of an error that the scan leaves (1 - gain of a
    Kalman filter). Without odometry the steps after it inherit what is left, in all
    r / (1 - lambda r), with lambda = exp(-seconds / _VELOCITY_TIME).

    Args:
        prior: of the step.
        covariance: (3, 3) of the posterior.
        seconds: of the step.
    """
    (xx, xy), (_, yy) = covariance[:2, :2].tolist()
    least_known = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)  # the larger eigenvalue
    r = min(least_known / prior.translation_std**2, 1.0)
    if not prior.is_odometry:
        r /= 1.0 - math.exp(-max(seconds, 1e-3) / _VELOCITY_TIME) * r
    return float((prior.translation_std * r) ** 2)


def fit_odometry_noise(
    increments: Float, motion: Float, options: OdometryOptions
) -> tuple[OdometryNoise, Bool]:
    """Noise of odometry increments (T, 3, 3) about a motion (T, 3, 3), and which are at fault.

    From medians of the residuals, on which faults have no influence.
    """
    d = se2.parameters(se2.inverse(increments) @ motion)
    x = se2.parameters(increments)
    std = odometry_std(np.hypot(x[:, 0], x[:, 1]), np.abs(x[:, 2]), options)
    translation, rotation = np.hypot(d[:, 0], d[:, 1]) / std[0], np.abs(d[:, 2]) / std[1]
    is_fault = np.maximum(translation, rotation) > _FAULT_STDS
    if len(d) == 0:
        return OdometryNoise(), is_fault
    # medians of a Rayleigh and of a half-normal distribution of unit scale: 1.18 and 0.67
    shares = float(np.median(translation)) / 1.18, float(np.median(rotation)) / 0.67
    noise = OdometryNoise(*(min(max(share, _MIN_NOISE_SHARE), 1.0) for share in shares))
    return noise, is_fault


def _learn_share(share: float, excess: float) -> float:
    share *= float(np.sqrt(1.0 + _NOISE_RATE * excess))
    return min(max(share, _MIN_NOISE_SHARE), 1.0)


def _unannounced_motion(acceleration: float, seconds: float) -> float:
    return min(max(0.5 * acceleration * seconds**2, _TRANSLATION_FLOOR), _MAX_UNANNOUNCED)


def onward_std(stamp_ns: Int64) -> Float:
    """(T - 1, 2) m and rad, standard deviations of steps at constant velocity at stamps (T,)."""
    squared = np.square(1e-9 * np.diff(stamp_ns))[:, None]
    std = 0.5 * squared * [_ACCELERATION, _ANGULAR_ACCELERATION]
    out: Float = std.clip(MIN_INCREMENT_STD, [_INITIAL_TRANSLATION, _INITIAL_ROTATION])
    return out


def compute_odometry_steps(T_odom_base: Float, stamp_ns: Int64) -> OdometrySteps:
    """The steps between poses (T, 3, 3) with stamps (T,); a leap is too fast for the robot."""
    increments = se2.increments(T_odom_base)
    metres = np.linalg.norm(increments[:, :2, 2], axis=1)
    if not len(metres):
        return OdometrySteps(increments, np.ones(0, np.bool_))
    seconds = 1e-9 * np.diff(stamp_ns)
    seconds = np.maximum(seconds, max(float(np.median(seconds)), 1e-9))
    usual = float(np.quantile(metres / seconds, 0.95))
    limit = np.maximum(MIN_LEAP, _LEAP_RATIO * usual * seconds)
    return OdometrySteps(increments, metres <= limit)


def odometry_std(distance: Any, turn: Any, options: OdometryOptions) -> tuple[Any, Any]:
    """Standard deviations in m and rad of increments of `distance` m and `turn` rad.

    Errors of successive metres and radians are independent: over n they grow with the root of n.
    """
    distance, turn = (np.minimum(value, np.sqrt(value)) for value in (distance, turn))
    translation = (
        _TRANSLATION_FLOOR
        + options.translation_per_metre * distance
        + options.translation_per_radian * turn
    )
    rotation = (
        _ROTATION_FLOOR + options.rotation_per_metre * distance + options.rotation_per_radian * turn
    )
    return translation, rotation


def increment_std(
    increments: Float, options: OdometryOptions, noise: OdometryNoise = OdometryNoise()
) -> Float:
    """(T, 2) m and rad, standard deviations of odometry increments (T, 3, 3)."""
    x = se2.parameters(increments)
    std = odometry_std(np.hypot(x[:, 0], x[:, 1]), np.abs(x[:, 2]), options)
    shares = noise.inflated_shares()
    return np.stack([one * share for one, share in zip(std, shares, strict=True)], axis=1)


def odometry_prior(
    T_map_base: Float,
    increment: Float,
    options: OdometryOptions,
    noise: OdometryNoise = OdometryNoise(),
) -> MotionPrior:
    """The prior after an odometry increment (3, 3) from a pose (3, 3)."""
    x, y, theta = se2.parameters(increment).tolist()
    metres = math.hypot(x, y)
    std = odometry_std(metres, abs(theta), options)
    translation, rotation = (
        float(one * share) for one, share in zip(std, noise.inflated_shares(), strict=True)
    )
    rotation = min(rotation, UNIFORM_ROTATION)
    mean = se2.normalize(T_map_base @ increment)
    # the heading errs as a random walk along the way, which leads the robot aside
    across = np.array([T_map_base[1, 2] - mean[1, 2], mean[0, 2] - T_map_base[0, 2]])
    covariance = np.diag([translation**2, translation**2, rotation**2])
    covariance[:2, :2] += rotation**2 / 3.0 * np.outer(across, across)
    covariance[:2, 2] = covariance[2, :2] = 0.5 * rotation**2 * across
    translation = math.hypot(translation, metres * rotation / math.sqrt(3.0))
    return MotionPrior(mean, np.linalg.inv(covariance), translation, rotation, is_odometry=True)


def constant_velocity_prior(
    T_map_base: Float, T_before: Float, noise: VelocityNoise
) -> MotionPrior:
    """The prior without odometry: the motion from T_before (3, 3) to T_map_base once more."""
    # not by BLAS, whose rounding depends on the processor: along a featureless corridor the poses
    # follow from these predictions alone
    increment = np.einsum("ij,jk->ik", se2.inverse(T_before), T_map_base)
    mean = np.einsum("ij,jk->ik", T_map_base, increment)
    return gaussian_prior(mean, noise.translation, noise.rotation)


def widen_prior(prior: MotionPrior, translation_std: float, rotation_std: float) -> MotionPrior:
    """The same mean with standard deviations of at least these."""
    return gaussian_prior(
        prior.T_map_base,
        max(prior.translation_std, translation_std),
        max(prior.rotation_std, rotation_std),
    )


def gaussian_prior(
    mean: Float, translation_std: float, rotation_std: float, *, is_odometry: bool = False
) -> MotionPrior:
    """An isotropic prior about a pose (3, 3)."""
    information = np.diag([translation_std**-2, translation_std**-2, rotation_std**-2])
    return MotionPrior(se2.normalize(mean), information, translation_std, rotation_std, is_odometry)
