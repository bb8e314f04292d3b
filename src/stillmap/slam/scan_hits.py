"""The hits of a scan as registration takes them, and their part in maps for registration."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.recording import Recording

Float = NDArray[np.float64]
Points = NDArray[np.float32]

FREE_SPACE_MARGIN = 0.5  # m before its end in which a beam is not used as free space
# gaps between neighboring end points on a surface that are filled: at most m wide, m that three of
# them may be off a straight line, times the gap beside it
INTERPOLATION = {"max_gap": 1.5, "tolerance": 0.1, "max_gap_ratio": 3.0}
# normals of a scan: m to either side that belong to one surface, m between its end points; ratio of
# the variances across and along up to which it is flat, and from which it is a corner
NORMALS = {"radius": 0.3, "max_gap": 1.0, "flat_below": 0.1, "round_from": 0.4}


@dataclass(frozen=True, eq=False)
class Scan:
    """The hits of one scan, or of several.

    Attributes:
        points: (N, 2) float32, end points in the base frame.
        weights: (N,) float32, e.
        T_base_sensor: (3, 3) origin of the beams.
        normals: (N, 2) float32, of the surfaces.
        isotropy: (N,) float32, 0 on a flat surface, 1 where an end point fixes both directions.
    """

    points: Points
    weights: NDArray[np.float32]
    T_base_sensor: Float
    normals: Points
    isotropy: NDArray[np.float32]


def transform_points(points: Points, T: Float) -> Points:
    """Points (N, D) float32 transformed by (D+1, D+1)."""
    return np.ascontiguousarray(points @ T[:-1, :-1].T + T[:-1, -1], dtype=np.float32)


def select_hits(
    recording: Recording, e: NDArray[np.float32], t: int, normals: Mapping[str, float] = NORMALS
) -> Scan:
    """The hits of scan t; `normals`: how they are estimated, see NORMALS."""
    beams = recording.beams_of(t)
    hit = recording.hit[beams]
    T_base_sensor = recording.T_base_sensor[recording.sensor[t]]
    points = transform_points(recording.points[beams][hit], T_base_sensor)
    return make_scan(points, e[beams][hit], T_base_sensor, normals)


def make_scan(
    points: Points,
    weights: NDArray[np.float32],
    T_base_sensor: Float,
    normals: Mapping[str, float] = NORMALS,
) -> Scan:
    """A scan of end points (N, 2) in the order of the beams, with the normals of its surfaces."""
    n, isotropy = np.zeros_like(points), np.zeros_like(weights)
    counts = weights > 0.0
    n[counts], isotropy[counts] = _core.estimate_normals(points[counts], **normals)
    return Scan(points, weights, T_base_sensor, n, isotropy)


def add_scan(
    grid: _core.OccupancyGrid2D,
    recording: Recording,
    e: NDArray[np.float32],
    t: int,
    T_map_base: Float,
    *,
    remove: bool = False,
) -> None:
    """Adds the hits of scan t at a pose (3, 3) to a map for registration, or removes them.

    Beams without a return may have met glass: they are no evidence against a surface.
    """
    beams = recording.beams_of(t)
    T_map_sensor = T_map_base @ recording.T_base_sensor[recording.sensor[t]]
    points, hit = recording.points[beams], recording.hit[beams]
    add_hits(grid, points, hit, e[beams], T_map_sensor, remove=remove)


def add_hits(
    grid: _core.OccupancyGrid2D,
    points: Points,
    hit: NDArray[np.bool_],
    weights: NDArray[np.float32],
    T_map_sensor: Float,
    *,
    remove: bool = False,
) -> None:
    """As `add_scan`, of points (N, 2) in the sensor frame with weights e (N,)."""
    T, all_hit, offset = T_map_sensor[None], hit[hit], np.array([0, np.count_nonzero(hit)])
    _core.add_beams(grid, points[hit], all_hit, weights[hit], offset, T, remove=remove)
    _core.interpolate_end_points(
        grid, points, hit, weights, np.array([0, len(hit)]), T, **INTERPOLATION, remove=remove
    )


def replace_weights(
    grid: _core.OccupancyGrid2D,
    points: Points,
    hit: NDArray[np.bool_],
    before: NDArray[np.float32],
    after: NDArray[np.float32],
    T_map_sensor: Float,
) -> None:
    """Give the hits that `add_hits` added other weights, as if it had added those; no beam is
    followed again, since free space does not depend on them."""
    T, offset = T_map_sensor[None], np.array([0, len(hit)])
    changed = hit & (before != after)
    ends = points[changed]
    every, offset_of_ends = changed[changed], np.array([0, len(ends)])
    for weights, remove in ((before, True), (after, False)):
        e = weights[changed]
        _core.add_end_points(grid, ends, every, e, offset_of_ends, T, remove=remove)
        _core.interpolate_end_points(
            grid, points, hit, weights, offset, T, **INTERPOLATION, remove=remove
        )
