"""How high the ground is: what is flat and lies as far below the sensor as the robot is high."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.recording import Recording
from stillmap.em.observations import SurfelMap, iter_chunks, iter_surfel_rows

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_CELL = 0.3  # m, of the surface that tells what is level
_BELIEVED = 0.5  # P(c = 1) of what stands still
_SQUARE = 1.0  # m, edge of a square with one height
_LEVEL = 0.85  # cosine of the slope from which on a surface is no floor
_BENEATH = 0.15  # m, the sensor sits at least so high above it
_NEAR = 8.0  # m from the robot's way, where the ground tells how high the sensor is
_STEP = 0.3  # m, by which the ground may rise or fall from one square to the next
_BIN = 0.05  # m
_MARGIN = 2  # squares around all that is known


@dataclass(frozen=True, eq=False)
class GroundMap:
    """The height of the ground, square by square.

    Attributes:
        z: (H, W) metres in the map frame, row 0 at the lowest y; known everywhere, where nothing
            of the ground was seen from the squares beside.
        corner: (2,) x, y of the lowest square's lower-left corner.
        sensor: metres of the sensors above it.
        seen: whether any ground was seen at all.
    """

    height: Float
    corner: Float
    sensor_height: float
    observed: bool

    def height_at(self, xy: Float) -> Float:
        """(N,) height at places (N, 2) in metres; beyond the edge that of the edge."""
        H, W = self.height.shape
        column, row = (  # one after the other: rows of two numbers are slow
            np.floor((x - corner) / _SQUARE).astype(np.int64).clip(0, last)
            for x, corner, last in zip(xy.T, self.corner, (W - 1, H - 1), strict=True)
        )
        return np.asarray(self.height.take(row * W + column))


def estimate_ground(
    recording: Recording, poses: Float, p_static: NDArray[np.float32], threads: int = 1
) -> GroundMap:
    """The ground under a robot's way and around it.

    Args:
        recording: 3D, M beams without motion during its scans.
        poses: (T, 4, 4) T_map_base; the z axis of the map points up.
        p_static: (M,) P(c = 1) of every beam.
        threads: same result with any number.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    surface = _core.Surface3D(_CELL)
    for scans, beams, offset in iter_chunks(recording, release=[p_static]):
        static = recording.hit[beams] & (p_static[beams] >= _BELIEVED)
        surface.add_end_points(
            recording.points[beams], static, offset, T_map_sensor[scans], threads=threads
        )
    surface.fit(threads)
    _, means, normals, *_ = surface.elements()
    return ground_from(means, normals, T_map_sensor[:, :3, 3])


def ground_from_surfels(surface: SurfelMap, p_static: NDArray[np.float32], way: Float) -> GroundMap:
    """The ground by the elements (E,) of a surface in space that stand still.

    Args:
        surface: fitted.
        p_static: (E,) of each element.
        way: (T, 3) where the sensors were, in the map frame whose z points up.
    """
    floor = [np.zeros((0, 3))]
    for rows in iter_surfel_rows(surface):
        _, means, normals, *_ = surface.elements(rows)
        level = np.abs(normals[:, 2]) > _LEVEL
        floor.append(means[level & (p_static[slice(*rows)] >= _BELIEVED)])
    return _ground_by(np.concatenate(floor), way)


def ground_from(means: Float, normals: Float, way: Float) -> GroundMap:
    """The ground under a robot's way and around it.

    Args:
        means, normals: (E, 3) of surface that stands still, metres; a normal of zero: none.
        way: (T, 3) where the sensors were, in the map frame whose z points up.
    """
    return _ground_by(means[np.abs(normals[:, 2]) > _LEVEL], way)


def _ground_by(floor: Float, way: Float) -> GroundMap:
    sensor = _height(floor, way)
    low, high = (np.vstack([getattr(one[:, :2], end)(axis=0) for one in (floor, way) if len(one)])
                 for end in ("min", "max"))  # fmt: skip
    corner = np.floor(low.min(axis=0) / _SQUARE - _MARGIN) * _SQUARE
    W, H = (np.ceil((high.max(axis=0) - corner) / _SQUARE).astype(int) + _MARGIN).tolist()
    z = np.full((H, W), np.nan)
    square = _squares(z, corner, way[:, :2])
    total = np.bincount(square, weights=way[:, 2] - (sensor or 0.0), minlength=z.size)
    count = np.bincount(square, minlength=z.size)
    z.reshape(-1)[count > 0] = total[count > 0] / count[count > 0]
    _spread(z, corner, floor if sensor is not None else floor[:0])
    return GroundMap(z, corner, sensor or 0.0, sensor is not None)


def _height(floor: Float, way: Float) -> float | None:
    """Metres of the sensors above most of what is level and below them, near the way."""
    import scipy  # its parts load when they are first used

    if not len(floor):
        return None
    apart, nearest = scipy.spatial.cKDTree(way[:, :2]).query(floor[:, :2])
    below = way[nearest, 2] - floor[:, 2]
    below = below[(apart < _NEAR) & (below > _BENEATH)]
    if not len(below):
        return None
    # things have fewer tops than there is ground, at as many heights as there are things
    counts = np.bincount((below / _BIN).astype(np.int64))
    most = int(np.convolve(counts, np.ones(3))[1:-1].argmax())
    return float(np.median(below[np.abs(below / _BIN - (most + 0.5)) < 1.5]))


def _squares(z: Float, corner: Float, xy: Float) -> Index:
    """(N,) flat numbers of the squares in which places (N, 2) lie."""
    column, row = np.floor((xy - corner) / _SQUARE).astype(np.intp).T
    return np.asarray(row * z.shape[1] + column)


def _spread(z: Float, corner: Float, floor: Float) -> None:
    """From the way outwards: a square is as high as the floor in it that goes on beside it.

    Without floor it is as high as what is beside. Only squares beside those that became known last
    can become known next.
    """
    square = _squares(z, corner, floor[:, :2])
    order = np.argsort(square, kind="stable")
    height, first = floor[order, 2], np.searchsorted(square[order], np.arange(z.size + 1))
    flat, known = z.reshape(-1), np.flatnonzero(np.isfinite(z))
    while len(known):
        _lay(flat, known, height, first)
        known = _unknown_beside(z, known)
        flat[known] = _mean_beside(z, known)


def _lay(flat: Float, squares: Index, height: Float, first: Index) -> None:
    """Squares (n,) get the mean of the heights there that are near what was expected.

    Heights of square k are those from first[k] to first[k + 1].
    """
    counts = first[squares + 1] - first[squares]
    of = np.repeat(np.arange(len(squares)), counts)
    at = np.repeat(first[squares] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    near = np.abs(height[at] - flat[squares[of]]) <= _STEP
    count = np.bincount(of[near], minlength=len(squares))
    total = np.bincount(of[near], weights=height[at[near]], minlength=len(squares))
    flat[squares[count > 0]] = total[count > 0] / count[count > 0]


def _unknown_beside(z: Float, squares: Index) -> Index:
    """(n,) flat numbers, rising, of the unknown squares beside some."""
    beside, inside = _beside(z, squares)
    unknown = beside[inside]
    return np.unique(unknown[np.isnan(z.reshape(-1)[unknown])])


def _mean_beside(z: Float, squares: Index) -> Float:
    """(n,) mean height of the known squares beside each."""
    beside, inside = _beside(z, squares)
    around = np.where(inside, z.reshape(-1)[np.where(inside, beside, 0)], np.nan)
    known = np.isfinite(around)
    return np.asarray(np.where(known, around, 0.0).sum(axis=0) / known.sum(axis=0))


def _beside(z: Float, squares: Index) -> tuple[Index, NDArray[np.bool_]]:
    """(4, n) flat numbers of the squares beside some, and whether these are of the grid."""
    H, W = z.shape
    row, column = np.divmod(squares, W)
    inside = np.stack([column > 0, column < W - 1, row > 0, row < H - 1])
    return squares + np.array([[-1], [1], [-W], [W]]), inside
