"""Ground and ceiling planes of lidar scans, and range profiles of the obstacles between them.

The profiles show, without poses, whether scans were taken at different positions.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording

Float = NDArray[np.float64]
Planes = tuple[Float, Float]  # ground and ceiling, each (a, b, c) of z = a x + b y + c

BODY_RADIUS = 4.0  # m along each axis of the sensor: the robot extends no farther
PROFILE_RANGE = 12.0  # m, range of the points that determine planes and profiles
MIN_SCANS = 12  # fewer scans are not conclusive
PLANE_MARGIN = 0.25  # m on either side of a plane that belong to it

_MAX_POINTS = 8000  # of a sampled scan
_LAYER = 0.1  # m, height bins in which planes are searched
_BIN = np.radians(5.0)  # of direction, of a range profile
_MIN_CHANGE = (1.0, 0.3)  # m of range, and share of the directions that changed by it
# m, share of scans within it of the median, maximum share of such directions
_MAX_REPETITION = (0.5, 0.75, 0.5)
_MIN_KNOWN = 0.25  # share of the scans with a range in a direction that is compared
_MIN_DIRECTIONS = 20  # with a range in both scans
_MIN_PLANE_RMS = 0.05  # of unit directions off a plane: less is a 2D scan


class ScanSample(NamedTuple):
    """A scan number and a subset of its hits (n, 3), rotated to the axes of the robot."""

    scan: int
    points: NDArray[np.float32]


def sample_hits(recording: Recording, scan: int, R: Float) -> ScanSample:
    """Sample the hits of a scan, rotated by R (3, 3)."""
    beams = recording.beams_of(scan)
    points = recording.points[beams][recording.hit[beams]]
    points = points[:: max(1, len(points) // _MAX_POINTS)]
    return ScanSample(scan, (points @ R.T).astype(np.float32))


def is_3d_sweep(points: NDArray[np.float32]) -> bool:
    """True if the directions of points (n, 3) do not lie in a plane through the sensor."""
    if len(points) < 3:
        return False
    directions = points / np.linalg.norm(points, axis=1)[:, None]
    smallest = np.linalg.eigvalsh(directions.T.astype(np.float64) @ directions / len(points))[0]
    return bool(np.sqrt(max(smallest, 0.0)) > _MIN_PLANE_RMS)


def fit_ground_and_ceiling(points: NDArray[np.float32]) -> Planes | None:
    """Fit ground and ceiling to points (n, 3) beyond the robot.

    Returns:
        Coefficients of both planes, the ceiling at infinity where there is none; None without
        ground.
    """
    distance = np.hypot(points[:, 0], points[:, 1])
    beyond = points[(distance >= BODY_RADIUS) & (distance < PROFILE_RANGE)].astype(np.float64)
    ground = _fit_level_plane(beyond[beyond[:, 2] < -_LAYER])
    ceiling = _fit_level_plane(beyond[beyond[:, 2] > _LAYER])
    if ground is None:
        return None
    return ground, np.array([0.0, 0.0, np.inf]) if ceiling is None else ceiling


def _fit_level_plane(points: Float) -> Float | None:
    """Fit the nearly level plane with most of points (n, 3); None for few points."""
    if len(points) < MIN_SCANS:
        return None
    bins = np.floor(points[:, 2] / _LAYER).astype(np.intp)
    lowest = int(bins.min())
    mode = int(np.convolve(np.bincount(bins - lowest), np.ones(3))[1:-1].argmax())
    plane = np.array([0.0, 0.0, (lowest + mode + 0.5) * _LAYER])
    A = np.column_stack([points[:, :2], np.ones(len(points))])
    for _ in range(3):
        inliers = np.abs(points[:, 2] - A @ plane) < PLANE_MARGIN
        if np.count_nonzero(inliers) < 3:
            break
        plane = np.linalg.lstsq(A[inliers], points[inliers, 2], rcond=None)[0]
    return plane


def select_distinct_scans(samples: list[ScanSample], planes: Planes) -> list[int]:
    """Select scans whose range profile differs from the one before; [] where all look alike."""
    selected: list[tuple[int, Float]] = []
    for sample in samples:
        profile = _range_profile(sample.points, planes)
        if not selected or _is_other_position(selected[-1][1], profile):
            selected.append((sample.scan, profile))
    # a standing robot sees changing people in front of constant walls
    stacked = np.stack([profile for _, profile in selected])
    known = np.count_nonzero(np.isfinite(stacked), axis=0) >= _MIN_KNOWN * len(selected)
    stacked = stacked[:, known]
    same = np.abs(stacked - np.nanmedian(stacked, axis=0)) < _MAX_REPETITION[0]
    repeated = np.count_nonzero(same.mean(axis=0) >= _MAX_REPETITION[1])
    return [scan for scan, _ in selected] if repeated <= _MAX_REPETITION[2] * known.sum() else []


def _is_other_position(before: Float, profile: Float) -> bool:
    """True if two range profiles differ by more than moving objects explain."""
    change = np.abs(profile - before)
    change = change[np.isfinite(change)]
    if len(change) < _MIN_DIRECTIONS:
        return False
    return bool(np.mean(change > _MIN_CHANGE[0]) > _MIN_CHANGE[1])


def _range_profile(points: NDArray[np.float32], planes: Planes) -> Float:
    """Median range of the obstacles in each direction bin beyond the robot; NaN: none."""
    x, y, z = points.astype(np.float64).T
    range = np.linalg.norm(points, axis=1)
    (a, b, c), (p, q, r) = planes
    is_obstacle = (range > BODY_RADIUS) & (z - a * x - b * y - c > PLANE_MARGIN)
    is_obstacle &= p * x + q * y + r - z > PLANE_MARGIN
    x, y, z, range = x[is_obstacle], y[is_obstacle], z[is_obstacle], range[is_obstacle]
    columns, rows = round(2 * np.pi / _BIN), round(np.pi / _BIN)
    column = np.minimum((np.arctan2(y, x) + np.pi) / _BIN, columns - 1).astype(np.intp)
    row = np.minimum((np.arcsin(z / range) + np.pi / 2) / _BIN, rows - 1).astype(np.intp)
    direction = row * columns + column
    order = np.lexsort((range, direction))
    counts = np.bincount(direction, minlength=rows * columns)
    middle = np.cumsum(counts) - counts + counts // 2
    out = np.full(rows * columns, np.nan)
    out[counts > 0] = range[order][middle[counts > 0]]
    return out
