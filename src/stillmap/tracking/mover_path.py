"""Paths of movers: a box at any time; of vehicles, which a Kalman filter follows by their edge.

The filter follows the edge of a fast object that faces the sensor, front or rear; a smoothing
spline through these detections is the path of its center.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stillmap.core import kalman, se2
from stillmap.core.array_types import Bool, Float, Index
from stillmap.tracking.clustering import DynamicPoints

MIN_SPEED, MAX_SPEED = 2.5, 30.0  # m/s: faster than walkers; slower than what anybody maps
_STOPPED = 1.5  # m/s, below which it is left to the tracker of walkers
_ACCELERATION = 4.0  # m2/s3: cars brake, and turn
_EDGE_STD = 0.25  # m, of the edge along the motion, and across
_GATE, _MAX_GATE, _GATE_SIGMAS = 0.3, 1.2, 2.0  # m, m, standard deviations of the prediction
_LENGTH, _HALF_WIDTH = 6.5, 1.3  # m, of a large van
_EDGE_DEPTH = 0.4  # m of the object that count as its edge
_MAX_GAP = 1.2  # s without a point
_MIN_DETECTIONS, _MIN_TRAVEL = 5, 3.0  # of a track; m
_MIN_FOUND = 0.6  # share of the scans of a track that detect it
_EXTENT_DETECTIONS = 3  # that see as much of it as its length and width


class EdgeDetections(NamedTuple):
    """Detections at the edge of an object, rising in time.

    Attributes:
        scan: (L,) their scans.
        xy: (L, 2) the edge.
        heading: (L, 2) unit vectors along the motion.
        leads: (L,) whether it is the front, else the rear.
        length, width: m, the largest extents seen along the motion and across.
    """

    scan: Index
    xy: Float
    heading: Float
    leads: Bool
    length: float
    width: float


class _Run(NamedTuple):
    """Scans in which it was found; rows scan, x, y, heading, leads of its edge; its extents."""

    scans: list[int]
    edges: list[tuple[float, ...]]
    extents: list[tuple[float, float]]


def follow(points: DynamicPoints, scan: Index, seconds: Float, xy: Float) -> EdgeDetections | None:
    """Follow an object forwards and backwards from its seed; None if that is no object.

    Args:
        points: dynamic end points.
        scan, seconds: (n,) of the detections of the seed.
        xy: (n, 2) its edge that faces the sensor.
    """
    velocity = (xy[-1] - xy[0]) / (seconds[-1] - seconds[0])
    back = _run(points, int(scan[0]), xy[0], velocity, -1)
    ahead = _run(points, int(scan[0]), xy[0], velocity, 1)
    rows = np.array([*back.edges[:0:-1], *ahead.edges])
    scans = {*back.scans, *ahead.scans}
    if len(rows) < _MIN_DETECTIONS or len(scans) < _MIN_FOUND * (max(scans) - min(scans) + 1):
        return None
    if np.linalg.norm(rows[-1, 1:3] - rows[0, 1:3]) < _MIN_TRAVEL:
        return None
    extents = np.sort([*back.extents, *ahead.extents], axis=0)
    length, width = extents[-_EXTENT_DETECTIONS].tolist()
    scan_of_edge = rows[:, 0].astype(np.intp)
    return EdgeDetections(scan_of_edge, rows[:, 1:3], rows[:, 3:5], rows[:, 5] > 0.0, length, width)


def _run(points: DynamicPoints, scan: int, edge: Float, velocity: Float, step: int) -> _Run:
    """Follow in one direction of time, from an edge at a scan on."""
    run, length = _Run([], [], []), 0.0
    state = kalman.initialize(edge[None], _EDGE_STD, speed_std=2.0)
    state.v[0] = velocity
    now = last = float(points.seconds[scan])
    u = velocity / np.linalg.norm(velocity)
    leads = float((points.sensor[scan] - edge) @ u) > 0.0
    while 0 <= scan < len(points.seconds):
        t = float(points.seconds[scan])
        if abs(t - last) > _MAX_GAP:
            break
        state, now = kalman.predict(state, t - now, _ACCELERATION), t
        speed = float(np.linalg.norm(state.v[0]))
        if not _STOPPED <= speed <= 1.5 * MAX_SPEED:
            break
        u = state.v[0] / speed
        faces = float((points.sensor[scan] - state.x[0]) @ u) > 0.0
        if faces != leads:  # passed: from the front to the rear, or back
            state.x[0] += u * (length if faces else -length)
            leads = faces
        here, along, across = _within_box(points, scan, state, u, leads)
        if len(here):
            last, length = t, max(length, float(np.ptp(along)))
            run.scans.append(scan)
            run.extents.append((float(np.ptp(along)), float(np.ptp(across))))
            seen = _find_edge(state, u, along, across, leads)
            if seen is not None:
                run.edges.append((scan, *seen, *u, float(leads)))
                state = kalman.update(state, np.array([True]), seen[None], _EDGE_STD)
        scan += step
    return run


def _within_box(
    points: DynamicPoints, scan: int, state: kalman.TrackStates, u: Float, leads: bool
) -> tuple[Index, Float, Float]:
    """Points within the object as it is expected, and their offsets along and across."""
    here = np.arange(points.first[scan], points.first[scan + 1])
    along, across = se2.along_and_across(points.xy[here] - state.x[0], u)
    gate = _gate(state)
    behind = along * (-1.0 if leads else 1.0)  # m into the object from the edge
    inside = (behind >= -gate) & (behind <= _LENGTH) & (np.abs(across) <= _HALF_WIDTH + gate)
    return here[inside], along[inside], across[inside]


def _gate(state: kalman.TrackStates) -> float:
    return min(_GATE + _GATE_SIGMAS * float(state.position_std[0]), _MAX_GATE)


def _find_edge(
    state: kalman.TrackStates, u: Float, along: Float, across: Float, leads: bool
) -> Float | None:
    """(2,) the edge; None where it is hidden or out of view: then all points lie behind it."""
    sign = 1.0 if leads else -1.0
    edge = float((sign * along).max())
    if edge < -_gate(state):
        return None
    side = float(across[sign * along >= edge - _EDGE_DEPTH].mean())
    # half: the mean moves to one side while the other comes into view
    return np.asarray(state.x[0] + sign * edge * u + 0.5 * side * np.array([-u[1], u[0]]))


_FEW = 100  # knots up to which a full matrix is solved: SciPy takes 0.2 s to load
_MIN_INTERVAL = 1e-3  # s: over less, differences of positions say nothing of speeds


def smooth_track(
    seconds: Float, xy: Float, noise_std: float, acceleration: float
) -> tuple[Float, Float]:
    """Most probable positions (L, 2) and velocities (L, 2) given all detections.

    Under white acceleration and white detection noise the most probable path is the cubic
    smoothing spline: it minimises the sum of squared residuals over noise_std^2 and of squared
    acceleration over its density. Reinsch's equations (Numer. Math. 10, 1967) are banded, and for
    short tracks twenty times as fast as scipy's spline.

    Args:
        seconds: (L,) not falling, L >= 1; detections within 1 ms count as their mean.
        xy: (L, 2) detected positions, metres.
        noise_std: metres.
        acceleration: m2/s3, spectral density of the acceleration.
    """
    which = np.cumsum(np.diff(seconds, prepend=seconds[:1]) > _MIN_INTERVAL)
    count = np.bincount(which).astype(np.float64)
    t = np.bincount(which, seconds) / count
    y = np.stack([np.bincount(which, xy[:, d]) for d in (0, 1)], axis=-1) / count[:, None]
    if len(t) == 1:
        return y[which], np.zeros_like(xy)
    h = np.diff(t)[:, None]
    second = np.zeros_like(y)  # second derivatives; 0 at the ends
    if len(t) > 2:
        second[1:-1], residual = _solve(h[:, 0], y, noise_std**2 / acceleration / count)
        y = y - residual
    slope = np.diff(y, axis=0) / h
    forward = slope - h / 6.0 * (2.0 * second[:-1] + second[1:])
    last = slope[-1:] + h[-1:] / 6.0 * (second[-2:-1] + 2.0 * second[-1:])
    return y[which], np.concatenate([forward, last])[which]


def _solve(h: Float, y: Float, weight: Float) -> tuple[Float, Float]:
    """Second derivatives (n - 2, 2) at the inner knots, and residuals (n, 2).

    (R + Q^T W Q) second = Q^T y, and the spline is y - W Q second: Q takes second differences, R
    has the integrals of hat functions.
    """
    a, c = 1.0 / h[:-1], 1.0 / h[1:]
    b = -a - c
    before, here, after = weight[:-2], weight[1:-1], weight[2:]
    banded = np.zeros((3, len(b)))
    banded[0] = (h[:-1] + h[1:]) / 3.0 + before * a**2 + here * b**2 + after * c**2
    banded[1, :-1] = h[1:-1] / 6.0 + here[:-1] * b[:-1] * a[1:] + after[:-1] * c[:-1] * b[1:]
    banded[2, :-2] = after[:-2] * c[:-2] * a[2:]
    second = _solve_banded(banded, np.diff(np.diff(y, axis=0) / h[:, None], axis=0))
    residual = np.zeros_like(y)
    residual[:-2] += a[:, None] * second
    residual[1:-1] += b[:, None] * second
    residual[2:] += c[:, None] * second
    return second, weight[:, None] * residual


def _solve_banded(banded: Float, right: Float) -> Float:
    """x (n, 2) of A x = right, A symmetric with the diagonals `banded` (3, n) from the main one."""
    n = len(right)
    if n <= _FEW:
        A = np.diag(banded[0])
        for k in (1, 2):
            row = np.arange(k, n)
            A[row, row - k] = A[row - k, row] = banded[k, : max(n - k, 0)]
        x: Float = np.linalg.solve(A, right).astype(np.float64, copy=False)
        return x
    from scipy.linalg import solveh_banded

    return np.asarray(solveh_banded(banded, right, lower=True))


_PATH_STD, _PATH_ACCELERATION = 0.15, 2.0  # m, m2/s3: of the smoothed path
_MIN_LENGTH, _MIN_WIDTH = 1.0, 0.8  # m, of what is seen as one beam
_REACH = 0.5  # s before the first detection and after the last


@dataclass(frozen=True, eq=False)
class MoverPath:
    """A box that moves.

    Attributes:
        seconds: (L,) times of the detections, rising.
        xy: (L, 2) metres, its center in the map frame.
        velocity: (L, 2) metres per second.
        length, width: metres, of the box.
        is_round: of a walker; the width is the diameter of a circle.
    """

    seconds: Float
    xy: Float
    velocity: Float
    length: float
    width: float
    is_round: bool = False

    @property
    def travel(self) -> float:
        """Metres from the first detection to the last."""
        return float(np.linalg.norm(self.xy[-1] - self.xy[0]))

    def state_at(self, seconds: Float) -> tuple[Float, Float]:
        """(n, 2) center and velocity at times (n,); constant velocity beyond the detections."""
        inside = np.clip(seconds, self.seconds[0], self.seconds[-1])
        x, v = (
            np.stack([np.interp(inside, self.seconds, c) for c in column.T], axis=-1)
            for column in (self.xy, self.velocity)
        )
        return x + (seconds - inside)[:, None] * v, v

    def contains(self, seconds: Float, xy: Float, margin: float) -> Bool:
        """(n,) whether points (n, 2) at times (n,) lie within the box and `margin` metres."""
        x, v = self.state_at(seconds)
        u = v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
        along, across = se2.along_and_across(xy - x, u)
        near = (seconds >= self.seconds[0] - _REACH) & (seconds <= self.seconds[-1] + _REACH)
        near &= np.abs(along) <= 0.5 * self.length + margin
        return np.asarray(near & (np.abs(across) <= 0.5 * self.width + margin))

    def scans(self, seconds: Float) -> tuple[int, int]:
        """First scan in which it may be seen, and the one after the last, of all times (T,)."""
        first, last = self.seconds[0] - _REACH, self.seconds[-1] + _REACH
        end = np.searchsorted(seconds, last, side="right")
        return int(np.searchsorted(seconds, first)), int(end)

    def find_points(self, points: DynamicPoints, margin: float) -> Index:
        """Points within the box, rising."""
        first, last = self.scans(points.seconds)
        low, high = points.first[first], points.first[last]
        t = points.seconds[points.scan[low:high]]
        return np.asarray(low + np.flatnonzero(self.contains(t, points.xy[low:high], margin)))


def fit_path(edges: EdgeDetections, seconds: Float) -> MoverPath:
    """The path of the center.

    Args:
        edges: at one or the other end of it.
        seconds: (T,) times of the scans.
    """
    length, width = max(edges.length, _MIN_LENGTH), max(edges.width, _MIN_WIDTH)
    back = np.where(edges.leads, -0.5, 0.5)[:, None] * length
    t = seconds[edges.scan]
    xy, velocity = smooth_track(t, edges.xy + back * edges.heading, _PATH_STD, _PATH_ACCELERATION)
    return MoverPath(t, xy, velocity, length, width)
