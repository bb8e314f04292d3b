"""What a lidar sees of its own robot: returns from one place in its frame, wherever it goes.

Level ground, ceilings, walls along the way and guard rails come back from one place, too. They go
on beyond the robot: ground and ceilings in all directions, the others ahead and behind.

What beams meet of the robot itself: always there, and at the same distance, wherever it goes.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.recording import Recording
from stillmap.preprocessing.ground_segmentation import (
    BODY_RADIUS,
    MIN_SCANS,
    PLANE_MARGIN,
    PROFILE_RANGE,
    Planes,
    fit_ground_and_ceiling,
    is_3d_sweep,
    sample_hits,
    select_distinct_scans,
)
from stillmap.preprocessing.options import MAX_PLAUSIBLE_RANGE

Float = NDArray[np.float64]

Bool = NDArray[np.bool_]

Index = NDArray[np.intp]

SelfSector = tuple[
    int, int, float
]  # first and last beam, and up to where their readings are its own

_EDGE = 0.1  # m, of a cell in which returns are from one place

_ALWAYS = 0.9  # share of places in which something comes back from there

_OFTEN = 0.25  # the same of a cell itself; beside it noise may take what is at its border

_HELD = 2.0  # m: so near to the sensor the robot must come that holds it

_LOOKED_AT = 200  # scans

_EVENLY = 50  # of these, as the recording goes on

_LINE = 0.2  # m, cells of the profile across a direction

_GOES_ON = (4, 0.3)  # metres of eight that are filled, and in which share of places


@dataclass(frozen=True, eq=False)
class SelfMask:
    """What a sensor sees of its robot.

    Attributes:
        cells: (n, n, n) whether returns from there are the robot's own; x, y, z of the sensor
            turned as the robot is, from -REACH on, of _EDGE.
        R: (3, 3) from the sensor's axes to the robot's.
    """

    cells: Bool
    R: Float

    def find_self_returns(self, points: NDArray[np.float32], hit: Bool) -> Index:
        """Which of points (n, 3) in the sensor's frame are of the robot itself."""
        near = np.flatnonzero(hit & _within(points, 2 * BODY_RADIUS))
        turned = points[near].astype(np.float64) @ self.R.T
        inside = _within(turned, BODY_RADIUS)
        near, cell = near[inside], _cells(turned[inside], _EDGE)
        return np.asarray(near[self.cells[tuple(cell.T)]])


def remove_self_returns(recording: Recording) -> Recording:
    """The recording without returns of the robot itself: they are unusable.

    `source["own_body"]` says of which sensors, how many beams, and where: from the sensor, along
    the robot's axes. Scans need not have the same beams, nor any order of them.

    Args:
        recording: 3D. It comes back as it is where nothing of the robot shows.
    """
    bodies = {k: find_self_mask(recording, k) for k in range(len(recording.T_base_sensor))}
    found = {k: body for k, body in bodies.items() if body is not None}
    if not found:
        return recording
    points = arrays.copy(recording.points, recording.scratch)
    hit = arrays.copy(recording.hit, recording.scratch)
    counts = dict.fromkeys(found, 0)
    for scan in arrays.release_periodically(
        range(recording.n_scans), lambda: _let_go(points, hit, recording)
    ):
        sensor, beams = int(recording.sensor[scan]), recording.beams_of(scan)
        if sensor in found:
            own = beams.start + found[sensor].find_self_returns(points[beams], hit[beams])
            points[own], hit[own] = np.nan, False
            counts[sensor] += len(own)
    noted = [{"sensor": k, "beams": counts[k], **_box(body.cells)} for k, body in found.items()]
    source = {**recording.source, "own_body": noted}
    return replace(recording, points=points, hit=hit, source=source)


def _let_go(points: NDArray[np.float32], hit: Bool, recording: Recording) -> None:
    arrays.release_pages(points)
    arrays.release_pages(hit)
    recording.release_pages()


def find_self_mask(recording: Recording, sensor: int) -> SelfMask | None:
    """What a sensor sees of its robot; None where nothing shows.

    Only a robot that moves far enough shows what moves with it, and only where the ground is seen.

    Args:
        recording: 3D.
        sensor: its number.
    """
    R = recording.T_base_sensor[sensor][:3, :3]
    scans = np.flatnonzero(recording.sensor == sensor)
    if len(scans) < MIN_SCANS:
        return None
    scans = scans[np.unique(np.linspace(0, len(scans) - 1, _LOOKED_AT).astype(np.intp))]
    looks = [sample_hits(recording, scan, R) for scan in recording.iter_scans(scans.tolist())]
    levels = fit_ground_and_ceiling(np.concatenate([look.points for look in looks]))
    if levels is None or not any(is_3d_sweep(look.points) for look in looks):
        return None
    places = select_distinct_scans(looks, levels)
    if len(places) < MIN_SCANS:
        return None
    # places that differ may lie close together, as where a robot turns round in a niche
    evenly = scans[:: max(1, len(scans) // _EVENLY)].tolist()
    cells = _between(levels, PLANE_MARGIN)
    for some in (places, evenly):
        if cells.any():
            cells &= _always(recording, some, R)
        if cells.any():
            cells &= ~_goes_on(recording, some, R)
    cells = _held(cells)
    return SelfMask(cells & _between(levels, PLANE_MARGIN - _EDGE), R) if cells.any() else None


def _held(cells: Bool) -> Bool:
    """Cells (n, n, n) and those around, of parts that come near the sensor.

    A car that goes beside for a while, as fast, comes back from one place, too.
    """
    import scipy  # its parts load when they are first used

    around = scipy.ndimage.binary_dilation(cells, np.ones((3, 3, 3), np.bool_))
    parts, count = scipy.ndimage.label(around, np.ones((3, 3, 3)))
    middle = _EDGE * (np.arange(len(cells)) + 0.5) - BODY_RADIUS
    near = np.hypot(middle[:, None], middle[None, :]) < _HELD
    held = np.zeros(count + 1, np.bool_)
    held[np.unique(parts[near])] = True
    held[0] = False
    return np.asarray(held[parts])


def _between(levels: Planes, off: float) -> Bool:
    """(n, n, n) which cells are so far above the ground and below the ceiling."""
    middle = _EDGE * (np.arange(round(2 * BODY_RADIUS / _EDGE)) + 0.5) - BODY_RADIUS
    x, y, z = np.meshgrid(middle, middle, middle, indexing="ij", sparse=True)
    (a, b, c), (p, q, r) = levels
    return np.asarray((z - (a * x + b * y + c) > off) & (p * x + q * y + r - z > off))


def _hits(recording: Recording, scan: int, R: Float, reach: float) -> Float:
    """All that may be within a reach along each axis of the robot, and some more."""
    beams = recording.beams_of(scan)
    points = recording.points[beams]
    near = recording.hit[beams] & _within(points, 2.0 * reach)  # more than a cube's diagonal
    return points[near].astype(np.float64) @ R.T


def _within(points: NDArray[np.floating[Any]], reach: float) -> Bool:
    """(n,) which points (n, 3) are within a reach along each axis."""
    x, y, z = points.T
    return np.asarray((np.abs(x) < reach) & (np.abs(y) < reach) & (np.abs(z) < reach))


def _and_beside(cells: Bool, axes: tuple[int, ...]) -> Bool:
    """Cells and those beside them along all of some axes."""
    for axis in axes:
        out, before = np.moveaxis(cells.copy(), axis, 0), np.moveaxis(cells, axis, 0)
        out[1:] |= before[:-1]
        out[:-1] |= before[1:]
        cells = np.moveaxis(out, 0, axis)
    return cells


def _always(recording: Recording, scans: list[int], R: Float) -> Bool:
    """(n, n, n) cells from which something comes back in nearly all scans."""
    n = round(2 * BODY_RADIUS / _EDGE)
    itself, near = np.zeros((n, n, n), np.int16), np.zeros((n, n, n), np.int16)
    for scan in recording.iter_scans(scans):
        points = _hits(recording, scan, R, BODY_RADIUS)
        points = points[_within(points, BODY_RADIUS)]
        here = np.zeros((n, n, n), np.bool_)
        here[tuple(_cells(points, _EDGE).T)] = True
        itself += here
        near += _and_beside(here, (0, 1, 2))
    return np.asarray((near >= _ALWAYS * len(scans)) & (itself >= _OFTEN * len(scans)))


def _goes_on(recording: Recording, scans: list[int], R: Float) -> Bool:
    """(n, n, n) cells on a line along an axis on which something goes on beyond the robot."""
    m, each = round(2 * BODY_RADIUS / _LINE), round(_LINE / _EDGE)
    ahead, aside = np.zeros((m, m), np.int32), np.zeros((m, m), np.int32)
    for scan in recording.iter_scans(scans):
        points = _hits(recording, scan, R, PROFILE_RANGE)
        ahead += _filled(points[:, 0], points[:, 1:])
        aside += _filled(points[:, 1], points[:, ::2])
    least = _GOES_ON[1] * len(scans)
    x, y = ((count >= least).repeat(each, axis=0).repeat(each, axis=1) for count in (ahead, aside))
    return np.asarray(x[None, :, :] | y[:, None, :])


def _filled(ahead: Float, across: Float) -> Bool:
    """(m, m) where the profile across (n, 2) goes on ahead or behind, beyond the robot."""
    m, metres = round(2 * BODY_RADIUS / _LINE), round(PROFILE_RANGE - BODY_RADIUS)
    inside = (np.abs(ahead) >= BODY_RADIUS) & (np.abs(ahead) < PROFILE_RANGE)
    inside &= (np.abs(across[:, 0]) < BODY_RADIUS) & (np.abs(across[:, 1]) < BODY_RADIUS)
    at = np.floor(np.abs(ahead[inside]) - BODY_RADIUS).astype(np.intp)
    filled = np.zeros((2, metres, m, m), np.bool_)
    filled[((ahead[inside] < 0).astype(np.intp), at, *_cells(across[inside], _LINE).T)] = True
    filled = _and_beside(filled, (2, 3))
    return np.asarray((filled.sum(axis=1) >= _GOES_ON[0]).any(axis=0))


def _cells(places: Float, edge: float) -> Index:
    """(n, d) numbers of the cells in which places (n, d) within REACH lie."""
    last = round(2 * BODY_RADIUS / edge) - 1
    return np.clip(np.floor((places + BODY_RADIUS) / edge).astype(np.intp), 0, last)


def _box(cells: Bool) -> dict[str, Any]:
    """Corners of what is the robot's own, metres."""
    at = np.argwhere(cells)
    low, high = at.min(axis=0) * _EDGE - BODY_RADIUS, (at.max(axis=0) + 1) * _EDGE - BODY_RADIUS
    return {"low": np.round(low, 3).tolist(), "high": np.round(high, 3).tolist()}


_FARTHEST = 1.0  # m: robots are not larger

_SAME = (0.03, 0.01)  # m and share of the range by which such readings differ

_ALWAYS_2D = 0.75  # share of the scans in which a beam ends there

_MOVING = 0.3  # of usual beams: while the robot moves, hardly any range is measured again

_AROUND = 2  # beams beside such ones that graze what they hit

_BEHIND = 0.1  # m behind it: an edge is measured too far


def find_self_sectors(ranges: NDArray[np.float32], shortest: float) -> tuple[SelfSector, ...]:
    """The beams that end on the robot itself.

    Only a robot that moves shows what moves with it: of a laser that stands all beams end in the
    same places.

    Args:
        ranges: (T, n) metres, one column per beam direction.
        shortest: m; what is nearer is no reading.
    """
    T, n = ranges.shape
    if T < 20 or n < 2:
        return ()
    # codes for no return are as large as floating point numbers can be
    real = np.where(
        (ranges >= shortest) & (ranges < MAX_PLAUSIBLE_RANGE), ranges, np.float32(np.inf)
    )
    middle = np.median(real, axis=0)
    with np.errstate(invalid="ignore"):
        away = np.abs(real - middle)
    again = np.mean(away < _SAME[0] + _SAME[1] * middle, axis=0)
    measured = np.isfinite(middle)
    if not measured.any() or np.median(again[measured]) > _MOVING:
        return ()
    own = np.flatnonzero((again >= _ALWAYS_2D) & (middle < _FARTHEST))
    groups = np.split(own, np.flatnonzero(np.diff(own) > 2 * _AROUND) + 1) if len(own) else []
    return tuple(
        (
            max(int(group[0]) - _AROUND, 0),
            min(int(group[-1]) + _AROUND, n - 1),
            round(float(middle[group].max()) + _BEHIND, 3),
        )
        for group in groups
    )


def min_ranges(parts: Any, n: int) -> NDArray[np.float32]:
    """(n,) metres: readings below are of the robot itself."""
    out = np.zeros(n, np.float32)
    for first, last, limit in parts:
        out[first : last + 1] = np.maximum(out[first : last + 1], np.float32(limit))
    return out
