"""Moving things as results: where each went, how fast, how large it is, and which beams saw it."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.recording import Recording
from stillmap.tracking.association import assign_tracks
from stillmap.tracking.clustering import DynamicPoints, extract_dynamic_points
from stillmap.tracking.options import ObjectOptions
from stillmap.tracking.smoother import smooth_track
from stillmap.tracking.tracklets import compute_centroids, iterate_tracks, stitch_tracklets

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_WALKS = 0.3  # m/s from where on a thing's velocity says where its front is
_MOST = 0.8  # of the scans see no more of its width
_DEEPEST = 0.9  # m, half the width of a car
_EDGE = 5.0  # percent of its points on either side that a box leaves out: legs swing


@dataclass(frozen=True, eq=False)
class MovingObject:
    """Something that moved.

    Attributes:
        id: from 0, in the order in which they were first seen.
        scan: (L,) scans that saw it, rising.
        stamp_ns: (L,) their stamps.
        xy: (L, 2) metres, its middle in the map frame, smoothed; as if it were round.
        velocity: (L, 2) metres per second.
        size: metres along and across the way it went, and in 3D its height; of what was seen of it.
        beams: (n,) beams of the recording that ended on it, rising.
        p_dynamic: mean probability of these beams to be dynamic.
        z: (L,) metres, how high its middle is in the map frame; None in 2D.
    """

    id: int
    scan: Index
    stamp_ns: NDArray[np.int64]
    xy: Float
    velocity: Float
    size: tuple[float, ...]
    beams: Index
    p_dynamic: float
    z: Float | None = None


def track_objects(
    recording: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
    options: ObjectOptions,
) -> list[MovingObject]:
    """What moved in a recording.

    Args:
        recording: 2D, M beams, without motion during its scans.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) probability that a static object reflected each beam.
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
    points = extract_dynamic_points(recording, poses, p_static, options)
    if len(points.scan) == 0:
        return []
    owner = stitch_tracklets(points, assign_tracks(points, options), options)
    large = _Kept(recording.scratch)
    for _, here in iterate_tracks(points, owner):
        found = compute_centroids(points, owner, here)
        one = _object(points, here, found.scan, found.xy, recording, p_static, options)
        if _extent(one) >= options.least_extent:
            large.add(one)
        arrays.release_pages(p_static)
    objects = large.objects()
    objects.sort(key=lambda one: (one.scan[0], one.beams[0]))
    return [dataclasses.replace(one, id=number) for number, one in enumerate(objects)]


class _Kept:
    """Objects whose arrays lie together, as parts of a few large ones."""

    _OF_SCANS: ClassVar = {"scan": np.intp, "stamp_ns": np.int64, "xy": float, "velocity": float}

    def __init__(self, scratch: Path | None) -> None:
        self._beams = arrays.ArrayBuilder(np.intp, (), scratch)
        self._columns = {
            name: arrays.ArrayBuilder(dtype, (2,) if dtype is float else (), scratch)
            for name, dtype in self._OF_SCANS.items()
        }
        self._rows: list[tuple[int, int, tuple[float, ...], float]] = []

    def add(self, one: MovingObject) -> None:
        self._rows.append((len(one.scan), len(one.beams), one.size, one.p_dynamic))
        self._beams.append(one.beams)
        for name, column in self._columns.items():
            column.append(getattr(one, name))

    def objects(self) -> list[MovingObject]:
        """All of them, without numbers; nothing can be added any more."""
        beams = self._beams.finished()
        columns = {name: column.finished() for name, column in self._columns.items()}
        out, scan, beam = [], 0, 0
        for n_scans, n_beams, size, p_dynamic in self._rows:
            part = {name: column[scan : scan + n_scans] for name, column in columns.items()}
            mine = beams[beam : beam + n_beams]
            out.append(MovingObject(0, size=size, beams=mine, p_dynamic=p_dynamic, **part))
            scan, beam = scan + n_scans, beam + n_beams
        return out


def _extent(one: MovingObject) -> float:
    """Metres that it went, and its length."""
    return float(np.linalg.norm(np.ptp(one.xy, axis=0))) + max(one.size)


def _object(
    points: DynamicPoints,
    here: Index,
    scan: Index,
    middle: Float,
    recording: Recording,
    p_static: NDArray[np.float32],
    options: ObjectOptions,
) -> MovingObject:
    seconds = points.seconds[scan]
    at = np.searchsorted(scan, points.scan[here])
    middle = middle + estimate_center_offset(middle, points.sensor[scan], points.xy[here], at)
    xy, velocity = smooth_track(seconds, middle, options.sigma_way, options.acceleration)
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


def estimate_center_offset(middle: Float, sensor: Float, xy: Float, at: Index) -> Float:
    """(L, 2) from the middle of what was seen to that of the thing: only one side is seen.

    Of a disc the end points lie pi / 4 of its radius before its middle. It is as wide as what was
    seen of the thing across the beams, in most scans, and no larger than a car.

    Args:
        middle: (L, 2) of the end points in each scan.
        sensor: (L, 2) where they were seen from.
        xy: (n, 2) the end points.
        at: (n,) which of the L scans each is of.
    """
    away = middle - sensor
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    offset = xy - middle[at]
    across = offset[:, 1] * away[at, 0] - offset[:, 0] * away[at, 1]
    low, high = np.full(len(middle), np.inf), np.full(len(middle), -np.inf)
    np.minimum.at(low, at, across)
    np.maximum.at(high, at, across)
    radius = 0.5 * float(np.quantile(high - low, _MOST))
    return min(np.pi / 4.0 * radius, _DEEPEST) * away


def measure_box(offset: Float, velocity: Float) -> tuple[float, float]:
    """Metres along and across the way it went; along and across its longer side if it stood.

    Args:
        offset: (n, 2) end points from the middle.
        velocity: (n, 2) then.
    """
    speed = np.linalg.norm(velocity, axis=1)
    if np.median(speed) > _WALKS:
        ahead = velocity / np.maximum(speed, 1e-9)[:, None]
        along = (offset * ahead).sum(axis=1)
        across = offset[:, 1] * ahead[:, 0] - offset[:, 0] * ahead[:, 1]
    else:
        axes = np.linalg.eigh(offset.T @ offset)[1]
        across, along = (offset @ axes).T
    low, high = np.percentile([along, across], [_EDGE, 100.0 - _EDGE], axis=1)
    length, width = (high - low).tolist()
    return length, width
