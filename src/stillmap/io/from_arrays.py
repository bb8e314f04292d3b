"""Recordings from arrays in memory, and checks of arrays: each error names argument and shape."""

# signatures name ArrayLike instead of spelling it out
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Int64
from stillmap.core.recording import Recording
from stillmap.core.source import LaserPose, SensorNotes, Source
from stillmap.core.timestamps import MAX_BEAM_TIME, MAX_STAMP_NS
from stillmap.io.builder import RecordingBuilder
from stillmap.io.trajectory import is_rigid
from stillmap.prepare.lasers import RawLaser, RawLasers, unit_vectors
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE, ReadOptions
from stillmap.prepare.prepare import prepare

FORMAT = "arrays"  # in Recording.source

_MAX_SECONDS = MAX_STAMP_NS // 10**9
_MIN_STEP_NS = 1000  # between scans: integers that rise more slowly are no nanoseconds
_MAX_SKEW = 1e-3  # of R R^T from the identity: poses printed with few digits pass


def recording_from_scans(
    stamps: ArrayLike,
    ranges: ArrayLike,
    angles: ArrayLike,
    odometry: ArrayLike | None = None,
    *,
    min_range: float = 0.0,
    max_range: float | None = None,
    sensor_pose: ArrayLike | None = None,
    time_increment: float = 0.0,
) -> Recording:
    """A 2D recording from the arrays of a laser scanner.

    Readings mean what they mean in a ROS LaserScan: NaN, negative and near zero: unusable;
    +inf and readings from `max_range` on: nothing within reach, the beam shows free space.
    As when a file is read, values that repeat at the top of the readings are recognised as
    codes of the maximum range, and returns from the robot itself are removed.

    Args:
        stamps: (T,) not decreasing; floats are seconds, integers nanoseconds, or datetime64.
        ranges: (T, N) metres, one row per scan.
        angles: (N,) radians in the sensor frame, counter-clockwise, in any order.
        odometry: (T, 3) x, y (m), theta (rad), or (T, 3, 3) T_odom_base; None: no odometry.
        min_range: metres; shorter readings are unusable.
        max_range: metres; readings from it on are maximum range; None: found in the readings.
        sensor_pose: of the laser on the robot, (3,) x, y, theta or (3, 3); None: at the
            robot's centre, unless the motion shows another place when the map is built.
        time_increment: seconds from beam to beam; the stamp is that of the first beam.

    Raises:
        ValueError: names the argument, what was expected, and what it was.

    Examples:
        >>> recording = stillmap.Recording.from_scans(stamps, ranges, angles, odometry)
        >>> result = stillmap.build(recording)
    """
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
    sensor, steps = _describe_sensor(sensor_pose, beams_per_scan=N), np.diff(directions)
    if len(steps) and np.ptp(steps) <= 1e-6:  # as writers of LaserScan want them
        first, step = float(directions[0]), float(steps.mean())
        sensor = replace(sensor, start_angle=first, angle_step=step)
    mount = _sensor_matrix(sensor_pose, 2)
    T_odom_base = None if odometry is None else poses_to_matrices("odometry", odometry, T, 2)
    with np.errstate(over="ignore", invalid="ignore"):
        laser = RawLaser(
            "",
            stamp_ns,
            np.ascontiguousarray(readings, np.float32).reshape(-1),
            np.arange(T, dtype=np.int64) * N,
            np.zeros(T, np.int64),
            [unit_vectors(directions).astype(np.float32)],
            (time_increment,),
        )
        source = Source(format=FORMAT, sensors=[sensor])
        return prepare(RawLasers([laser], [mount], T_odom_base, source), options)


def recording_from_clouds(
    stamps: ArrayLike,
    clouds: Iterable[ArrayLike],
    odometry: ArrayLike | None = None,
    *,
    min_range: float = 0.0,
    max_range: float | None = None,
    sensor_pose: ArrayLike | None = None,
    beam_times: Sequence[ArrayLike] | None = None,
) -> Recording:
    """A 3D recording from point clouds, one per sweep of a lidar.

    Args:
        stamps: (T,) not decreasing; floats are seconds, integers nanoseconds, or datetime64.
        clouds: T arrays (N_t, 3) in the sensor frame, metres; a generator will do. Points that
            are not finite, at the origin or implausibly far are unusable.
        odometry: (T, 4, 4) T_odom_base; None: no odometry.
        min_range: metres; nearer points are unusable.
        max_range: metres; points from it on are maximum range; None: every point is a hit.
        sensor_pose: (4, 4) of the lidar on the robot; None: at the robot's centre.
        beam_times: T arrays (N_t,) of seconds after the stamp; None: all points of a cloud
            have its stamp.

    Raises:
        ValueError: names the argument, what was expected, and what it was.

    Examples:
        >>> sweeps = (numpy.load(file) for file in files)
        >>> recording = stillmap.Recording.from_clouds(stamps, sweeps)
    """
    stamp_ns = stamps_to_ns(stamps)
    T = len(stamp_ns)
    if beam_times is not None:
        require_length("beam_times", len(beam_times), T, "stamps")
    options = _read_options(min_range, max_range)
    builder = RecordingBuilder(3, None, beam_times=beam_times is not None)
    with np.errstate(over="ignore", invalid="ignore"):
        for t, cloud in enumerate(clouds):
            if t >= T:
                raise ValueError(f"clouds: expected {T} as in stamps, got more")
            points, times = np.asarray(cloud), None
            if points.dtype.kind not in "fiu" or points.ndim != 2 or points.shape[1] != 3:
                raise ValueError(f"clouds[{t}]: expected (N, 3) metres, got {_describe(points)}")
            if beam_times is not None:
                times = to_array(f"beam_times[{t}]", beam_times[t], "(N,)")
                require_length(f"beam_times[{t}]", len(times), len(points), f"clouds[{t}]")
            builder.add_scan(int(stamp_ns[t]), points, beam_time=times)
        require_length("clouds", len(builder), T, "stamps")
        recording = builder.build(
            _sensor_matrix(sensor_pose, 3),
            source=Source(format=FORMAT, sensors=[_describe_sensor(sensor_pose)]),
            T_odom_base=None if odometry is None else poses_to_matrices("odometry", odometry, T, 3),
        )
        return prepare(recording, options)


def _read_options(min_range: float, max_range: float | None) -> ReadOptions:
    limits = f"0 <= min_range < max_range <= {MAX_PLAUSIBLE_RANGE:g}"
    end = MAX_PLAUSIBLE_RANGE if max_range is None else max_range
    if not (0.0 <= min_range < end <= MAX_PLAUSIBLE_RANGE):
        raise ValueError(f"min_range, max_range: expected {limits}, got {min_range}, {max_range}")
    longest = None if max_range is None else float(max_range)
    return ReadOptions(min_range=float(min_range), max_range=longest)


def _sensor_matrix(pose: ArrayLike | None, dimension: int) -> Float:
    """(1, D+1, D+1) pose of the sensor on the robot."""
    if pose is None:
        return np.eye(dimension + 1)[None]
    given = np.asarray(pose)
    if given.shape not in ((dimension + 1,) * 2, *([(3,)] if dimension == 2 else [])):
        shapes = "(4, 4)" if dimension == 3 else "(3,) x, y, theta or (3, 3)"
        raise ValueError(f"sensor_pose: expected {shapes}, got {_describe(given)}")
    return poses_to_matrices("sensor_pose", given[None], 1, dimension)


def _describe_sensor(sensor_pose: ArrayLike | None, **notes: Any) -> SensorNotes:
    # a given pose is kept, another one is calibrated from the motion where that shows it
    how = "given" if sensor_pose is not None else "the sensor is the robot's frame"
    return SensorNotes("sensor", extrinsics=LaserPose(how=how), **notes)


def stamps_to_ns(stamps: ArrayLike) -> Int64:
    """(T,) int64 nanoseconds of stamps in seconds (float), nanoseconds (integer) or datetime64.

    Raises:
        ValueError: no vector of T >= 1 times from 1824 to 2116 that do not decrease.
    """
    given = np.asarray(stamps)
    if given.ndim != 1 or not len(given) or given.dtype.kind not in "fiuM":
        raise ValueError(
            "stamps: expected (T,) seconds (float), nanoseconds (int) or datetime64, T >= 1, "
            f"got {_describe(given)}"
        )
    kind = given.dtype.kind
    seconds = given.astype("datetime64[s]").astype(np.int64) if kind == "M" else given
    seconds = seconds.astype(np.float64) * (1e-9 if kind in "iu" else 1.0)
    require_all("stamps", np.abs(seconds) < _MAX_SECONDS, "times from 1824 to 2116", given)
    if kind == "M":
        out = given.astype("datetime64[ns]").astype(np.int64)
    elif kind == "f":
        whole = np.floor(seconds)  # seconds of 1970 have no exact product with 1e9
        out = whole.astype(np.int64) * 10**9 + np.rint((seconds - whole) * 1e9).astype(np.int64)
    else:
        out = given.astype(np.int64)
        if len(out) > 1 and 0 < out[-1] - out[0] < _MIN_STEP_NS * (len(out) - 1):
            raise ValueError(
                f"stamps: integers are nanoseconds, these span {out[-1] - out[0]} ns; "
                "expected floats for seconds"
            )
    falls = np.flatnonzero(np.diff(out) < 0)
    if len(falls):
        t = int(falls[0]) + 1
        fall = f"{given[t]} after {given[t - 1]} at {t}"
        raise ValueError(f"stamps: expected no decrease, got {fall}")
    return out


def to_array(name: str, value: ArrayLike, shape: str) -> NDArray[Any]:
    """An array of real numbers with as many dimensions as `shape` names, as in "(T, N)".

    Raises:
        ValueError: it is none.
    """
    try:
        array = np.asanyarray(value)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name}: expected {shape}, got rows of different lengths") from error
    if array.dtype.kind not in "fiu" or array.ndim != shape.count(",") + (not shape.endswith(",)")):
        raise ValueError(f"{name}: expected {shape} real numbers, got {_describe(array)}")
    return array


def require_length(name: str, got: int, expected: int, like: str) -> None:
    """Raises ValueError where a length differs from that of another argument."""
    if got != expected:
        raise ValueError(f"{name}: expected {expected} as in {like}, got {got}")


def require_all(name: str, good: Bool, what: str, values: NDArray[Any]) -> None:
    """Raises ValueError with the first value (or row of values) that is not good."""
    bad = np.flatnonzero(~good)
    if len(bad):
        raise ValueError(f"{name}: expected {what}, got {values[bad[0]]} at {bad[0]}")


def poses_to_matrices(
    name: str, value: ArrayLike, count: int, dimension: int, like: str = "stamps"
) -> Float:
    """(T, D+1, D+1) rigid transforms of matrices, or in 2D of (T, 3) x, y (m), theta (rad).

    Raises:
        ValueError: another shape or number of poses, a number that is not finite, no rotation.
    """
    array, size = np.asarray(value), dimension + 1
    shapes = f"(T, {size}, {size})" if dimension == 3 else "(T, 3) x, y, theta or (T, 3, 3)"
    flat = dimension == 2 and array.ndim == 2
    if array.dtype.kind not in "fiu" or array.shape[1:] != ((3,) if flat else (size, size)):
        raise ValueError(f"{name}: expected {shapes}, got {_describe(array)}")
    require_length(name, len(array), count, like)
    array = array.astype(np.float64)
    with np.errstate(invalid="ignore"):
        T = se2.matrix(*array.T) if flat else array
    require_all(name, is_rigid(T, _MAX_SKEW), "rigid transforms within a million km", array)
    return T


def _describe(array: NDArray[Any]) -> str:
    """Shape and type of an array, as messages give them."""
    return f"{array.shape} {array.dtype}"
