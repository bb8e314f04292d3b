"""The hits of a scan as registration takes them, and their part in maps for registration."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.recording import Recording

FREE_SPACE_MARGIN = 0.5  # m before its end in which a beam is not used as free space
# gaps between neighboring end points on a surface that are filled: at most m wide, m that three of
# them may be off a straight line, times the gap beside it
INTERPOLATION: dict[str, Any] = {"max_gap": 1.5, "tolerance": 0.1, "max_gap_ratio": 3.0}
# normals of a scan: m to either side that belong to one surface, m between its end points; ratio of
# the variances across and along up to which it is flat, and from which it is a corner
NORMALS = {"radius": 0.3, "max_gap": 1.0, "flat_below": 0.1, "round_from": 0.4}
# m of a surface along which end points share their errors: what is near has no more evidence
CORRELATION_LENGTH = 0.1


@dataclass(frozen=True, eq=False)
class Scan:
    """The hits of one scan, or of several.

    Attributes:
        points: (N, 2) float32, end points in the base frame.
        weights: (N,) float32, e times the shares.
        T_base_sensor: (3, 3) origin of the beams.
        normals: (N, 2) float32, of the surfaces.
        isotropy: (N,) float32, 0 on a flat surface, 1 where an end point fixes both directions.
        shares: (N,) float32 in [0, 1], see `evidence_shares`.
    """

    points: Float32
    weights: Float32
    T_base_sensor: Float
    normals: Float32
    isotropy: Float32
    shares: Float32

    def reweight(self, e: Float32) -> "Scan":
        """The same hits with other P(static) e (N,)."""
        return replace(self, weights=e * self.shares)


def transform_points(points: Float32, T: Float) -> Float32:
    """Points (N, D) float32 transformed by (D+1, D+1)."""
    return np.ascontiguousarray(points @ T[:-1, :-1].T + T[:-1, -1], dtype=np.float32)


def select_hits(
    recording: Recording, e: Float32, t: int, normals: Mapping[str, float] = NORMALS
) -> Scan:
    """The hits of scan t; `normals`: how they are estimated, see NORMALS."""
    beams = recording.beams_of(t)
    hit = recording.hit[beams]
    T_base_sensor = recording.T_base_sensor[recording.sensor[t]]
    points = transform_points(recording.points[beams][hit], T_base_sensor)
    return make_scan(points, e[beams][hit], T_base_sensor, normals)


def make_scan(
    points: Float32, e: Float32, T_base_sensor: Float, normals: Mapping[str, float] = NORMALS
) -> Scan:
    """A scan of end points (N, 2) with e (N,), in the order of the beams, and its normals."""
    n, isotropy, shares = np.zeros_like(points), np.zeros_like(e), np.zeros_like(e)
    counts = e > 0.0
    n[counts], isotropy[counts] = _core.estimate_normals(points[counts], **normals)
    shares[counts] = evidence_shares(points[counts])
    return Scan(points, e * shares, T_base_sensor, n, isotropy, shares)


def evidence_shares(points: Float32) -> Float32:
    """(N,) in [0, 1]: how much of the evidence of each end point (N, 2), in the order of the beams,
    its neighbours do not have in common with it."""
    return _core.evidence_shares(points, correlation_length=CORRELATION_LENGTH)


def add_scan(
    grid: _core.OccupancyGrid2D,
    recording: Recording,
    e: Float32,
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
    points: Float32,
    hit: Bool,
    weights: Float32,
    T_map_sensor: Float,
    *,
    remove: bool = False,
) -> None:
    """As `add_scan`, of points (N, 2) in the sensor frame with weights e (N,)."""
    scan = points, hit, weights, np.array([0, len(hit)]), T_map_sensor[None]
    _core.add_beams(grid, *scan, remove=remove, hits_only=True)
    _core.interpolate_end_points(grid, *scan, **INTERPOLATION, remove=remove)


def count_beams(
    recording: Recording, e: Float32, scans: Index, poses: Float, resolution: float, **near: Any
) -> _core.OccupancyGrid2D:
    """The counts (10) of some scans that the evidence of a map needs: near its returns.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        scans: (n,) that are added to the map.
        poses: (n, 3, 3) of their robot.
        resolution: m of a cell.
        near: `other` map, near whose returns they are needed, too, or `everywhere`.
    """
    grid = _core.OccupancyGrid2D(resolution, moments=False)
    T_map_sensor = np.zeros((recording.n_scans, 3, 3))
    T_map_sensor[scans] = poses @ recording.T_base_sensor[recording.sensor[scans]]
    data = recording.points, recording.hit, e, recording.offset, T_map_sensor, np.asarray(scans)
    _core.count_near_returns(grid, *data, correlation_length=CORRELATION_LENGTH, **near)
    return grid


def replace_weights(
    grid: _core.OccupancyGrid2D,
    points: Float32,
    hit: Bool,
    before: Float32,
    after: Float32,
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


Values = NDArray[Any]

# of a planar scan that are registered, more than lasers have: all around, they end as far apart as
# cells of 0.05 m at 16 m
_MAX_BEAMS = 2048
# of an all-round view: sectors, the share of them that is seen, and scans that are looked at
_SECTORS, _MIN_SECTORS, _SAMPLED = 36, 0.8, 9


def beams_of_scans(recording: Recording, scans: Index, max_beams: int) -> list[Index]:
    """Beams of each of some scans, rising: of more than max_beams every so many."""
    spans = [recording.beams_of(t) for t in scans.tolist()]
    return [
        np.arange(of.start, of.stop, max(1, -(-(of.stop - of.start) // max_beams))) for of in spans
    ]


def select_beams(
    recording: Recording, scans: Index, beams: list[Index], T_odom_base: Float | None
) -> Recording:
    """These beams of these scans, without beam times, pictures and recorded poses.

    Args:
        recording: 2D or 3D.
        scans: (n,) rising.
        beams: of each of these scans.
        T_odom_base: (n, D+1, D+1) odometry of the result.
    """
    return replace(
        recording,
        stamp_ns=recording.stamp_ns[scans],
        offset=np.concatenate([[0], np.cumsum([len(of) for of in beams], dtype=np.int64)]),
        points=np.concatenate([recording.points[of] for of in beams]),
        hit=np.concatenate([recording.hit[of] for of in beams]),
        sensor=recording.sensor[scans],
        T_odom_base=T_odom_base,
        T_recorded_base=None,
        beam_time=None,
        images=None,
        record=None,
    )


def select_scans(recording: Recording, e: Float32, scans: Index) -> tuple[Recording, Float32]:
    """Some scans (n,), rising, of a planar recording as `thin_scans` leaves it, and their e."""
    beams, odometry = beams_of_scans(recording, scans, _MAX_BEAMS), recording.T_odom_base
    of_scans = select_beams(recording, scans, beams, None if odometry is None else odometry[scans])
    return of_scans, e[np.concatenate(beams)]


def thin_scans(recording: Recording, values: Values) -> tuple[Recording, Values]:
    """A planar recording with fewer beams in the scans that have more than registration needs.

    Normals take time in proportion to the square of the beams on a surface; the search of a scan
    that resembles no place, for all poses times all beams.

    Args:
        recording: 2D, M beams.
        values: (M,) of every beam.

    Returns:
        The recording and the values of its beams, themselves where no scan has too many.
    """
    if int(np.diff(recording.offset).max(initial=0)) <= _MAX_BEAMS:
        return recording, values
    beams = beams_of_scans(recording, np.arange(recording.n_scans), _MAX_BEAMS)
    kept = np.concatenate(beams)
    thinned = replace(
        select_beams(recording, np.arange(recording.n_scans), beams, recording.T_odom_base),
        beam_time=None if recording.beam_time is None else recording.beam_time[kept],
    )
    return thinned, values[kept]


def sees_all_round(recording: Recording) -> bool:
    """True if scans cover nearly all azimuths of the sensor."""
    scans = np.unique(np.linspace(0, recording.n_scans - 1, _SAMPLED).astype(np.int64))
    beams = [recording.beams_of(t) for t in scans.tolist()]
    points = np.concatenate([recording.points[of].compress(recording.hit[of], 0) for of in beams])
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    sector = np.floor((azimuth[np.isfinite(azimuth)] / math.tau + 0.5) * _SECTORS)
    return len(np.unique(sector % _SECTORS)) >= _MIN_SECTORS * _SECTORS
