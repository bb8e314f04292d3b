"""How the surroundings of a lidar look from scan to scan: level ground, and what stands on it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording

Float = NDArray[np.float64]
Planes = tuple[Float, Float]

BODY_RADIUS = 4.0  # m: what is farther along an axis of the sensor is no part of the robot
PROFILE_RANGE = 12.0  # m: up to there is looked for how things go on
MIN_SCANS = 12  # fewer show nothing
PLANE_MARGIN = 0.25  # m to either side of the ground and the ceiling: theirs

_POINTS = 8000  # of each scan that tell how the surroundings look
_LAYER = 0.1  # m, of those in which the ground is looked for
_DIRECTION = np.radians(5.0)  # in which surroundings are compared
_MOVED = (1.0, 0.3)  # m by which things are nearer or farther elsewhere, and in which share
_AGAIN = (0.5, 0.75, 0.5)  # m by which readings are the same, mostly; so are few directions
_KNOWN = 0.25  # share of the places in which something is seen in a direction that is compared
_COMPARED = 20  # directions at least
_FLAT = 0.05  # rms of directions off a plane: a sweep is no fan


class ScanSample(NamedTuple):
    """A scan and some of its hits, turned as the robot is."""

    scan: int
    points: NDArray[np.float32]


def sample_hits(recording: Recording, scan: int, R: Float) -> ScanSample:
    beams = recording.beams_of(scan)
    points = recording.points[beams][recording.hit[beams]]
    points = points[:: max(1, len(points) // _POINTS)]
    return ScanSample(scan, (points @ R.T).astype(np.float32))


def is_3d_sweep(points: NDArray[np.float32]) -> bool:
    """Whether the directions of points (n, 3) leave every plane through the sensor."""
    if len(points) < 3:
        return False
    directions = points / np.linalg.norm(points, axis=1)[:, None]
    least = np.linalg.eigvalsh(directions.T.astype(np.float64) @ directions / len(points))[0]
    return bool(np.sqrt(max(least, 0.0)) > _FLAT)


def fit_ground_and_ceiling(points: NDArray[np.float32]) -> Planes | None:
    """The ground and the ceiling, z = a x + b y + c, from points (n, 3) beyond the robot.

    The ceiling is at infinity where there is nothing above; None where no ground is.
    """
    away = np.hypot(points[:, 0], points[:, 1])
    beyond = points[(away >= BODY_RADIUS) & (away < PROFILE_RANGE)].astype(np.float64)
    ground = _level(beyond[beyond[:, 2] < -_LAYER])
    ceiling = _level(beyond[beyond[:, 2] > _LAYER])
    if ground is None:
        return None
    return ground, np.array([0.0, 0.0, np.inf]) if ceiling is None else ceiling


def _level(points: Float) -> Float | None:
    """The nearly level plane that most of points (n, 3) are on; None for a few."""
    if len(points) < MIN_SCANS:
        return None
    bins = np.floor(points[:, 2] / _LAYER).astype(np.intp)
    lowest = int(bins.min())
    most = int(np.convolve(np.bincount(bins - lowest), np.ones(3))[1:-1].argmax())
    plane = np.array([0.0, 0.0, (lowest + most + 0.5) * _LAYER])
    flat = np.column_stack([points[:, :2], np.ones(len(points))])
    for _ in range(3):
        on = np.abs(points[:, 2] - flat @ plane) < PLANE_MARGIN
        if np.count_nonzero(on) < 3:
            break
        plane = np.linalg.lstsq(flat[on], points[on, 2], rcond=None)[0]
    return plane


def select_distinct_scans(looks: list[ScanSample], levels: Planes) -> list[int]:
    """Scans from places that look different, each from the one before; [] where all look alike."""
    seen: list[tuple[int, Float]] = []
    for look in looks:
        ranges = _ranges(look.points, levels)
        if not seen or _elsewhere(seen[-1][1], ranges):
            seen.append((look.scan, ranges))
    # a robot that stands in a crowd sees different people before the same walls
    stacked = np.stack([ranges for _, ranges in seen])
    known = np.count_nonzero(np.isfinite(stacked), axis=0) >= _KNOWN * len(seen)
    stacked = stacked[:, known]
    same = np.abs(stacked - np.nanmedian(stacked, axis=0)) < _AGAIN[0]
    again = np.count_nonzero(same.mean(axis=0) >= _AGAIN[1])
    return [scan for scan, _ in seen] if again <= _AGAIN[2] * known.sum() else []


def _elsewhere(before: Float, ranges: Float) -> bool:
    """Whether ranges by direction are seen from another place."""
    change = np.abs(ranges - before)
    change = change[np.isfinite(change)]
    return len(change) >= _COMPARED and bool(np.mean(change > _MOVED[0]) > _MOVED[1])


def _ranges(points: NDArray[np.float32], levels: Planes) -> Float:
    """Median range in each direction of what stands on the ground farther away; NaN: nothing."""
    x, y, z = points.astype(np.float64).T
    range = np.linalg.norm(points, axis=1)
    (a, b, c), (p, q, r) = levels
    stands = (range > BODY_RADIUS) & (z - a * x - b * y - c > PLANE_MARGIN)
    stands &= p * x + q * y + r - z > PLANE_MARGIN
    x, y, z, range = x[stands], y[stands], z[stands], range[stands]
    columns, rows = round(2 * np.pi / _DIRECTION), round(np.pi / _DIRECTION)
    column = np.minimum((np.arctan2(y, x) + np.pi) / _DIRECTION, columns - 1).astype(np.intp)
    row = np.minimum((np.arcsin(z / range) + np.pi / 2) / _DIRECTION, rows - 1).astype(np.intp)
    direction = row * columns + column
    order = np.lexsort((range, direction))
    counts = np.bincount(direction, minlength=rows * columns)
    middle = np.cumsum(counts) - counts + counts // 2
    out = np.full(rows * columns, np.nan)
    out[counts > 0] = range[order][middle[counts > 0]]
    return out
