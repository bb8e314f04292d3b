"""Ground segmentation: level, static surface as far below the sensors as the robot is high."""

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.core.square_box import bound_box
from stillmap.em.observations import SurfelMap, iter_surfel_rows
from stillmap.em.types import DYNAMIC_BELOW, GROUND_SQUARE, GroundMap

_RESOLUTION = 0.3  # m, of the surfel map from which level surface is taken
_MIN_NORMAL_Z = 0.85  # |z| of the normal above which a surfel is level
_MIN_SENSOR_HEIGHT = 0.15  # m
_HEIGHT_RADIUS = 8.0  # m around the trajectory within which the ground shows the sensor's height
_HEIGHT_BIN = 0.05  # m, of the histogram of sensor heights
_MAX_STEP = 0.3  # m, between neighbouring squares
_BORDER = 2  # squares around everything observed
# squares of the box around it: up to which it is always whole, and at most
_LEAST_SQUARES, _MOST_SQUARES = 1 << 20, 1 << 26


def estimate_ground(
    recording: Recording, poses: Float, p_static: Float32, threads: int = 1
) -> GroundMap:
    """Estimates the ground from the static end points of a recording.

    Args:
        recording: 3D, M beams, deskewed.
        poses: (T, 4, 4) T_map_base; the z axis of the map points up.
        p_static: (M,) P(c = 1) of every beam.
        threads: does not change the result.
    """
    surfel_map = _core.SurfelMap3D(_RESOLUTION)
    for _, beams, (points, hit, offset, T) in iter_beams(recording, poses, release=[p_static]):
        static = hit & (p_static[beams] >= DYNAMIC_BELOW)
        surfel_map.add_end_points(points, static, offset, T, threads=threads)
    surfel_map.fit(threads)
    every = np.ones(surfel_map.size, np.float32)
    return ground_from_surfels(surfel_map, every, recording.T_map_sensor(poses)[:, :3, 3])


def ground_from_surfels(surfel_map: SurfelMap, p_static: Float32, positions: Float) -> GroundMap:
    """Estimates the ground from the static surfels of a map.

    Args:
        surfel_map: E surfels in 3D, fitted.
        p_static: (E,) of each surfel.
        positions: (T, 3) of the sensors in the map frame, whose z axis points up.
    """
    floor = [np.zeros((0, 3))]
    for rows in iter_surfel_rows(surfel_map):
        _, means, normals, *_ = surfel_map.surfels(rows)
        level = np.abs(normals[:, 2]) > _MIN_NORMAL_Z
        floor.append(means[level & (p_static[slice(*rows)] >= DYNAMIC_BELOW)])
    return fit_ground(np.concatenate(floor), positions)


def fit_ground(floor: Float, positions: Float) -> GroundMap:
    """Fits a height map to level surface.

    Args:
        floor: (N, 3) points of level, static surface, metres; includes tops of objects.
        positions: (T, 3) of the sensors in the map frame, whose z axis points up.

    The ground reaches as far as the box around both, unless that would be nearly empty.
    """
    floor, positions = _leave_out_far_points(floor, positions)
    sensor_height = _sensor_height(floor, positions)
    known = [xyz[:, :2] for xyz in (floor, positions) if len(xyz)]
    low = np.vstack([xy.min(axis=0) for xy in known])
    high = np.vstack([xy.max(axis=0) for xy in known])
    corner = np.floor(low.min(axis=0) / GROUND_SQUARE - _BORDER) * GROUND_SQUARE
    W, H = (np.ceil((high.max(axis=0) - corner) / GROUND_SQUARE).astype(int) + _BORDER).tolist()
    z = np.full((H, W), np.nan)
    square = _square_index(z, corner, positions[:, :2])
    total = np.bincount(square, weights=positions[:, 2] - (sensor_height or 0.0), minlength=z.size)
    count = np.bincount(square, minlength=z.size)
    z.reshape(-1)[count > 0] = total[count > 0] / count[count > 0]
    _grow(z, corner, floor if sensor_height is not None else floor[:0])
    return GroundMap(z, corner, sensor_height or 0.0, sensor_height is not None)


def _leave_out_far_points(floor: Float, positions: Float) -> tuple[Float, Float]:
    """Both without the points outside the box of the ground."""
    squares = np.floor(np.concatenate([floor, positions])[:, :2] / GROUND_SQUARE).astype(np.int64)
    places = squares[len(floor) :]
    near = places if len(places) else None
    box = bound_box(squares, _LEAST_SQUARES, _MOST_SQUARES, places=near)
    inside = box.contains(squares)
    if inside.all():
        return floor, positions
    return floor[inside[: len(floor)]], positions[inside[len(floor) :]]


def _sensor_height(floor: Float, positions: Float) -> float | None:
    """Height of the sensors above most of the level surface near the trajectory, in metres."""
    import scipy  # its parts load when they are first used

    if not len(floor):
        return None
    distance, nearest = scipy.spatial.cKDTree(positions[:, :2]).query(floor[:, :2])
    below = positions[nearest, 2] - floor[:, 2]
    below = below[(distance < _HEIGHT_RADIUS) & (below > _MIN_SENSOR_HEIGHT)]
    if not len(below):
        return None
    # the mode of the histogram: tops of objects are smaller than the ground, at various heights
    counts = np.bincount((below / _HEIGHT_BIN).astype(np.int64))
    mode = int(np.convolve(counts, np.ones(3))[1:-1].argmax())
    return float(np.median(below[np.abs(below / _HEIGHT_BIN - (mode + 0.5)) < 1.5]))


def _square_index(z: Float, corner: Float, xy: Float) -> Index:
    """(N,) flat index of the squares of positions (N, 2)."""
    column, row = np.floor((xy - corner) / GROUND_SQUARE).astype(np.intp).T
    return np.asarray(row * z.shape[1] + column)


def _grow(z: Float, corner: Float, floor: Float) -> None:
    """Fills squares outwards from the trajectory, in place.

    A square takes the mean of the floor in it that continues its neighbours, else the mean of its
    neighbours. Only neighbours of the squares filled last can be filled next.
    """
    square = _square_index(z, corner, floor[:, :2])
    order = np.argsort(square, kind="stable")
    height, first = floor[order, 2], np.searchsorted(square[order], np.arange(z.size + 1))
    flat, front = z.reshape(-1), np.flatnonzero(np.isfinite(z))
    while len(front):
        _fit_squares(flat, front, height, first)
        front = _unknown_neighbors(z, front)
        flat[front] = _mean_of_neighbors(z, front)


def _fit_squares(flat: Float, squares: Index, height: Float, first: Index) -> None:
    """Sets squares (n,) to the mean of their heights within `_MAX_STEP` of the expected height.

    Square k has the heights first[k] to first[k + 1].
    """
    counts = first[squares + 1] - first[squares]
    of = np.repeat(np.arange(len(squares)), counts)
    at = np.repeat(first[squares] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    near = np.abs(height[at] - flat[squares[of]]) <= _MAX_STEP
    count = np.bincount(of[near], minlength=len(squares))
    total = np.bincount(of[near], weights=height[at[near]], minlength=len(squares))
    flat[squares[count > 0]] = total[count > 0] / count[count > 0]


def _unknown_neighbors(z: Float, squares: Index) -> Index:
    """(n,) flat index, rising, of the unknown squares next to some."""
    neighbors, inside = _neighbors(z, squares)
    unknown = neighbors[inside]
    return np.unique(unknown[np.isnan(z.reshape(-1)[unknown])])


def _mean_of_neighbors(z: Float, squares: Index) -> Float:
    """(n,) mean height of the known squares next to each."""
    neighbors, inside = _neighbors(z, squares)
    around = np.where(inside, z.reshape(-1)[np.where(inside, neighbors, 0)], np.nan)
    known = np.isfinite(around)
    return np.asarray(np.where(known, around, 0.0).sum(axis=0) / known.sum(axis=0))


def _neighbors(z: Float, squares: Index) -> tuple[Index, Bool]:
    """(4, n) flat index of the neighbours of squares, and whether they lie in the grid."""
    H, W = z.shape
    row, column = np.divmod(squares, W)
    inside = np.stack([column > 0, column < W - 1, row > 0, row < H - 1])
    return squares + np.array([[-1], [1], [-W], [W]]), inside
