"""Recordings from arrays in memory; `Recording.from_scans` and `from_clouds` lead here."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core import arrays
from stillmap.core.recording import Recording
from stillmap.core.timestamps import MAX_BEAM_TIME
from stillmap.io.array_checks import (
    describe,
    poses_to_matrices,
    require_all,
    require_length,
    stamps_to_ns,
    to_array,
)
from stillmap.io.builder import ReadContext, RecordingBuilder
from stillmap.prepare import self_filter
from stillmap.prepare.max_range import RangeRule, apply_range_rule, infer_range_rule
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE, ReadOptions

Float = NDArray[np.float64]

FORMAT = "arrays"  # in Recording.source
_SAMPLE = 1 << 22  # readings from which the range rule is inferred
_BLOCK = 1 << 18  # beams at a time


def recording_from_scans(
    stamps: ArrayLike,
    ranges: ArrayLike,
    angles: ArrayLike,
    odometry: ArrayLike | None,
    *,
    min_range: float,
    max_range: float | None,
    sensor_pose: ArrayLike | None,
    time_increment: float,
) -> Recording:
    """See `Recording.from_scans`."""
    stamp_ns = stamps_to_ns(stamps)
    readings = to_array("ranges", ranges, "(T, N)")
    T, N = readings.shape
    require_length("ranges", T, len(stamp_ns), "stamps")
    directions = to_array("angles", angles, "(N,)").astype(np.float64)
    require_length("angles", len(directions), N, "the columns of ranges")
    require_all("angles", np.isfinite(directions), "finite radians", directions)
    if not N:
        raise ValueError("ranges: expected at least one beam, got none")
    if not abs(time_increment) * (N - 1) <= MAX_BEAM_TIME:
        what = f"expected scans of up to {MAX_BEAM_TIME:g} s"
        raise ValueError(f"time_increment: {what}, got {time_increment}")
    options = _read_options(min_range, max_range)
    with np.errstate(over="ignore", invalid="ignore"):
        step = max(1, -(-T * N // _SAMPLE))
        rule, warnings = infer_range_rule(np.asarray(readings[::step], np.float32), None, options)
        points, hit = _end_points(readings, directions, rule)
    times = np.tile((time_increment * np.arange(N)).astype(np.float32), T)
    notes = {"beams_per_scan": N, "ranges": rule.to_dict(), **_angle_notes(directions)}
    return Recording(
        stamp_ns=stamp_ns,
        offset=np.arange(T + 1, dtype=np.int64) * N,
        points=points,
        hit=hit,
        T_base_sensor=_sensor_matrix(sensor_pose, 2),
        sensor=np.zeros(T, np.int32),
        T_odom_base=None if odometry is None else poses_to_matrices("odometry", odometry, T, 2),
        source=_source(notes, sensor_pose, warnings),
        beam_time=times if time_increment else None,
    )


def recording_from_clouds(
    stamps: ArrayLike,
    clouds: Iterable[ArrayLike],
    odometry: ArrayLike | None,
    *,
    min_range: float,
    max_range: float | None,
    sensor_pose: ArrayLike | None,
    beam_times: Sequence[ArrayLike] | None,
) -> Recording:
    """See `Recording.from_clouds`."""
    stamp_ns = stamps_to_ns(stamps)
    T = len(stamp_ns)
    if beam_times is not None:
        require_length("beam_times", len(beam_times), T, "stamps")
    context = ReadContext(_read_options(min_range, max_range))
    builder = RecordingBuilder(3, context, beam_times=beam_times is not None)
    with np.errstate(over="ignore", invalid="ignore"):
        for t, cloud in enumerate(clouds):
            if t >= T:
                raise ValueError(f"clouds: expected {T} as in stamps, got more")
            points = _cloud(cloud, t)
            times = None if beam_times is None else _times(beam_times[t], t, len(points))
            builder.add_scan(int(stamp_ns[t]), points, beam_time=times)
        require_length("clouds", len(builder), T, "stamps")
        recording = builder.build(
            _sensor_matrix(sensor_pose, 3),
            source=_source({}, sensor_pose, []),
            T_odom_base=None if odometry is None else poses_to_matrices("odometry", odometry, T, 3),
        )
        return self_filter.remove_self_returns(recording)


def _read_options(min_range: float, max_range: float | None) -> ReadOptions:
    limits = f"0 <= min_range < max_range <= {MAX_PLAUSIBLE_RANGE:g}"
    end = MAX_PLAUSIBLE_RANGE if max_range is None else max_range
    if not (0.0 <= min_range < end <= MAX_PLAUSIBLE_RANGE):
        raise ValueError(f"min_range, max_range: expected {limits}, got {min_range}, {max_range}")
    return ReadOptions(
        min_range=float(min_range), max_range=None if max_range is None else float(max_range)
    )


def _end_points(
    readings: NDArray[Any], directions: Float, rule: RangeRule
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(T N, 2) end points in the sensor frame and (T N,) hits of readings (T, N)."""
    T, N = readings.shape
    points, hit = arrays.empty((T * N, 2), np.float32), arrays.empty((T * N,), np.bool_)
    unit = np.stack([np.cos(directions), np.sin(directions)], axis=1).astype(np.float32)
    scans = max(1, _BLOCK // N)
    for first in range(0, T, scans):
        length, hits = apply_range_rule(
            np.asarray(readings[first : first + scans], np.float32), rule
        )
        beams = slice(first * N, first * N + length.size)
        points[beams] = (length[..., None] * unit).reshape(-1, 2)
        hit[beams] = hits.reshape(-1)
    return points, hit


def _angle_notes(directions: Float) -> dict[str, float]:
    """First angle and step of evenly spaced beams, as writers of LaserScan want them."""
    steps = np.diff(directions)
    if not len(steps) or np.ptp(steps) > 1e-6:
        return {}
    return {"start_angle": float(directions[0]), "angle_step": float(steps.mean())}


def _sensor_matrix(pose: ArrayLike | None, dimension: int) -> Float:
    """(1, D+1, D+1) pose of the sensor on the robot."""
    if pose is None:
        return np.eye(dimension + 1)[None]
    one = np.asarray(pose)
    if one.shape not in ((dimension + 1,) * 2, *([(3,)] if dimension == 2 else [])):
        shapes = "(4, 4)" if dimension == 3 else "(3,) x, y, theta or (3, 3)"
        raise ValueError(f"sensor_pose: expected {shapes}, got {describe(one)}")
    return poses_to_matrices("sensor_pose", one[None], 1, dimension)


def _source(
    notes: dict[str, Any], sensor_pose: ArrayLike | None, warnings: list[str]
) -> dict[str, Any]:
    # a given pose is kept, another one is calibrated from the motion where that shows it
    how = "given" if sensor_pose is not None else "the sensor is the robot's frame"
    sensor = {"name": "sensor", **notes, "extrinsics": {"how": how}}
    return {"format": FORMAT, "sensors": [sensor], "warnings": warnings}


def _cloud(cloud: ArrayLike, scan: int) -> NDArray[Any]:
    points = np.asarray(cloud)
    if points.dtype.kind not in "fiu" or points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"clouds[{scan}]: expected (N, 3) metres, got {describe(points)}")
    return points


def _times(times: ArrayLike, scan: int, count: int) -> NDArray[Any]:
    out = to_array(f"beam_times[{scan}]", times, "(N,)")
    require_length(f"beam_times[{scan}]", len(out), count, f"clouds[{scan}]")
    return out
