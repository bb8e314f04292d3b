"""Hand-eye calibration of planar lasers: A X = X B over many short motions.

Between two scans the base moves by A, as odometry says, and the laser by B, as scan matching says;
X is the laser's pose on the base. Odometry counts `scale` times the distance and `rotation_gain`
times the rotation. Robust weighted least squares over the lasers together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float
from stillmap.core.recording import Recording
from stillmap.slam.motion_model import compute_odometry_steps
from stillmap.slam.scan_motion import MotionWindows

Values = dict[str, float]

SCALE, GAIN = "scale", "rotation_gain"

# odometry's own errors, before the residuals scale them: m and rad per square root of a metre or
# radian of motion
_ODOMETRY_STD = (0.02, 0.03)
# standard deviations around the nominal values, by the first letters of the names: so weak that
# only what the recording does not excite keeps to them
_PRIOR_STD = {"theta": 3.0, "x": 0.5, "y": 0.5, SCALE: 0.5, GAIN: 0.5}
_DEGREES_OF_FREEDOM = 4.0  # of Student's t distribution, which the residuals are taken to follow
_MEDIAN_CHI2, _MEDIAN_CHI2_2D = 2.37, 1.39  # of three and of two degrees of freedom
_MIN_SCALE = 1e-2  # of the variances
_ITERATIONS = 30
_CACHED = 8  # odometry motions at different scales and gains
_MAX_STEP = 0.3  # m, rad or 1, of one iteration
_DIFFERENCE = 1e-4  # m, rad or 1, of numeric derivatives


def laser_names(laser: int) -> tuple[str, str, str]:
    """Names of the parameters of a laser: yaw in rad, position in m."""
    return f"theta{laser}", f"x{laser}", f"y{laser}"


def kind(name: str) -> str:
    """The name of a parameter without the number of its laser."""
    return name.rstrip("0123456789")


def difference(name: str, value: float, nominal: float) -> float:
    """Of a parameter of this name; of angles between -pi and pi."""
    d = value - nominal
    return float(se2.wrap(d)) if name.startswith("theta") else d


def nominal_values(recording: Recording) -> Values:
    """All parameters as recorded."""
    values: Values = {SCALE: 1.0, GAIN: 1.0}
    for k, pose in enumerate(se2.parameters(recording.T_base_sensor)):
        x, y, theta = pose.tolist()
        values.update(zip(laser_names(k), (theta, x, y), strict=True))
    return values


def correct_odometry(
    seconds: Float, T_odom_base: Float, *, scale: float, rotation_gain: float, latency: float = 0.0
) -> Float:
    """(T, 3, 3) odometry at the same stamps without its systematic errors.

    Args:
        seconds: (T,) stamps.
        T_odom_base: (T, 3, 3) as recorded.
        scale: recorded over true distance.
        rotation_gain: recorded over true rotation.
        latency: s by which the recorded poses are late. Beyond the last stamp the robot stands;
            over a leap of odometry nothing is interpolated.
    """
    T = T_odom_base
    if len(T) < 2:
        return T
    if latency != 0.0:
        T = _interpolate(seconds, T, seconds + latency)
    if scale == 1.0 and rotation_gain == 1.0:
        return T
    twists = se2.log(se2.increments(T)) / [scale, scale, rotation_gain]
    return _chain(T[0], twists)


def _chain(first: Float, twists: Float) -> Float:
    """(T, 3, 3) poses from the first one (3, 3) along twists (T - 1, 3)."""
    steps = se2.parameters(se2.exp(twists))
    x, y, theta = se2.parameters(first)
    heading = theta + np.append(0.0, steps[:, 2].cumsum())
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    dx, dy = c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]
    return se2.matrix(x + np.append(0.0, dx.cumsum()), y + np.append(0.0, dy.cumsum()), heading)


def _interpolate(seconds: Float, T: Float, at: Float) -> Float:
    """Poses (N, 3, 3) at times (N,) between those at stamps (T,); the nearest beyond them."""
    at = np.clip(at, seconds[0], seconds[-1])
    before = np.clip(np.searchsorted(seconds, at, side="right") - 1, 0, len(T) - 2)
    span = np.maximum(seconds[before + 1] - seconds[before], 1e-9)
    share = np.minimum((at - seconds[before]) / span, 1.0)
    steps = compute_odometry_steps(T, (1e9 * seconds).astype(np.int64))
    share = np.where(steps.plausible[before] | (share == 1.0), share, 0.0)
    return T[before] @ se2.exp(share[:, None] * se2.log(steps.increments[before]))


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted parameters.

    Attributes:
        values: all parameters by name.
        std: standard deviations of the free ones.
        cost: nats per window (W,).
    """

    values: Values
    std: Values
    cost: Float


class HandEye:
    """The least-squares problem.

    Args:
        windows: motions of each laser.
        upside_down: for each laser whether its scans are mirrored.
        T_odom_base: (T, 3, 3) odometry, not late.
        nominal: values of all parameters that the priors lie around.
    """

    def __init__(
        self,
        windows: Sequence[MotionWindows],
        upside_down: Sequence[bool],
        T_odom_base: Float,
        nominal: Values,
    ) -> None:
        both = zip(windows, upside_down, strict=True)
        self.windows = [mirror(one) if mirrored else one for one, mirrored in both]
        self.nominal = nominal
        counts = [int(one.segment.max(initial=-1)) + 1 for one in windows]
        before = np.cumsum([0, *counts[:-1]])
        self.segment = np.concatenate(
            [one.segment + k for one, k in zip(windows, before, strict=True)]
        )
        # only the scans in windows; the steps between segments are in none
        spans = [np.arange(a, b + 1) for w in windows for a, b in zip(w.first, w.last, strict=True)]
        scans = np.unique(np.concatenate(spans))
        self._ends = [np.searchsorted(scans, np.stack([one.first, one.last])) for one in windows]
        self._twists = se2.log(se2.inverse(T_odom_base[scans[:-1]]) @ T_odom_base[scans[1:]])
        self._cache: dict[tuple[float, float], list[Float]] = {}
        covariances = [
            one.covariance + _odometry_noise(motion)
            for one, motion in zip(self.windows, self._motions(1.0, 1.0), strict=True)
        ]
        self.information = np.linalg.inv(np.concatenate(covariances))

    def _motions(self, scale: float, gain: float) -> list[Float]:
        """Of each laser (W, 3) x, y, heading of the base by odometry so corrected."""
        if (scale, gain) not in self._cache:
            if len(self._cache) > _CACHED:
                self._cache.clear()
            T = _chain(np.eye(3), self._twists / [scale, scale, gain])
            self._cache[scale, gain] = [
                se2.parameters(se2.inverse(T[first]) @ T[last]) for first, last in self._ends
            ]
        return self._cache[scale, gain]

    def fit_globally(self, free: Sequence[str]) -> Fit:
        """The better of the fits from the closed form and from the nominal values.

        A negative scale is the solution of a laser half a turn away.
        """
        fits = [self.fit(start, free) for start in (self.start(free), self.nominal)]
        proper = [fit for fit in fits if fit.values[SCALE] > 0.0]
        return min(proper or fits, key=lambda fit: float(fit.cost.sum()))

    def start(self, free: Sequence[str]) -> Values:
        """Values of the free parameters of the lasers from a closed form, whatever the yaw.

        With a = cos(theta) / s, b = sin(theta) / s and u = (x, y) / s, where s is the scale,
        odometry's displacement p and the laser's (t, phi) obey p = (a + b J) t + (I - R(phi)) u,
        J the rotation by 90 degrees: linear in a, b and u. Weighted again and again for outliers.
        """
        values = dict(self.nominal)
        motions = self._motions(1.0, 1.0)
        for k, one in enumerate(self.windows):
            names = laser_names(k)
            if not all(name in free for name in names) or len(one.first) < 4:
                continue
            a, b, *u = _solve_linear(one, motions[k][:, :2])
            size = float(np.hypot(a, b))
            if size > 0.1:  # else the laser hardly moved
                found = (float(np.arctan2(b, a)), float(u[0]) / size, float(u[1]) / size)
                values.update(zip(names, found, strict=True))
        return values

    def residuals(self, values: Values) -> Float:
        """(W, 3) differences in x, y, heading of the first scan's frame, as odometry counts.

        Odometry's errors are the larger ones: counted in the laser's measure they would draw scale
        and gain towards less.
        """
        out, motions = [], self._motions(values[SCALE], values[GAIN])
        for k, (one, base) in enumerate(zip(self.windows, motions, strict=True)):
            theta, x, y = (values[name] for name in laser_names(k))
            phi = one.motion[:, 2]
            c, s = np.cos(phi) - 1.0, np.sin(phi)  # the scans know the rotation of the lever better
            px, py = base[:, 0] + c * x - s * y, base[:, 1] + s * x + c * y
            ct, st = np.cos(theta), np.sin(theta)
            expected = np.stack([ct * px + st * py, ct * py - st * px], axis=-1)
            shift = (one.motion[:, :2] - expected) * values[SCALE]
            turn = se2.wrap(phi - base[:, 2]) * values[GAIN]
            out.append(np.concatenate([shift, turn[:, None]], axis=1))
        return np.concatenate(out)

    def fit(self, start: Values, free: Sequence[str], use: Bool | None = None) -> Fit:
        """Gauss-Newton over the free parameters, with weights of Student's t distribution.

        Args:
            start: values of all parameters.
            free: names of those to fit.
            use: (W,) windows to use; None: all.
        """
        values, nu = dict(start), _DEGREES_OF_FREEDOM
        chosen = np.ones(len(self.segment), np.bool_) if use is None else use
        prior = np.array([_PRIOR_STD[kind(name)] ** -2 for name in free])
        for _ in range(_ITERATIONS if len(free) else 1):
            r = self.residuals(values)
            squares = np.einsum("wi,wij,wj->w", r, self.information, r)
            scale = max(float(np.median(squares[chosen])) / _MEDIAN_CHI2, _MIN_SCALE)
            weights = chosen * (nu + 3.0) / (nu + squares / scale) / scale
            if not len(free):
                break
            J = np.stack([self._derivative(values, name) for name in free], axis=-1)
            WJ = weights[:, None, None] * (self.information @ J)
            A = np.einsum("wip,wiq->pq", J, WJ) + np.diag(prior)
            off = np.array([difference(name, values[name], self.nominal[name]) for name in free])
            step = np.linalg.solve(A, -np.einsum("wip,wi->p", WJ, r) - prior * off)
            for name, change in zip(free, step, strict=True):
                values[name] += float(np.clip(change, -_MAX_STEP, _MAX_STEP))
            if np.abs(step).max() < 1e-6:
                break
        cost = 0.5 * (nu + 3.0) * np.log1p(squares / (nu * scale)) + 1.5 * np.log(scale)
        std = {}
        if len(free):
            scores = np.zeros((int(self.segment.max(initial=-1)) + 1, len(free)))
            # residuals of one segment depend on each other: errors of its map, a slip
            np.add.at(scores, self.segment, np.einsum("wip,wi->wp", WJ, r))
            std = dict(zip(free, _standard_deviations(A, scores), strict=True))
        return Fit(values, std, cost)

    def _derivative(self, values: Values, name: str) -> Float:
        above, below = (
            self.residuals({**values, name: values[name] + d}) for d in (_DIFFERENCE, -_DIFFERENCE)
        )
        return (above - below) / (2.0 * _DIFFERENCE)


def _odometry_noise(motion: Float) -> Float:
    """(W, 3, 3) covariances of odometry's motions (W, 3)."""
    x, y, turn = motion.T
    variance = np.square([_ODOMETRY_STD[0], _ODOMETRY_STD[0], _ODOMETRY_STD[1]])
    noise: Float = (np.hypot(x, y) + np.abs(turn))[:, None, None] * np.diag(variance)
    return noise


def _solve_linear(one: MotionWindows, p: Float) -> Float:
    """(4,) a, b and u of `HandEye.start`, given odometry's displacements (W, 2)."""
    (tx, ty), phi = one.motion[:, :2].T, one.motion[:, 2]
    c, s = 1.0 - np.cos(phi), np.sin(phi)
    A = np.stack([np.stack([tx, -ty, c, s], -1), np.stack([ty, tx, -s, c], -1)], axis=1)
    variance = 0.5 * np.trace(one.covariance[:, :2, :2], axis1=1, axis2=2)
    variance += _ODOMETRY_STD[0] ** 2 * (np.hypot(*p.T) + np.abs(phi))
    prior = np.diag([1e-6, 1e-6, _PRIOR_STD["x"] ** -2, _PRIOR_STD["y"] ** -2])
    weights, solution = 1.0 / variance, np.zeros(4)
    for _ in range(_ITERATIONS // 2):
        H = np.einsum("w,wia,wib->ab", weights, A, A) + prior
        solution = np.linalg.solve(H, np.einsum("w,wia,wi->a", weights, A, p))
        squares = ((p - A @ solution) ** 2).sum(axis=1) / variance
        scale = max(float(np.median(squares)) / _MEDIAN_CHI2_2D, _MIN_SCALE)
        weights = (_DEGREES_OF_FREEDOM + 2.0) / (_DEGREES_OF_FREEDOM + squares / scale)
        weights /= scale * variance
    return solution


def _standard_deviations(A: Float, scores: Float) -> list[float]:
    """(P,) from the information (P, P), or from the scores (S, P) of the segments if larger.

    The latter hold whatever the distribution of the residuals, and if those of one segment depend
    on each other (Liang and Zeger 1986).
    """
    inverse = np.linalg.inv(A)
    n, p = int(np.count_nonzero(np.abs(scores).sum(axis=1))), len(A)
    sandwich = inverse @ (scores.T @ scores) @ inverse * n / max(n - p, 1)
    std: list[float] = np.sqrt(np.maximum(np.diag(inverse), np.diag(sandwich))).tolist()
    return std


def mirror(one: MotionWindows) -> MotionWindows:
    """The motions of the laser as seen from below."""
    sign = np.array([1.0, -1.0, -1.0])
    return replace(
        one,
        motion=one.motion * sign,
        covariance=one.covariance * np.outer(sign, sign),
    )
