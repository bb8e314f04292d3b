"""Agreement of the surfaces that one place shows on different visits, without truth.

Returns are grouped by cube of a fixed size in metres and by stretch of travel. Where two stretches
show a plane (in 2D a line) in the same cube, its displacement across the surface is what the poses
of the two stretches contradict each other by. `docs/estimator.md` has the definition.
"""

import numpy as np

from stillmap.core.array_types import Float, Int64
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.slam.local_map import travelled_distance

CELL = 0.5  # m, edge of a cube: smaller than rooms, larger than the noise of any sensor
STRETCH = 4.0  # m of travel that count as one visit
_MIN_RETURNS = 6  # of one visit on a surface
_MIN_EXTENT = 0.06  # m, standard deviation of them along the surface
_MAX_FLATNESS = 0.1  # ratio of the variances across and along, up to which it is flat
_MIN_COSINE = 0.8  # of the angle between two surfaces that are held for the same one
_ADJACENT = 2  # stretches, up to which two visits are one after the other
_MIN_PAIRS = 10  # of surfaces: with fewer nothing can be told
_MAX_DISPLACEMENT = 0.2  # m, that more counts as: it may be another surface
_MAX_RETURNS = 500_000  # of all scans; of longer recordings, every so many scans are used


def mean_displacement(recording: Recording, poses: Float) -> float | None:
    """Mean displacement in metres of surfaces seen again on later visits; None of too few pairs.

    Visits one after the other are left out: in between, the poses had no time to drift. Pairs of
    patches are weighted by the returns of the patch with fewer.

    Args:
        recording: 2D or 3D, deskewed.
        poses: (T, D+1, D+1) T_map_base.
    """
    cube, stretch, returns, mean, normal = _fit_patches(*_collect_returns(recording, poses))
    first = np.flatnonzero(cube[:-1] == cube[1:])
    second = first + 1
    cosine = np.abs(np.sum(normal[first] * normal[second], axis=1))
    used = cosine > _MIN_COSINE
    used &= stretch[second] - stretch[first] > _ADJACENT
    first, second = first[used], second[used]
    if len(first) < _MIN_PAIRS:
        return None
    step = mean[second] - mean[first]
    across = np.abs(np.sum(step * normal[first], axis=1))
    weight = np.minimum(returns[first], returns[second])
    return float(np.average(np.minimum(across, _MAX_DISPLACEMENT), weights=weight))


def _collect_returns(recording: Recording, poses: Float) -> tuple[Float, Int64]:
    """End points (N, D) in the map, and their stretches of travel (N,)."""
    stretch = (travelled_distance(poses) / STRETCH).astype(np.int64)
    every = max(1, -(-recording.n_beams // _MAX_RETURNS))
    points, stretches = [], []
    for some, _, (ends, hit, offset, T) in iter_beams(recording, poses):
        scan = np.repeat(np.arange(some.start, some.stop), np.diff(offset))
        used = hit & (scan % every == 0)
        scan, T_used = scan[used], T[scan[used] - some.start]
        local = ends[used].astype(np.float64)
        points.append(np.einsum("nij,nj->ni", T_used[:, :-1, :-1], local) + T_used[:, :-1, -1])
        stretches.append(stretch[scan])
    return np.concatenate(points), np.concatenate(stretches)


def _fit_patches(points: Float, stretch: Int64) -> tuple[Int64, Int64, Int64, Float, Float]:
    """The planar patches among the returns of each cube and stretch, sorted by these.

    Returns:
        cube, stretch, number of returns; mean and normal (P, D) of each.
    """
    D = points.shape[1]
    cubes = np.floor(points / CELL).astype(np.int64)
    keys = np.column_stack([cubes, stretch])
    order = np.lexsort(keys.T[::-1])
    keys, points = keys[order], points[order]
    is_first = np.ones(len(keys), np.bool_)
    is_first[1:] = np.any(keys[1:] != keys[:-1], axis=1)
    start = np.flatnonzero(is_first)
    if not len(start):
        none, flat = np.empty(0, np.int64), np.empty((0, D))
        return none, none, none, flat, flat
    count = np.diff(np.append(start, len(keys)))
    local = points - (keys[:, :D] + 0.5) * CELL  # small numbers: squares lose no digits
    mean = np.add.reduceat(local, start) / count[:, None]
    products = local[:, :, None] * local[:, None, :]
    covariance = np.add.reduceat(products, start) / count[:, None, None]
    covariance -= mean[:, :, None] * mean[:, None, :]
    variance, axes = np.linalg.eigh(covariance)
    is_flat = (count >= _MIN_RETURNS) & (variance[:, 1] > _MIN_EXTENT**2)
    is_flat &= variance[:, 0] < _MAX_FLATNESS * variance[:, 1]
    cube = np.cumsum(np.any(np.diff(keys[start, :D], axis=0, prepend=keys[:1, :D]) != 0, axis=1))
    return (
        cube[is_flat],
        keys[start, D][is_flat],
        count[is_flat],
        (mean + (keys[start, :D] + 0.5) * CELL)[is_flat],
        axes[is_flat, :, 0],
    )
