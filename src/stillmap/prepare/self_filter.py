"""Self filter: returns from the robot itself are constant in the sensor frame while it moves.

In 3D, level ground, ceilings, walls and guard rails along the path are constant as well. They
extend beyond the robot (ground and ceilings everywhere, the others ahead and behind) and are kept.
That scans were taken at different positions shows, without poses, in range profiles of the
obstacles between ground and ceiling.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.core.source import BodyBox

Planes = tuple[Float, Float]  # ground and ceiling, each (a, b, c) of z = a x + b y + c

_CELL = 0.1  # m
_MIN_SHARE_NEAR = 0.9  # share of scans with a return in a cell or its neighbours
_MIN_SHARE_IN_CELL = 0.25  # share of scans with a return in the cell itself: noise crosses borders
_MAX_GAP_TO_SENSOR = 2.0  # m: the part that carries the sensor comes this near
_MAX_SCANS = 200  # sampled scans
_MAX_EVEN_SCANS = 50  # of these, evenly spaced in time
_PROFILE_CELL = 0.2  # m, of the cross section along an axis
_MIN_EXTENSION = (4, 0.3)  # filled metres of eight, and share of scans

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


@dataclass(frozen=True, eq=False)
class SelfMask:
    """Cells around a sensor that hold the robot itself.

    Attributes:
        cells: (n, n, n) mask in x, y, z of the robot's axes around the sensor, from -BODY_RADIUS
            on, edge `_CELL`.
        R: (3, 3) rotation from the sensor's axes to the robot's.
    """

    cells: Bool
    R: Float

    def find_self_returns(self, points: Float32, hit: Bool) -> Index:
        """Indices of points (n, 3) in the sensor frame that are returns from the robot."""
        near = np.flatnonzero(hit & _is_within(points, 2 * BODY_RADIUS))
        rotated = points[near].astype(np.float64) @ self.R.T
        inside = _is_within(rotated, BODY_RADIUS)
        near, cell = near[inside], _cell_indices(rotated[inside], _CELL)
        return np.asarray(near[self.cells[tuple(cell.T)]])


def remove_self_returns(recording: Recording) -> Recording:
    """Mark returns from the robot itself as unusable.

    `source.self_filter` lists sensors, counts of beams, and bounding boxes around the sensor
    along the robot's axes. Scans may differ in the number and order of beams.

    Args:
        recording: 3D. Returned unchanged where no returns from the robot are found.
    """
    masks = {k: find_self_mask(recording, k) for k in range(len(recording.T_base_sensor))}
    known = {k: mask for k, mask in masks.items() if mask is not None}
    if not known:
        return recording
    points, hit = recording.copy_beams()
    counts = dict.fromkeys(known, 0)
    for scan in recording.iter_scans(range(recording.n_scans), points, hit):
        sensor, beams = int(recording.sensor[scan]), recording.beams_of(scan)
        if sensor in known:
            removed = beams.start + known[sensor].find_self_returns(points[beams], hit[beams])
            points[removed], hit[removed] = np.nan, False
            counts[sensor] += len(removed)
    boxes = [BodyBox(k, counts[k], *_bounding_box(mask.cells)) for k, mask in known.items()]
    source = replace(recording.source, self_filter=boxes)
    return replace(recording, points=points, hit=hit, source=source)


def find_self_mask(recording: Recording, sensor: int) -> SelfMask | None:
    """Find the cells of the robot around a sensor; None where there is no evidence.

    It takes a robot that moves, and visible ground.

    Args:
        recording: 3D.
        sensor: index of the sensor.
    """
    R = recording.T_base_sensor[sensor][:3, :3]
    scans = np.flatnonzero(recording.sensor == sensor)
    if len(scans) < MIN_SCANS:
        return None
    scans = scans[np.unique(np.linspace(0, len(scans) - 1, _MAX_SCANS).astype(np.intp))]
    samples = [sample_hits(recording, scan, R) for scan in recording.iter_scans(scans.tolist())]
    planes = fit_ground_and_ceiling(np.concatenate(samples))
    if planes is None or not any(map(is_3d_sweep, samples)):
        return None
    distinct = select_distinct_scans(scans.tolist(), samples, planes)
    if len(distinct) < MIN_SCANS:
        return None
    # distinct scans may lie close together, as where the robot turns round in a niche
    evenly = scans[:: max(1, len(scans) // _MAX_EVEN_SCANS)].tolist()
    cells = _between_planes(planes, PLANE_MARGIN)
    for subset in (distinct, evenly):
        if cells.any():
            cells &= _find_constant_cells(recording, subset, R)
        if cells.any():
            cells &= ~_find_extended_cells(recording, subset, R)
    cells = _keep_near_sensor(cells)
    if not cells.any():
        return None
    return SelfMask(cells & _between_planes(planes, PLANE_MARGIN - _CELL), R)


def _keep_near_sensor(cells: Bool) -> Bool:
    """Dilate cells (n, n, n), and keep the connected components that come near the sensor.

    A car that drives alongside at the same speed is constant for a while, too.
    """
    dilated = scipy.ndimage.binary_dilation(cells, np.ones((3, 3, 3), np.bool_))
    components, count = scipy.ndimage.label(dilated, np.ones((3, 3, 3), np.bool_))
    middle = _CELL * (np.arange(len(cells)) + 0.5) - BODY_RADIUS
    near = np.hypot(middle[:, None], middle[None, :]) < _MAX_GAP_TO_SENSOR
    kept = np.zeros(count + 1, np.bool_)
    kept[np.unique(components[near])] = True
    kept[0] = False
    return np.asarray(kept[components])


def _between_planes(planes: Planes, margin: float) -> Bool:
    """(n, n, n) mask of cells more than a margin above the ground and below the ceiling."""
    middle = _CELL * (np.arange(round(2 * BODY_RADIUS / _CELL)) + 0.5) - BODY_RADIUS
    x, y, z = np.meshgrid(middle, middle, middle, indexing="ij", sparse=True)
    (a, b, c), (p, q, r) = planes
    return np.asarray((z - (a * x + b * y + c) > margin) & (p * x + q * y + r - z > margin))


def _hits_near(recording: Recording, scan: int, R: Float, distance: float) -> Float:
    """Hits (n, 3) along the robot's axes, at least all within a distance along each axis."""
    beams = recording.beams_of(scan)
    points = recording.points[beams]
    near = recording.hit[beams] & _is_within(points, 2.0 * distance)  # more than a cube's diagonal
    return points[near].astype(np.float64) @ R.T


def _is_within(points: NDArray[np.floating[Any]], distance: float) -> Bool:
    """(n,) mask of points (n, 3) within a distance along each axis."""
    x, y, z = points.T
    return np.asarray((np.abs(x) < distance) & (np.abs(y) < distance) & (np.abs(z) < distance))


def _dilate(cells: Bool, axes: Iterable[int]) -> Bool:
    """Cells and their neighbours along some axes; a hundred times as fast as `scipy.ndimage`."""
    for axis in axes:
        out, before = np.moveaxis(cells.copy(), axis, 0), np.moveaxis(cells, axis, 0)
        out[1:] |= before[:-1]
        out[:-1] |= before[1:]
        cells = np.moveaxis(out, 0, axis)
    return cells


def _find_constant_cells(recording: Recording, scans: list[int], R: Float) -> Bool:
    """(n, n, n) mask of cells with returns in nearly all scans."""
    n = round(2 * BODY_RADIUS / _CELL)
    in_cell, near_cell = np.zeros((n, n, n), np.int16), np.zeros((n, n, n), np.int16)
    for scan in recording.iter_scans(scans):
        points = _hits_near(recording, scan, R, BODY_RADIUS)
        points = points[_is_within(points, BODY_RADIUS)]
        occupied = np.zeros((n, n, n), np.bool_)
        occupied[tuple(_cell_indices(points, _CELL).T)] = True
        in_cell += occupied
        near_cell += _dilate(occupied, (0, 1, 2))
    is_near = near_cell >= _MIN_SHARE_NEAR * len(scans)
    return np.asarray(is_near & (in_cell >= _MIN_SHARE_IN_CELL * len(scans)))


def _find_extended_cells(recording: Recording, scans: list[int], R: Float) -> Bool:
    """(n, n, n) mask of cells in line, along x or y, with structure beyond the robot."""
    m, factor = round(2 * BODY_RADIUS / _PROFILE_CELL), round(_PROFILE_CELL / _CELL)
    along_x, along_y = np.zeros((m, m), np.int32), np.zeros((m, m), np.int32)
    for scan in recording.iter_scans(scans):
        points = _hits_near(recording, scan, R, PROFILE_RANGE)
        along_x += _extended_profile(points[:, 0], points[:, 1:])
        along_y += _extended_profile(points[:, 1], points[:, ::2])
    min_count = _MIN_EXTENSION[1] * len(scans)
    x, y = (
        (count >= min_count).repeat(factor, axis=0).repeat(factor, axis=1)
        for count in (along_x, along_y)
    )
    return np.asarray(x[None, :, :] | y[:, None, :])


def _extended_profile(along: Float, across: Float) -> Bool:
    """(m, m) mask of the cross section (of coordinates (n, 2)) that extends beyond the robot."""
    m, metres = round(2 * BODY_RADIUS / _PROFILE_CELL), round(PROFILE_RANGE - BODY_RADIUS)
    inside = (np.abs(along) >= BODY_RADIUS) & (np.abs(along) < PROFILE_RANGE)
    inside &= (np.abs(across[:, 0]) < BODY_RADIUS) & (np.abs(across[:, 1]) < BODY_RADIUS)
    metre = np.floor(np.abs(along[inside]) - BODY_RADIUS).astype(np.intp)
    filled = np.zeros((2, metres, m, m), np.bool_)
    side = (along[inside] < 0).astype(np.intp)
    filled[(side, metre, *_cell_indices(across[inside], _PROFILE_CELL).T)] = True
    filled = _dilate(filled, (2, 3))
    return np.asarray((filled.sum(axis=1) >= _MIN_EXTENSION[0]).any(axis=0))


def _cell_indices(positions: Float, edge: float) -> Index:
    """(n, d) cell indices of positions (n, d) within BODY_RADIUS."""
    last = round(2 * BODY_RADIUS / edge) - 1
    return np.clip(np.floor((positions + BODY_RADIUS) / edge).astype(np.intp), 0, last)


def _bounding_box(cells: Bool) -> tuple[Any, Any]:
    """Low and high corner of the occupied cells, metres."""
    index = np.argwhere(cells)
    low = index.min(axis=0) * _CELL - BODY_RADIUS
    high = (index.max(axis=0) + 1) * _CELL - BODY_RADIUS
    return tuple(np.round(low, 3).tolist()), tuple(np.round(high, 3).tolist())


def sample_hits(recording: Recording, scan: int, R: Float) -> Float32:
    """A subset of the hits (n, 3) of a scan, rotated by R (3, 3) to the axes of the robot."""
    beams = recording.beams_of(scan)
    points = recording.points[beams][recording.hit[beams]]
    points = points[:: max(1, len(points) // _MAX_POINTS)]
    return (points @ R.T).astype(np.float32)


def is_3d_sweep(points: Float32) -> bool:
    """True if the directions of points (n, 3) do not lie in a plane through the sensor."""
    if len(points) < 3:
        return False
    directions = points / np.linalg.norm(points, axis=1)[:, None]
    smallest = np.linalg.eigvalsh(directions.T.astype(np.float64) @ directions / len(points))[0]
    return bool(np.sqrt(max(smallest, 0.0)) > _MIN_PLANE_RMS)


def fit_ground_and_ceiling(points: Float32) -> Planes | None:
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


def select_distinct_scans(scans: list[int], samples: list[Float32], planes: Planes) -> list[int]:
    """Select scans whose range profile differs from the one before; [] where all look alike."""
    selected: list[tuple[int, Float]] = []
    for scan, points in zip(scans, samples, strict=True):
        profile = _range_profile(points, planes)
        if not selected or _is_other_position(selected[-1][1], profile):
            selected.append((scan, profile))
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


def _range_profile(points: Float32, planes: Planes) -> Float:
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
