"""Scans as they arrive: what users push, the plain arrays that everything else works on, and what
of them updates the labels."""

# signatures name ArrayLike instead of spelling it out
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.arrays import finite_rows
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.core.timestamps import MAX_BEAM_TIME
from stillmap.io import from_arrays
from stillmap.io.trajectory import MAX_MOUNT
from stillmap.prepare.max_range import MAX_ZERO_RANGE
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE
from stillmap.slam import scan_hits

# m within which nearly all readings of a covered sensor lie: what surrounds it so closely moves
# with the robot
_COVER_DISTANCE, _COVER_SHARE = 0.3, 0.9
# scans of a planar laser in a time bin in which each beam is followed; in others only its end
# counts
_FOLLOWED, _MAX_STRIDE, _RATE_GAIN = 3.0, 8, 0.1
_MARGIN, _MAX_MARGIN = 0.1, 1.0  # m behind a surface where a beam has passed it; at grazing angles


@dataclass(frozen=True, eq=False)
class Scan(ShortRepr):
    """One scan of a laser, or one sweep of a lidar.

    Readings mean what they mean in a ROS LaserScan: NaN, negative and near zero: unusable; +inf and
    readings from `max_range` on: nothing within reach.

    Attributes:
        stamp: seconds as a float, nanoseconds as an integer, or datetime64.
        ranges: (N,) metres; None: `points` are given.
        angles: (N,) radians in the sensor frame, counter-clockwise.
        points: (N, 2) or (N, 3) end points in the sensor frame, metres, instead of ranges and
            angles; what is not finite is unusable.
        hit: (N,) of `points`: False where nothing was met within reach; None: all are hits.
        sensor: name or number; each has its own pose on the robot.
        sensor_pose: of the sensor on the robot, (3,) x, y, theta, (3, 3) or (4, 4); None: at the
            robot's centre.
        beam_times: (N,) seconds after the stamp; None: all beams have the stamp of the scan.
        min_range: metres; shorter readings are unusable.
        max_range: metres; None: only +inf is beyond reach.
    """

    stamp: ArrayLike
    ranges: ArrayLike | None = None
    angles: ArrayLike | None = None
    points: ArrayLike | None = None
    hit: ArrayLike | None = None
    sensor: str | int = 0
    sensor_pose: ArrayLike | None = None
    beam_times: ArrayLike | None = None
    min_range: float = 0.0
    max_range: float | None = None


@dataclass(frozen=True, eq=False)
class ScanBeams(ShortRepr):
    """The beams of one scan.

    Attributes:
        stamp_ns: nanoseconds.
        points: (N, D) float32, in the sensor frame; NaN: unusable. Without a return they end where
            known free space ends.
        hit: (N,) bool.
        T_base_sensor: (D+1, D+1).
        sensor: name or number.
        beam_time: (N,) float32, seconds after the stamp; None: all beams have it.
    """

    stamp_ns: int
    points: Float32
    hit: Bool
    T_base_sensor: Float
    sensor: str | int = 0
    beam_time: Float32 | None = None

    @classmethod
    def of(cls, recording: Recording, number: int, name: str | int | None = None) -> ScanBeams:
        """A scan of a recording, copied; `name` of its sensor, None: the recording's number."""
        beams, sensor = recording.beams_of(number), int(recording.sensor[number])
        times = recording.beam_time
        return cls(
            int(recording.stamp_ns[number]),
            np.array(recording.points[beams]),
            np.array(recording.hit[beams]),
            recording.T_base_sensor[sensor],
            sensor if name is None else name,
            None if times is None else np.array(times[beams]),
        )

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.points.shape[1])


def to_beams(scan: Scan) -> ScanBeams:
    """The beams of a scan.

    Raises:
        ValueError: names the argument, what was expected, and what it was.
    """
    stamp_ns = int(from_arrays.stamps_to_ns(np.atleast_1d(np.asarray(scan.stamp)))[0])
    points, hit = _from_ranges(scan) if scan.points is None else _from_points(scan)
    D = points.shape[1]
    times = scan.beam_times
    if times is not None:
        times = from_arrays.to_array("beam_times", times, "(N,)").astype(np.float32)
        from_arrays.require_length("beam_times", len(times), len(points), "the beams")
        good = np.abs(times) <= MAX_BEAM_TIME
        from_arrays.require_all("beam_times", good, f"up to {MAX_BEAM_TIME:g} s", times)
    pose = _sensor_matrix(scan.sensor_pose, D)
    return ScanBeams(stamp_ns, points, hit, pose, scan.sensor, times)


def drop_cover(beams: ScanBeams) -> ScanBeams:
    """The beams of a scan; none of them usable if something covers the sensor."""
    usable = beams.points[finite_rows(beams.points)]
    near = np.linalg.norm(usable, axis=1) < _COVER_DISTANCE
    if np.count_nonzero(near) < max(_COVER_SHARE * len(near), 1.0):
        return beams
    nothing = np.full_like(beams.points, np.nan)
    return replace(beams, points=nothing, hit=np.zeros_like(beams.hit))


def take_beams(beams: ScanBeams, kept: Index | slice) -> ScanBeams:
    """Some beams of a scan, copied."""
    times = None if beams.beam_time is None else beams.beam_time[kept].copy()
    points, hit = np.ascontiguousarray(beams.points[kept]), beams.hit[kept].copy()
    return replace(beams, points=points.copy(), hit=hit, beam_time=times)


def deskew(beams: ScanBeams, twist: Float) -> ScanBeams:
    """A scan as if all its beams had been taken at its stamp.

    Args:
        beams: of the scan.
        twist: (3,) or (6,) m/s and rad/s of the base in its own frame.
    """
    if beams.beam_time is None:
        return beams
    D, T = beams.dimension, beams.T_base_sensor
    if D == 3:
        xi = se3.adjoint(se2.inverse(T)) @ twist  # of the sensor
        moved = _core.transform_by_twist(beams.points, beams.beam_time, xi)
        return replace(beams, points=moved, beam_time=None)
    in_base = np.zeros((len(beams.points), 3), np.float32)
    in_base[:, :2] = beams.points @ T[:2, :2].T + T[:2, 2]
    xi = np.array([twist[0], twist[1], 0.0, 0.0, 0.0, twist[2]])
    moved = _core.transform_by_twist(in_base, beams.beam_time, xi)[:, :2]
    points = ((moved - T[:2, 2]) @ T[:2, :2]).astype(np.float32)
    return replace(beams, points=points, beam_time=None)


def _from_ranges(scan: Scan) -> tuple[Float32, Bool]:
    if scan.ranges is None or scan.angles is None:
        raise ValueError("scan: expected ranges and angles, or points")
    ranges = from_arrays.to_array("ranges", scan.ranges, "(N,)").astype(np.float64)
    angles = from_arrays.to_array("angles", scan.angles, "(N,)").astype(np.float64)
    from_arrays.require_length("angles", len(angles), len(ranges), "ranges")
    limit = MAX_PLAUSIBLE_RANGE if scan.max_range is None else scan.max_range
    beyond = ranges >= limit
    usable = beyond | (ranges >= max(scan.min_range, MAX_ZERO_RANGE))
    # without a stated range nobody knows how far a beam without a return went
    usable &= ~beyond | (scan.max_range is not None)
    length = np.where(usable, np.minimum(ranges, limit), np.nan)
    points = np.stack([length * np.cos(angles), length * np.sin(angles)], axis=1)
    return points.astype(np.float32), usable & ~beyond


def _from_points(scan: Scan) -> tuple[Float32, Bool]:
    points = np.array(scan.points, np.float32)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"points: expected (N, 2) or (N, 3), got {points.shape}")
    finite = finite_rows(points)
    near = np.linalg.norm(np.where(finite[:, None], points, 0.0), axis=1)
    usable: Bool = finite & (near >= max(scan.min_range, MAX_ZERO_RANGE))
    usable &= near < MAX_PLAUSIBLE_RANGE
    points[~usable] = np.nan
    hit = usable
    if scan.hit is not None:
        given = np.asarray(scan.hit, np.bool_)
        from_arrays.require_length("hit", len(given), len(points), "points")
        hit = usable & given
    if scan.max_range is None:
        return points, hit
    beyond = near > scan.max_range
    points[beyond] *= (scan.max_range / near[beyond])[:, None]
    return points, hit & ~beyond


def _sensor_matrix(pose: ArrayLike | None, dimension: int) -> Float:
    if pose is None:
        return np.eye(dimension + 1)
    poses = np.asarray(pose)[None]
    out: Float = from_arrays.poses_to_matrices("sensor_pose", poses, 1, dimension)[0]
    if not np.hypot.reduce(out[:dimension, dimension]) <= MAX_MOUNT:
        raise ValueError(f"sensor_pose: expected at most {MAX_MOUNT:.0f} m from the robot's base")
    return out


@dataclass(frozen=True, eq=False)
class Observation(ShortRepr):
    """A scan as the labels take it.

    Attributes:
        beams: of the scan, as if all had been taken at its stamp.
        T: (D+1, D+1) pose of the base in the frame of the odometry by scans.
        margin: (N,) float32, m before the end of each beam that it has not passed; inf: only its
            end counts. In 3D None: it follows from the beams around.
        tag: number of the keyframe by which cells move when the map is corrected.
    """

    beams: ScanBeams
    T: Float
    margin: Float32 | None
    tag: int = 0


class BeamSelector:
    """Selects the beams of planar scans that are followed: fast sensors see the same several times
    in a time bin.

    Args:
        bin_seconds: length of a time bin.
    """

    def __init__(self, bin_seconds: float) -> None:
        self._bin_ns = 1e9 * bin_seconds
        # of each sensor: running mean of ns between its scans, their number, the last stamp
        self._rates = dict[str | int, tuple[float, int, int]]()

    def select(self, beams: ScanBeams) -> Bool:
        """(N,) beams to follow, others in every scan."""
        period_ns, count, last_ns = self._rates.get(beams.sensor, (np.inf, 0, 0))
        step = float(beams.stamp_ns - last_ns)
        if count == 1:
            period_ns = step
        elif count > 1:
            period_ns += _RATE_GAIN * (step - period_ns)
        self._rates[beams.sensor] = period_ns, count + 1, beams.stamp_ns
        stride = int(np.clip(self._bin_ns / (_FOLLOWED * max(period_ns, 1.0)), 1, _MAX_STRIDE))
        return np.asarray((np.arange(len(beams.points)) + count + 1) % stride == 0)


def find_margins(beams: ScanBeams, hits: scan_hits.Scan, followed: Bool) -> Float32:
    """(N,) margins of the beams of a planar scan, see `Observation`.

    Args:
        beams: of the scan.
        hits: of it in the base frame; a normal of 0: unknown.
        followed: (N,) beams that show free space.
    """
    every = np.zeros(beams.points.shape)  # normals in the sensor frame; 0 where nothing was hit
    every[beams.hit] = hits.normals @ beams.T_base_sensor[:2, :2]  # rotated back
    margin, normals = np.full(len(beams.points), np.inf, np.float32), every[followed]
    points = np.where(beams.hit[followed, None], beams.points[followed], 0.0)
    length = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
    cos = np.abs(np.einsum("nd,nd->n", points, normals)) / length
    cos[(normals[:, 0] == 0.0) & (normals[:, 1] == 0.0)] = 1.0
    margin[followed] = np.minimum(_MARGIN / np.maximum(cos, 1e-3), _MAX_MARGIN)
    return margin
