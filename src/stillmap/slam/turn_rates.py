"""Latency of odometry, from the turn rates of odometry and of a laser."""

from dataclasses import dataclass

import numpy as np

from stillmap.core.array_types import Bool, Float, Index
from stillmap.slam.scan_motion import MotionWindows

MAX_LATENCY = 0.6  # s, early or late, that is tried
_LATENCY_STEP = 0.05  # s
# box over which headings are averaged, times the interval of the scans
_SMOOTHING = 2.0
_MIN_TURNS = 30
_TURN_STD, _STD_PER_RADIAN = 0.002, 0.03  # rad, rad per sqrt(rad): of odometry, before scaling
_DEGREES_OF_FREEDOM = 4.0  # of Student's t distribution
_MEDIAN_CHI2 = 0.455  # of one degree of freedom
_ITERATIONS = 8
_DIFFERENCE = 0.01  # s, of numeric derivatives


@dataclass(frozen=True)
class LatencyFit:
    """The delay of odometry.

    Attributes:
        latency: s; negative: early.
        std: s; infinite where the recording does not show it.
        explained: share of odometry's turns that the laser's explain.
    """

    latency: float = 0.0
    std: float = np.inf
    explained: float = 0.0


def fit_latency(
    windows: MotionWindows, seconds: Float, T_odom_base: Float, use: Bool | None = None
) -> LatencyFit:
    """Fits odometry's turns between scans as a factor times those of the laser some time before.

    Args:
        windows: motion of the laser.
        seconds: (T,) stamps of the recording.
        T_odom_base: (T, 3, 3) odometry.
        use: the segments to use; None: all.
    """
    heading = np.unwrap(np.arctan2(T_odom_base[:, 1, 0], T_odom_base[:, 0, 0]))
    turns = _Turns(windows, seconds, heading, use)
    if len(turns.odometry) < _MIN_TURNS:
        return LatencyFit()
    tried = np.arange(-MAX_LATENCY, MAX_LATENCY + 1e-9, _LATENCY_STEP).tolist()
    fits = [(*_fit_gain(turns.of_laser(t), turns.odometry), t) for t in tried]
    _, gain, latency = min(fits)  # of equal ones the first
    covariance, explained = np.zeros((2, 2)), 0.0
    for _ in range(_ITERATIONS):
        x = turns.of_laser(latency)
        ahead, behind = (turns.of_laser(latency + d) for d in (_DIFFERENCE, -_DIFFERENCE))
        J = np.stack([gain * (ahead - behind) / (2 * _DIFFERENCE), x], axis=-1)
        r = turns.odometry - gain * x
        w = _weights(r, x)
        A = J.T @ (w[:, None] * J) + 1e-9 * np.eye(2)
        inverse = np.linalg.inv(A)
        step = inverse @ (J.T @ (w * r))
        latency = float(np.clip(latency + step[0], -MAX_LATENCY, MAX_LATENCY))
        gain += float(step[1])
        # residuals of one segment depend on each other: errors of its map, a slip
        scores = sum_by_segment(J * (w * r)[:, None], turns.segment)
        covariance = inverse @ (scores.T @ scores) @ inverse
        explained = 1.0 - float(w @ r**2) / max(float(w @ turns.odometry**2), 1e-12)
    if abs(latency) >= MAX_LATENCY - _LATENCY_STEP:
        return LatencyFit()
    return LatencyFit(latency, float(np.sqrt(max(covariance[0, 0], inverse[0, 0]))), explained)


def sum_by_segment(rows: Float, segment: Index) -> Float:
    """(S, P) sums of rows (N, P) over the segments (N,)."""
    out = np.zeros((int(segment.max(initial=-1)) + 1, rows.shape[1]))
    np.add.at(out, segment, rows)
    return out


class _Turns:
    """Turns (N,) of odometry, and of the laser at any latency, between the same moments.

    Headings are averaged over a short box first, and the laser's are interpolated, not odometry's:
    interpolation averages noise, and where odometry, the noisier one, has less of it, it would
    seem to agree better.
    """

    def __init__(
        self, windows: MotionWindows, seconds: Float, heading: Float, use: Bool | None
    ) -> None:
        parts = list(_split_segments(windows, seconds, use))
        self._width = _SMOOTHING * float(
            np.median(np.concatenate([[1.0], *(np.diff(at) for _, at, _ in parts)]))
        )
        margin = MAX_LATENCY + 0.5 * self._width
        curve = _Curve(seconds, heading)
        pairs, odometry, segments, times, turned = [], [], [], [], []
        for segment, at, turns in parts:
            inner = at[(at >= at[0] + margin) & (at <= at[-1] - margin)]
            if len(inner) < 3:
                continue
            smooth = curve.average(inner, self._width)
            pairs.append(np.stack([inner[:-1], inner[1:]]))
            odometry.append(np.diff(smooth))
            segments.append(np.full(len(inner) - 1, segment))
            times.append(at)
            turned.append(turns)
        none = np.zeros(0)
        self.odometry = np.concatenate([none, *odometry])
        self.segment = np.concatenate([np.zeros(0, np.intp), *segments])
        self._pairs = np.concatenate([np.zeros((2, 0)), *pairs], axis=1)
        # one curve for all segments: nothing is asked between them
        self._laser = _Curve(np.concatenate([none, *times]), np.concatenate([none, *turned]))

    def of_laser(self, latency: float) -> Float:
        """(N,) rad, by so many seconds before."""
        begin, end = (self._laser.average(t - latency, self._width) for t in self._pairs)
        return end - begin


def _split_segments(
    windows: MotionWindows, seconds: Float, use: Bool | None
) -> list[tuple[int, Float, Float]]:
    """Number, times and headings of each segment."""
    parts = []
    for k in range(int(windows.step_segment.max(initial=-1)) + 1):
        of = windows.step_segment == k
        if of.any() and (use is None or use[k]):
            at = seconds[np.append(windows.steps[of][:, 0], windows.steps[of][-1:, 1])]
            parts.append((k, at, np.append(0.0, windows.turns[of].cumsum())))
    return parts


class _Curve:
    """A piecewise linear curve through values (T,) at times (T,)."""

    def __init__(self, seconds: Float, values: Float) -> None:
        self._seconds, self._values = seconds, values
        areas = 0.5 * np.diff(seconds) * (values[1:] + values[:-1])
        self._area = np.append(np.zeros(min(len(values), 1)), areas.cumsum())

    def average(self, t: Float, width: float) -> Float:
        """Averages over boxes `width` wide around times (N,), which lie within the curve."""
        half = 0.5 * width
        mean: Float = (self._integral(t + half) - self._integral(t - half)) / width
        return mean

    def _integral(self, t: Float) -> Float:
        t = np.clip(t, self._seconds[0], self._seconds[-1])
        k = np.clip(np.searchsorted(self._seconds, t, side="right"), 1, len(self._seconds) - 1) - 1
        u, span = t - self._seconds[k], self._seconds[k + 1] - self._seconds[k]
        slope = (self._values[k + 1] - self._values[k]) / np.maximum(span, 1e-9)
        area: Float = self._area[k] + (self._values[k] + 0.5 * slope * u) * u
        return area


def _weights(r: Float, turns: Float) -> Float:
    """(N,) Student's t weights over the variances of residuals (N,)."""
    variance = _TURN_STD**2 + _STD_PER_RADIAN**2 * np.abs(turns)
    squares = r**2 / variance
    scale = max(float(np.median(squares)) / _MEDIAN_CHI2, 1e-3)
    nu = _DEGREES_OF_FREEDOM
    weights: Float = (nu + 1.0) / (nu + squares / scale) / (scale * variance)
    return weights


def _fit_gain(x: Float, y: Float) -> tuple[float, float]:
    """Student's t cost of y - gain x in nats, and the gain."""
    gain = float(x @ y) / max(float(x @ x), 1e-12)
    for _ in range(3):
        wx = _weights(y - gain * x, x) * x
        gain = float(wx @ y) / max(float(wx @ x), 1e-12)
    variance = _TURN_STD**2 + _STD_PER_RADIAN**2 * np.abs(x)
    squares = (y - gain * x) ** 2 / variance
    scale = max(float(np.median(squares)) / _MEDIAN_CHI2, 1e-3)
    nu = _DEGREES_OF_FREEDOM
    tails = 0.5 * (nu + 1.0) * np.log1p(squares / (nu * scale))
    return float((tails + 0.5 * np.log(scale * variance)).sum()), gain
