"""Counts (10) of a part of the map, without those of the rest."""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording

Float = NDArray[np.float64]
Box = tuple[float, float, float, float]


def beam_boxes(recording: Recording, poses: Float) -> Float:
    """(T, 4) x0, y0, x1, y1 in metres of the box around the beams of each scan; 2D.

    Args:
        recording: T scans.
        poses: (T, 3, 3) T_map_base.
    """
    out = np.empty((recording.n_scans, 4))
    for scans, _, (points, _, offset, T) in iter_beams(recording, poses):
        count = np.diff(offset)
        scan = np.repeat(np.arange(len(count)), count)
        ends = np.einsum("nij,nj->ni", T[scan, :2, :2], points) + T[scan, :2, 2]
        low, high = T[:, :2, 2].copy(), T[:, :2, 2].copy()
        some = count > 0
        first = offset[:-1][some]
        if len(first):
            low[some] = np.fmin(low[some], np.fmin.reduceat(ends, first))
            high[some] = np.fmax(high[some], np.fmax.reduceat(ends, first))
        out[scans] = np.concatenate([low, high], axis=1)
    return out


def count_in_window(
    recording: Recording,
    poses: Float,
    e: NDArray[np.float32],
    boxes: Float,
    window: Box,
    resolution: float,
    max_scans: int | None = None,
) -> _core.OccupancyGrid2D:
    """A grid whose counts (10) within a window are those of all beams.

    Args:
        recording: T scans with M beams; 2D.
        poses: (T, 3, 3) T_map_base.
        e: (M,) P(static).
        boxes: (T, 4) of `beam_boxes`.
        window: x0, y0, x1, y1 in metres.
        resolution: edge of a cell in metres.
        max_scans: if the beams of more scans come near the window, every k-th of them counts;
            None: all count.
    """
    grid = _core.OccupancyGrid2D(resolution, moments=False)
    x0, y0, x1, y1 = boxes.T
    is_near = (x0 <= window[2]) & (y0 <= window[3]) & (x1 >= window[0]) & (y1 >= window[1])
    near = np.flatnonzero(is_near)
    if max_scans is not None:
        near = near[:: max(-(-len(near) // max_scans), 1)]
    T_map_sensor = recording.T_map_sensor(poses)
    for t in recording.iter_scans(near.tolist(), e):
        beams = recording.beams_of(t)
        offset = np.array([0, beams.stop - beams.start])
        points, hit = recording.points[beams], recording.hit[beams]
        _core.add_beams(grid, points, hit, e[beams], offset, T_map_sensor[t : t + 1])
    return grid
