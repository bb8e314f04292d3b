"""The motion prior p(x_t | u_{t-1}, x_{t-1}) of (9): where odometry says the robot went."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.config import option

Float = NDArray[np.float64]

_LEAST_LEAP, _FARTHER = 1.0, 5.0  # m, and times the usual step: what is farther is no step
_PER_MOTION = ("_per_metre", "_per_radian")  # these may be zero, floors may not


@dataclass(frozen=True)
class MotionOptions:
    """Standard deviations of one odometry increment."""

    translation_floor: float = option(0.02, "m, error of an increment without motion")
    translation_per_metre: float = option(0.07, "m of error per metre travelled")
    translation_per_radian: float = option(0.05, "m of error per radian turned")
    rotation_floor: float = option(0.02, "rad, error of an increment without motion")
    rotation_per_metre: float = option(0.1, "rad of error per metre travelled")
    rotation_per_radian: float = option(0.3, "rad of error per radian turned")
    without_odometry_translation: float = option(
        0.5, "m, error of a guess without odometry, before anything was learned of it"
    )
    without_odometry_rotation: float = option(
        0.5, "rad, error of a guess without odometry, before anything was learned of it"
    )
    acceleration: float = option(
        2.0, "m/s^2, that may come unannounced between two scans where there is no odometry"
    )
    turn_acceleration: float = option(4.0, "rad/s^2, likewise")
    unannounced: float = option(
        0.15, "m and rad, how far that takes the robot until the next scan at most"
    )
    steady_rate: float = option(
        0.1, "weight of the last motion in what is known of how steady it is"
    )

    def __post_init__(self) -> None:
        for name in (f.name for f in dataclasses.fields(self)):
            value = getattr(self, name)
            if not 0.0 <= value <= 100.0 or (value < 1e-6 and not name.endswith(_PER_MOTION)):
                raise ValueError(f"'slam.motion.{name}' wants a positive number up to 100")


@dataclass(frozen=True)
class MotionPrior:
    """A Gaussian on the next pose.

    Attributes:
        T_map_base: (3, 3) its mean.
        information: (3, 3) inverse covariance of x, y (map frame) and heading.
        sigma_translation: metres, the larger standard deviation of x, y.
        sigma_rotation: radians.
        measured: whether odometry says so; else it is a guess.
    """

    T_map_base: Float
    information: Float
    sigma_translation: float
    sigma_rotation: float
    measured: bool = False

    def shift_to(self, T_map_base: Float) -> Float:
        """(3,) x, y in metres and heading in radians from the mean to a pose (3, 3)."""
        d = se2.parameters(T_map_base) - se2.parameters(self.T_map_base)
        d[2] = se2.wrap(d[2])
        return d

    def penalty(self, T_map_base: Float) -> float:
        """-ln of its density at a pose (3, 3), but for a constant."""
        d = self.shift_to(T_map_base)
        return 0.5 * float(d @ self.information @ d)


def odometry_std(distance: float, turn: float, options: MotionOptions) -> tuple[float, float]:
    """Standard deviations in metres and radians of an increment of so many metres and radians."""
    sigma_xy = (
        options.translation_floor
        + options.translation_per_metre * distance
        + options.translation_per_radian * turn
    )
    sigma_theta = (
        options.rotation_floor
        + options.rotation_per_metre * distance
        + options.rotation_per_radian * turn
    )
    return sigma_xy, sigma_theta


def odometry_prior(T_map_base: Float, increment: Float, options: MotionOptions) -> MotionPrior:
    """The prior after moving by an odometry increment (3, 3) from a pose (3, 3)."""
    x, y, theta = se2.parameters(increment)
    sigma_xy, sigma_theta = odometry_std(float(np.hypot(x, y)), abs(float(theta)), options)
    return _prior(T_map_base @ increment, sigma_xy, sigma_theta, measured=True)


@dataclass(frozen=True, eq=False)
class OdometrySteps:
    """What odometry says of the way from each scan to the next.

    Attributes:
        increments: (T - 1, 3, 3).
        plausible: (T - 1,) whether the robot may have gone that far: odometry that begins again
            somewhere else leaps much farther than it ever goes.
    """

    increments: Float
    plausible: NDArray[np.bool_]


def compute_odometry_steps(T_odom_base: Float | None) -> OdometrySteps | None:
    """The steps of poses (T, 3, 3); None where there is no odometry."""
    if T_odom_base is None:
        return None
    increments = se2.inverse(T_odom_base[:-1]) @ T_odom_base[1:]
    metres = np.linalg.norm(increments[:, :2, 2], axis=1)
    usual = float(np.quantile(metres, 0.95)) if len(metres) else 0.0
    return OdometrySteps(increments, metres <= max(_LEAST_LEAP, _FARTHER * usual))


@dataclass(frozen=True)
class VelocityNoise:
    """How far guesses without odometry were off of late.

    Attributes:
        translation: metres, standard deviation along x and y.
        rotation: radians.
    """

    translation: float
    rotation: float

    def after(self, d: Float, seconds: float, options: MotionOptions) -> "VelocityNoise":
        """What is known of it once a guess was off by (3,) metres, metres, radians.

        Args:
            d: by how much the guess was off.
            seconds: between scans.
            options: see MotionOptions.
        """
        kept, new = 1.0 - options.steady_rate, options.steady_rate
        translation = np.sqrt(kept * self.translation**2 + new * 0.5 * (d[0] ** 2 + d[1] ** 2))
        rotation = np.sqrt(kept * self.rotation**2 + new * d[2] ** 2)
        return VelocityNoise(
            max(float(translation), _unannounced(options.acceleration, seconds, options)),
            max(float(rotation), _unannounced(options.turn_acceleration, seconds, options)),
        )


def _unannounced(acceleration: float, seconds: float, options: MotionOptions) -> float:
    return min(max(0.5 * acceleration * seconds**2, options.translation_floor), options.unannounced)


def unknown_steadiness(options: MotionOptions) -> VelocityNoise:
    """Before anything moved."""
    return VelocityNoise(options.without_odometry_translation, options.without_odometry_rotation)


def constant_velocity_prior(
    T_map_base: Float, T_map_base_before: Float, steadiness: VelocityNoise
) -> MotionPrior:
    """The prior without odometry: the last motion once more."""
    # not by BLAS, whose rounding is another one on other processors: along a corridor without ends
    # poses hang on these guesses alone
    increment = np.einsum("ij,jk->ik", se2.inverse(T_map_base_before), T_map_base)
    mean = np.einsum("ij,jk->ik", T_map_base, increment)
    return _prior(mean, steadiness.translation, steadiness.rotation)


def increment_prior(
    T_map_base: Float, increment: Float, options: MotionOptions, is_odometry: bool
) -> MotionPrior:
    """The prior one known or guessed increment (3, 3) from a pose (3, 3)."""
    if is_odometry:
        return odometry_prior(T_map_base, increment, options)
    return _prior(T_map_base @ increment, options.translation_floor, options.rotation_floor)


def gaussian_prior(
    T_map_base: Float, sigma_translation: float, sigma_rotation: float
) -> MotionPrior:
    """A prior about a pose (3, 3) that nobody measured."""
    return _prior(T_map_base, sigma_translation, sigma_rotation)


def fuse_priors(a: MotionPrior, b: MotionPrior) -> MotionPrior:
    """The product of two Gaussians on one pose."""
    information = a.information + b.information
    difference = se2.parameters(b.T_map_base) - se2.parameters(a.T_map_base)
    difference[2] = se2.wrap(difference[2])
    shift = np.linalg.solve(information, b.information @ difference)
    sigma = np.sqrt(1.0 / np.diag(information))
    mean = se2.matrix(*(se2.parameters(a.T_map_base) + shift))
    return MotionPrior(mean, information, float(sigma[:2].max()), float(sigma[2]))


def widen_prior(prior: MotionPrior, sigma_translation: float, sigma_rotation: float) -> MotionPrior:
    """The same mean, trusted less: standard deviations of at least these."""
    return _prior(
        prior.T_map_base,
        max(prior.sigma_translation, sigma_translation),
        max(prior.sigma_rotation, sigma_rotation),
    )


def _prior(mean: Float, sigma_xy: float, sigma_theta: float, measured: bool = False) -> MotionPrior:
    mean = se2.normalize(mean)
    information = np.diag([sigma_xy**-2, sigma_xy**-2, sigma_theta**-2])
    return MotionPrior(mean, information, sigma_xy, sigma_theta, measured)
