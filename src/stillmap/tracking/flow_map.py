"""Flow map: number of crossings and mean speed of moving objects per square of the floor."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stillmap.core.array_types import Float, Float32, Int32, Int64
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import bound_box

_STEP = 0.25  # of a square: spacing of the samples along a track
_MIN_ABSENCE = 5.0  # s after which a return to a square is another crossing
# squares of the box around all crossings: up to which it is always whole, and at most
_LEAST_SQUARES, _MOST_SQUARES = 1 << 22, 1 << 26


class MovingTrack(Protocol):
    """Anything with stamps (L,), positions and velocities (L, 2) in the plane."""

    @property
    def stamp_ns(self) -> Int64: ...
    @property
    def xy(self) -> Float: ...
    @property
    def velocity(self) -> Float: ...


@dataclass(frozen=True, eq=False)
class FlowMap(ShortRepr):
    """Squares of the floor.

    Attributes:
        crossings: (H, W) int32, number of crossings; row 0 has the lowest y.
        speed: (H, W) float32, mean speed of the crossings in metres per second; NaN without any.
        origin: x, y (metres) and yaw of the lower-left corner of the lower-left square.
        resolution: metres.
    """

    crossings: Int32
    speed: Float32
    origin: tuple[float, float, float]
    resolution: float


def compute_flow_map(objects: Sequence[MovingTrack], resolution: float = 0.5) -> FlowMap:
    """Count the crossings of each square.

    An object that stays in a square, or returns to it within a few seconds, crosses it once.
    Crossings far from all others are left out where the map would be nearly empty.

    Args:
        objects: moving objects.
        resolution: metres, edge of a square.
    """
    crossings = [_crossings(mover, resolution) for mover in objects]
    cells = np.concatenate([np.zeros((0, 2), np.int64), *(cell for cell, _ in crossings)])
    speeds = np.concatenate([np.zeros(0), *(speed for _, speed in crossings)])
    if len(cells) == 0:
        none = np.zeros((0, 0), np.int32)
        return FlowMap(none, none.astype(np.float32), (0.0, 0.0, 0.0), resolution)
    box = bound_box(cells, _LEAST_SQUARES, _MOST_SQUARES)
    inside = box.contains(cells)
    cells, speeds = cells[inside], speeds[inside]
    first, (height, width) = box.low, box.shape
    column, row = (cells - first).T
    flat = row * width + column
    count = np.bincount(flat, minlength=height * width)
    total = np.bincount(flat, speeds, minlength=height * width)
    mean = np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)
    x, y = (first * resolution).tolist()
    return FlowMap(
        count.astype(np.int32).reshape(height, width),
        mean.astype(np.float32).reshape(height, width),
        (x, y, 0.0),
        resolution,
    )


def _crossings(mover: MovingTrack, resolution: float) -> tuple[Int64, Float]:
    """Squares (V, 2) that an object crosses, column and row, and its mean speed (V,) there."""
    seconds = 1e-9 * (mover.stamp_ns - mover.stamp_ns[0])
    xy, t = _resample(mover.xy, seconds, _STEP * resolution)
    speed = np.interp(t, seconds, np.linalg.norm(mover.velocity, axis=1))
    cell = np.floor(xy / resolution).astype(np.int64)
    # in the order of squares, then time: a crossing begins with a new square, or after a while
    order = np.lexsort((t, cell[:, 0], cell[:, 1]))
    cell, t, speed = cell[order], t[order], speed[order]
    begins = (np.diff(cell, axis=0) != 0).any(axis=1) | (np.diff(t) > _MIN_ABSENCE)
    begins = np.flatnonzero(np.concatenate([[True], begins]))
    count = np.diff(begins, append=len(t))
    return cell[begins], np.add.reduceat(speed, begins) / count


def _resample(xy: Float, seconds: Float, step: float) -> tuple[Float, Float]:
    """Points (n, 2) at most `step` apart along a track, and their times (n,)."""
    length = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    pieces = np.maximum(np.ceil(length / step), 1.0)
    ends = np.concatenate([[0.0], np.cumsum(pieces)])
    at = np.arange(int(ends[-1]) + 1)
    t = np.interp(at, ends, seconds)
    return np.stack([np.interp(at, ends, xy[:, d]) for d in (0, 1)], axis=-1), t
