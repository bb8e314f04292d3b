"""What a lidar sees of its own robot: returns from one place in its frame, wherever it goes.

Level ground, ceilings, walls along the way and guard rails come back from one place, too. They go
on beyond the robot: ground and ceilings in all directions, the others ahead and behind.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.recording import spool
from stillmap.recording.model import Recording

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

_REACH = 4.0  # m: what is farther along an axis of the sensor is no part of the robot
_BEYOND = 12.0  # m: up to there is looked for how things go on
_EDGE = 0.1  # m, of a cell in which returns are from one place
_ALWAYS = 0.9  # share of places in which something comes back from there
_HELD = 2.0  # m: so near to the sensor the robot must come that holds it
_OFTEN = 0.25  # the same of a cell itself; beside it noise may take what is at its border
_LOOKED_AT = 200  # scans
_EVENLY = 50  # of these, as the recording goes on
_POINTS = 8000  # of each of them that tell how the surroundings look
_PLACES = 12  # fewer show nothing
_DIRECTION = np.radians(5.0)  # in which surroundings are compared
_MOVED = (1.0, 0.3)  # m by which things are nearer or farther elsewhere, and in which share
_AGAIN = (0.5, 0.75, 0.5)  # m by which readings are the same, mostly; so are few directions
_COMPARED = 20  # directions at least
_FLAT = 0.05  # rms of directions off a plane: a sweep is no fan
_SURFACE = 0.25  # m to either side of the ground and the ceiling: theirs
_LINE = 0.2  # m, cells of the profile across a direction
_GOES_ON = (4, 0.3)  # metres of eight that are filled, and in which share of places
_Levels = tuple[Float, Float]


@dataclass(frozen=True, eq=False)
class Body:
    """What a sensor sees of its robot.

    Attributes:
        cells: (n, n, n) whether returns from there are the robot's own; x, y, z of the sensor
            turned as the robot is, from -_REACH on, of _EDGE.
        R: (3, 3) from the sensor's axes to the robot's.
    """

    cells: Bool
    R: Float

    def own(self, points: NDArray[np.float32], hit: Bool) -> Index:
        """Which of points (n, 3) in the sensor's frame are of the robot itself."""
        near = np.flatnonzero(hit & (np.abs(points) < 2 * _REACH).all(axis=1))
        turned = points[near].astype(np.float64) @ self.R.T
        inside = (np.abs(turned) < _REACH).all(axis=1)
        near, cell = near[inside], _cells(turned[inside], _EDGE)
        return np.asarray(near[self.cells[tuple(cell.T)]])


class _Place(NamedTuple):
    """A scan and some of its hits, turned as the robot is."""

    scan: int
    points: NDArray[np.float32]


def left_out(recording: Recording) -> Recording:
    """The recording without returns of the robot itself: they are unusable.

    `source["own_body"]` says of which sensors, how many beams, and where in the sensor's place
    and the robot's axes. What is found is the same whatever the order of beams.

    Args:
        recording: 3D. It comes back as it is where nothing of the robot shows.
    """
    bodies = {k: find(recording, k) for k in range(len(recording.T_base_sensor))}
    found = {k: body for k, body in bodies.items() if body is not None}
    if not found:
        return recording
    points = spool.copied(recording.points, recording.scratch)
    hit = spool.copied(recording.hit, recording.scratch)
    counts = dict.fromkeys(found, 0)
    for scan in spool.in_turn(range(recording.n_scans), lambda: _let_go(points, hit, recording)):
        sensor, beams = int(recording.sensor[scan]), recording.beams_of(scan)
        if sensor in found:
            own = beams.start + found[sensor].own(points[beams], hit[beams])
            points[own], hit[own] = np.nan, False
            counts[sensor] += len(own)
    noted = [{"sensor": k, "beams": counts[k], **_box(body.cells)} for k, body in found.items()]
    source = {**recording.source, "own_body": noted}
    return replace(recording, points=points, hit=hit, source=source)


def _let_go(points: NDArray[np.float32], hit: Bool, recording: Recording) -> None:
    spool.let_go(points)
    spool.let_go(hit)
    recording.let_go()


def find(recording: Recording, sensor: int) -> Body | None:
    """What a sensor sees of its robot; None where nothing shows.

    Only a robot that moves far enough shows what moves with it, and only where the ground is seen.

    Args:
        recording: 3D.
        sensor: its number.
    """
    R = recording.T_base_sensor[sensor][:3, :3]
    scans = np.flatnonzero(recording.sensor == sensor)
    if len(scans) < _PLACES:
        return None
    scans = scans[np.unique(np.linspace(0, len(scans) - 1, _LOOKED_AT).astype(np.intp))]
    looks = [_look(recording, scan, R) for scan in recording.in_turn(scans.tolist())]
    levels = _levels(np.concatenate([look.points for look in looks]))
    if levels is None or not any(_is_sweep(look.points) for look in looks):
        return None
    places = _different(looks, levels)
    if len(places) < _PLACES:
        return None
    # places that differ may lie close together, as where a robot turns round in a niche
    evenly = scans[:: max(1, len(scans) // _EVENLY)].tolist()
    cells = _between(levels, _SURFACE)
    for some in (places, evenly):
        if cells.any():
            cells &= _always(recording, some, R)
        if cells.any():
            cells &= ~_goes_on(recording, some, R)
    cells = _held(cells)
    return Body(cells & _between(levels, _SURFACE - _EDGE), R) if cells.any() else None


def _held(cells: Bool) -> Bool:
    """Cells (n, n, n) and those around, of parts that come near the sensor.

    A car that goes beside for a while, as fast, comes back from one place, too.
    """
    import scipy  # its parts load when they are first used

    around = scipy.ndimage.binary_dilation(cells, np.ones((3, 3, 3), np.bool_))
    parts, count = scipy.ndimage.label(around, np.ones((3, 3, 3)))
    middle = _EDGE * (np.arange(len(cells)) + 0.5) - _REACH
    near = np.hypot(middle[:, None], middle[None, :]) < _HELD
    held = np.zeros(count + 1, np.bool_)
    held[np.unique(parts[near])] = True
    held[0] = False
    return np.asarray(held[parts])


def _look(recording: Recording, scan: int, R: Float) -> _Place:
    beams = recording.beams_of(scan)
    points = recording.points[beams][recording.hit[beams]]
    points = points[:: max(1, len(points) // _POINTS)]
    return _Place(scan, (points @ R.T).astype(np.float32))


def _is_sweep(points: NDArray[np.float32]) -> bool:
    """Whether the directions of points (n, 3) leave every plane through the sensor."""
    if len(points) < 3:
        return False
    directions = points / np.linalg.norm(points, axis=1)[:, None]
    least = np.linalg.eigvalsh(directions.T.astype(np.float64) @ directions / len(points))[0]
    return bool(np.sqrt(max(least, 0.0)) > _FLAT)


def _levels(points: NDArray[np.float32]) -> _Levels | None:
    """The ground and the ceiling, z = a x + b y + c, from points (n, 3) beyond the robot.

    The ceiling is at infinity where there is nothing above; None where no ground is.
    """
    away = np.hypot(points[:, 0], points[:, 1])
    beyond = points[(away >= _REACH) & (away < _BEYOND)].astype(np.float64)
    ground = _level(beyond[beyond[:, 2] < -_EDGE])
    ceiling = _level(beyond[beyond[:, 2] > _EDGE])
    if ground is None:
        return None
    return ground, np.array([0.0, 0.0, np.inf]) if ceiling is None else ceiling


def _level(points: Float) -> Float | None:
    """The nearly level plane that most of points (n, 3) are on; None for a few."""
    if len(points) < _PLACES:
        return None
    bins = np.floor(points[:, 2] / _EDGE).astype(np.intp)
    lowest = int(bins.min())
    most = int(np.convolve(np.bincount(bins - lowest), np.ones(3))[1:-1].argmax())
    plane = np.array([0.0, 0.0, (lowest + most + 0.5) * _EDGE])
    flat = np.column_stack([points[:, :2], np.ones(len(points))])
    for _ in range(3):
        on = np.abs(points[:, 2] - flat @ plane) < _SURFACE
        if np.count_nonzero(on) < 3:
            break
        plane = np.linalg.lstsq(flat[on], points[on, 2], rcond=None)[0]
    return plane


def _between(levels: _Levels, off: float) -> Bool:
    """(n, n, n) which cells are so far above the ground and below the ceiling."""
    middle = _EDGE * (np.arange(round(2 * _REACH / _EDGE)) + 0.5) - _REACH
    x, y, z = np.meshgrid(middle, middle, middle, indexing="ij", sparse=True)
    (a, b, c), (p, q, r) = levels
    return np.asarray((z - (a * x + b * y + c) > off) & (p * x + q * y + r - z > off))


def _different(looks: list[_Place], levels: _Levels) -> list[int]:
    """Scans from places that look different, each from the one before; [] where all look alike."""
    seen: list[tuple[int, Float]] = []
    for look in looks:
        ranges = _ranges(look.points, levels)
        if not seen or _elsewhere(seen[-1][1], ranges):
            seen.append((look.scan, ranges))
    # a robot that stands in a crowd sees different people before the same walls
    stacked = np.stack([ranges for _, ranges in seen])
    known = np.count_nonzero(np.isfinite(stacked), axis=0) >= _OFTEN * len(seen)
    stacked = stacked[:, known]
    same = np.abs(stacked - np.nanmedian(stacked, axis=0)) < _AGAIN[0]
    again = np.count_nonzero(same.mean(axis=0) >= _AGAIN[1])
    return [scan for scan, _ in seen] if again <= _AGAIN[2] * known.sum() else []


def _elsewhere(before: Float, ranges: Float) -> bool:
    """Whether ranges by direction are seen from another place."""
    change = np.abs(ranges - before)
    change = change[np.isfinite(change)]
    return len(change) >= _COMPARED and bool(np.mean(change > _MOVED[0]) > _MOVED[1])


def _ranges(points: NDArray[np.float32], levels: _Levels) -> Float:
    """Median range in each direction of what stands on the ground farther away; NaN: nothing."""
    x, y, z = points.astype(np.float64).T
    range = np.linalg.norm(points, axis=1)
    (a, b, c), (p, q, r) = levels
    stands = (range > _REACH) & (z - a * x - b * y - c > _SURFACE)
    stands &= p * x + q * y + r - z > _SURFACE
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


def _hits(recording: Recording, scan: int, R: Float) -> Float:
    beams = recording.beams_of(scan)
    return recording.points[beams][recording.hit[beams]].astype(np.float64) @ R.T


def _always(recording: Recording, scans: list[int], R: Float) -> Bool:
    """(n, n, n) cells from which something comes back in nearly all scans."""
    import scipy  # its parts load when they are first used

    n = round(2 * _REACH / _EDGE)
    itself, near = np.zeros((n, n, n), np.int32), np.zeros((n, n, n), np.int32)
    for scan in recording.in_turn(scans):
        points = _hits(recording, scan, R)
        points = points[(np.abs(points) < _REACH).all(axis=1)]
        here = np.zeros((n, n, n), np.bool_)
        here[tuple(_cells(points, _EDGE).T)] = True
        itself += here
        near += scipy.ndimage.binary_dilation(here, np.ones((3, 3, 3), np.bool_))
    return np.asarray((near >= _ALWAYS * len(scans)) & (itself >= _OFTEN * len(scans)))


def _goes_on(recording: Recording, scans: list[int], R: Float) -> Bool:
    """(n, n, n) cells on a line along an axis on which something goes on beyond the robot."""
    m, each = round(2 * _REACH / _LINE), round(_LINE / _EDGE)
    ahead, aside = np.zeros((m, m), np.int32), np.zeros((m, m), np.int32)
    for scan in recording.in_turn(scans):
        points = _hits(recording, scan, R)
        ahead += _filled(points[:, 0], points[:, 1:])
        aside += _filled(points[:, 1], points[:, ::2])
    least = _GOES_ON[1] * len(scans)
    x, y = ((count >= least).repeat(each, axis=0).repeat(each, axis=1) for count in (ahead, aside))
    return np.asarray(x[None, :, :] | y[:, None, :])


def _filled(ahead: Float, across: Float) -> Bool:
    """(m, m) where the profile across (n, 2) goes on ahead or behind, beyond the robot."""
    import scipy

    m, metres = round(2 * _REACH / _LINE), round(_BEYOND - _REACH)
    inside = (np.abs(ahead) >= _REACH) & (np.abs(ahead) < _BEYOND)
    inside &= (np.abs(across) < _REACH).all(axis=1)
    at = np.floor(np.abs(ahead[inside]) - _REACH).astype(np.intp)
    filled = np.zeros((2, metres, m, m), np.bool_)
    filled[((ahead[inside] < 0).astype(np.intp), at, *_cells(across[inside], _LINE).T)] = True
    filled = scipy.ndimage.binary_dilation(filled, np.ones((1, 1, 3, 3), np.bool_))
    return np.asarray((filled.sum(axis=1) >= _GOES_ON[0]).any(axis=0))


def _cells(places: Float, edge: float) -> Index:
    """(n, d) numbers of the cells in which places (n, d) within _REACH lie."""
    last = round(2 * _REACH / edge) - 1
    return np.clip(np.floor((places + _REACH) / edge).astype(np.intp), 0, last)


def _box(cells: Bool) -> dict[str, Any]:
    """Corners of what is the robot's own, metres."""
    at = np.argwhere(cells)
    low, high = at.min(axis=0) * _EDGE - _REACH, (at.max(axis=0) + 1) * _EDGE - _REACH
    return {"low": np.round(low, 3).tolist(), "high": np.round(high, 3).tolist()}
