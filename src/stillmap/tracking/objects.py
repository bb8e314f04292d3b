"""Moving objects: track, velocity, size and beams of each confirmed track."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core import arrays, se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Float, Float32, Index, Int64
from stillmap.core.config import CheckedOptions, option
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.tracking.association import ACCELERATION, MAX_GAP, assign_tracks
from stillmap.tracking.clustering import MIN_P_DYNAMIC, DynamicPoints, extract_dynamic_points
from stillmap.tracking.detections import compute_centroids, iterate_tracks
from stillmap.tracking.fast_movers import find_fast_movers, tracks_of_paths
from stillmap.tracking.mover_path import MoverPath, smooth_track
from stillmap.tracking.tracklets import stitch_tracklets

HEADING_SPEED = 0.3  # m/s: a faster object is heading where it moves

SMOOTHER_STD = 0.28  # m: of a center over time, more than at an instant because legs swing
_WIDTH_QUANTILE = 0.8  # of the widths seen in single scans
_MAX_OFFSET = 0.9  # m, half the width of a car
_PATH_REACH = 1.0  # s for which a path goes on at constant velocity
_VEHICLE_ACCELERATION = 4.0  # m2/s3
_OUTLIERS = 5.0  # percent of the points on either side outside the box: legs swing


@dataclass(frozen=True)
class ObjectOptions(CheckedOptions):
    """Tracking of moving objects; see `docs/objects.md`."""

    enabled: bool = option(True, "Detect and track moving objects.")
    min_extent: float = option(
        0.15, "Minimum extent of an object plus its path, in metres.", ge=0.0, le=1000.0
    )


@dataclass(frozen=True, eq=False)
class MovingObject(ShortRepr):
    """A moving object.

    Attributes:
        id: from 0 in the order of first detections.
        scan: (L,) scans with detections, rising.
        stamp_ns: (L,) their stamps.
        xy: (L, 2) metres, smoothed center in the map frame, as if the object were round.
        velocity: (L, 2) metres per second.
        size: metres along and across the direction of motion, in 3D also height, of the visible
            part.
        beams: (n,) beams of the recording that ended on it, rising.
        p_dynamic: mean P(dynamic) of these beams.
        z: (L,) metres, height of the center in the map frame; None in 2D.
        p_identity: probability that it is one mover all the time, given who was near or hidden.
    """

    id: int
    scan: Index
    stamp_ns: Int64
    xy: Float
    velocity: Float
    size: tuple[float, ...]
    beams: Index
    p_dynamic: float
    z: Float | None = None
    p_identity: float = 1.0


def track_length(xy: Float) -> float:
    """Metres along a track (L, 2)."""
    return float(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum())


def mean_speed(velocity: Float) -> float:
    """Mean of the speeds along a track, m/s, of its velocities (L, 2)."""
    return float(np.linalg.norm(velocity, axis=1).mean())


def track_objects(
    recording: Recording, poses: Float, p_static: Float32, options: ObjectOptions
) -> list[MovingObject]:
    """Detect and track the moving objects of a recording.

    Args:
        recording: 2D, M beams, deskewed.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1) of each beam.
        options: see ObjectOptions.

    Raises:
        ValueError: the lengths disagree, or the recording is not 2D.
    """
    if recording.dimension != 2:
        raise ValueError(f"recording: expected 2 dimensions, got {recording.dimension}")
    if len(poses) != recording.n_scans or len(p_static) != recording.n_beams:
        raise ValueError(
            f"poses, p_static: expected {recording.n_scans} and {recording.n_beams}, "
            f"got {len(poses)} and {len(p_static)}"
        )
    if not options.enabled:
        return []
    points = extract_dynamic_points(recording, poses, p_static, MIN_P_DYNAMIC)
    if len(points.scan) == 0:
        return []
    owner, paths = find_fast_movers(points, assign_tracks(points, MAX_GAP))
    owner, p_identity = stitch_tracklets(points, owner, paths)
    kept = _ObjectStore(recording.scratch)
    fast = tracks_of_paths(points, owner, paths)
    for track, here in iterate_tracks(points, owner):
        centroids = compute_centroids(points, owner, here)
        mine = [path for path, number in zip(paths, fast, strict=True) if number == track]
        mover = _make_object(points, here, centroids.scan, centroids.xy, mine, recording, p_static)
        if float(np.linalg.norm(np.ptp(mover.xy, axis=0))) + max(mover.size) >= options.min_extent:
            kept.add(dataclasses.replace(mover, p_identity=float(p_identity[track])))
        arrays.release_pages(p_static)
    objects = kept.objects()
    objects.sort(key=lambda mover: (mover.scan[0], mover.beams[0]))
    return [dataclasses.replace(mover, id=number) for number, mover in enumerate(objects)]


class _ObjectStore:
    """Objects whose arrays are slices of a few large, memory-mapped ones."""

    def __init__(self, scratch: Path | None) -> None:
        types = {"scan": np.intp, "stamp_ns": np.int64, "beams": np.intp}
        self._columns = {name: ArrayBuilder(dtype, (), scratch) for name, dtype in types.items()}
        for name in ("xy", "velocity"):
            self._columns[name] = ArrayBuilder(float, (2,), scratch)
        self._movers = list[tuple[MovingObject, dict[str, slice]]]()

    def add(self, mover: MovingObject) -> None:
        spans, nothing = dict[str, slice](), dict[str, Any]()
        for name, column in self._columns.items():
            array = getattr(mover, name)
            spans[name] = slice(len(column), len(column) + len(array))
            column.append(array)
            nothing[name] = array[:0].copy()  # the whole would stay in memory
        self._movers.append((dataclasses.replace(mover, **nothing), spans))

    def objects(self) -> list[MovingObject]:
        """All objects in their order; nothing can be added afterwards."""
        columns: dict[str, Any] = {name: column.finish() for name, column in self._columns.items()}
        return [
            dataclasses.replace(mover, **{name: columns[name][spans[name]] for name in spans})
            for mover, spans in self._movers
        ]


def _make_object(
    points: DynamicPoints,
    here: Index,
    scan: Index,
    centroid: Float,
    paths: list[MoverPath],
    recording: Recording,
    p_static: Float32,
) -> MovingObject:
    """The object of points `here` with these centroids (L, 2) in scans (L,)."""
    at = np.searchsorted(scan, points.scan[here])
    offset = estimate_center_offset(centroid, points.sensor[scan], points.xy[here], at)
    center, t = centroid + offset, points.seconds[scan]
    for path in paths:
        on = (t >= path.seconds[0] - _PATH_REACH) & (t <= path.seconds[-1] + _PATH_REACH)
        center[on] = path.state_at(t[on])[0]
    acceleration = _VEHICLE_ACCELERATION if paths else ACCELERATION
    xy, velocity = smooth_track(t, center, SMOOTHER_STD, acceleration)
    beams = points.beam[here]
    return MovingObject(
        0,
        scan,
        recording.stamp_ns[scan],
        xy,
        velocity,
        measure_box(points.xy[here] - xy[at], velocity[at]),
        beams,
        float(1.0 - p_static[beams].mean(dtype=np.float64)),
    )


def estimate_center_offset(centroid: Float, sensor: Float, xy: Float, at: Index) -> Float:
    """(L, 2) from the centroid of the end points to the object's center: one side is visible.

    The end points on a disk lie on average pi / 4 of its radius before its center. The radius is
    half the width seen across the beams in most scans, and at most that of a car.

    Args:
        centroid: (L, 2) of the end points in each scan.
        sensor: (L, 2) position of the sensor.
        xy: (n, 2) the end points.
        at: (n,) which of the L scans each is of.
    """
    away = centroid - sensor
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    _, across = se2.along_and_across(xy - centroid[at], away[at])
    low, high = np.full(len(centroid), np.inf), np.full(len(centroid), -np.inf)
    np.minimum.at(low, at, across)
    np.maximum.at(high, at, across)
    radius = 0.5 * float(np.quantile(high - low, _WIDTH_QUANTILE))
    return min(np.pi / 4.0 * radius, _MAX_OFFSET) * away


def measure_box(offset: Float, velocity: Float) -> tuple[float, float]:
    """Extent in metres along and across the motion; of one at rest, along its principal axes.

    Args:
        offset: (n, 2) end points from the center.
        velocity: (n, 2) at that time.
    """
    speed = np.linalg.norm(velocity, axis=1)
    if np.median(speed) > HEADING_SPEED:
        heading = velocity / np.maximum(speed, 1e-9)[:, None]
        along, across = se2.along_and_across(offset, heading)
    else:
        axes = np.linalg.eigh(offset.T @ offset)[1]
        across, along = (offset @ axes).T
    low, high = np.percentile([along, across], [_OUTLIERS, 100.0 - _OUTLIERS], axis=1)
    length, width = (high - low).tolist()
    return length, width
