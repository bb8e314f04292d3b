"""Recordings from arrays in memory, and checks of arrays: each error names argument and shape."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.core.timestamps import MAX_BEAM_TIME, MAX_STAMP_NS
from stillmap.io.builder import ReadContext, RecordingBuilder
from stillmap.io.rigid_transforms import MAX_TRANSLATION
from stillmap.prepare.lasers import RawLaser, RawLasers, place_beams, unit_vectors
from stillmap.prepare.options import MAX_PLAUSIBLE_RANGE, ReadOptions
from stillmap.prepare.self_filter import remove_self_returns

Float = NDArray[np.float64]

FORMAT = "arrays"  # in Recording.source

_MAX_SECONDS = MAX_STAMP_NS // 10**9
_MIN_STEP_NS = 1000  # between scans: integers that rise more slowly are no nanoseconds
_MAX_SKEW = 1e-3  # of R R^T from the identity: poses printed with few digits pass


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
    notes: dict[str, Any] = {"beams_per_scan": N}
    steps = np.diff(directions)
    if len(steps) and np.ptp(steps) <= 1e-6:  # as writers of LaserScan want them
        notes |= {"start_angle": float(directions[0]), "angle_step": float(steps.mean())}
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
        raw = RawLasers([laser], [mount], T_odom_base, _source(notes, sensor_pose))
        return place_beams(raw, options, None)


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
            source=_source({}, sensor_pose),
            T_odom_base=None if odometry is None else poses_to_matrices("odometry", odometry, T, 3),
        )
        return remove_self_returns(recording)


def _read_options(min_range: float, max_range: float | None) -> ReadOptions:
    limits = f"0 <= min_range < max_range <= {MAX_PLAUSIBLE_RANGE:g}"
    end = MAX_PLAUSIBLE_RANGE if max_range is None else max_range
    if not (0.0 <= min_range < end <= MAX_PLAUSIBLE_RANGE):
        raise ValueError(f"min_range, max_range: expected {limits}, got {min_range}, {max_range}")
    return ReadOptions(
        min_range=float(min_range), max_range=None if max_range is None else float(max_range)
    )


def _sensor_matrix(pose: ArrayLike | None, dimension: int) -> Float:
    """(1, D+1, D+1) pose of the sensor on the robot."""
    if pose is None:
        return np.eye(dimension + 1)[None]
    given = np.asarray(pose)
    if given.shape not in ((dimension + 1,) * 2, *([(3,)] if dimension == 2 else [])):
        shapes = "(4, 4)" if dimension == 3 else "(3,) x, y, theta or (3, 3)"
        raise ValueError(f"sensor_pose: expected {shapes}, got {_describe(given)}")
    return poses_to_matrices("sensor_pose", given[None], 1, dimension)


def _source(notes: dict[str, Any], sensor_pose: ArrayLike | None) -> dict[str, Any]:
    # a given pose is kept, another one is calibrated from the motion where that shows it
    how = "given" if sensor_pose is not None else "the sensor is the robot's frame"
    sensor = {"name": "sensor", **notes, "extrinsics": {"how": how}}
    return {"format": FORMAT, "sensors": [sensor], "warnings": []}


def stamps_to_ns(stamps: ArrayLike) -> NDArray[np.int64]:
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
        raise ValueError(
            f"stamps: expected no decrease, got {given[t]} after {given[t - 1]} at {t}"
        )
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


def require_all(name: str, good: NDArray[np.bool_], what: str, values: NDArray[Any]) -> None:
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
    if count == 1 and size == 3 and not flat and _is_plainly_rigid(*array[0].tolist()):
        return array  # of live odometry: what follows takes 50 times as long
    finite = np.isfinite(array).reshape(count, -1).all(axis=1)
    require_all(name, finite, "finite numbers", array)
    near = (np.abs(array) < MAX_TRANSLATION).all(axis=tuple(range(1, array.ndim)))
    require_all(name, near, f"numbers below {MAX_TRANSLATION:g}", array)
    if flat:
        return se2.matrix(*array.T)
    R = array[:, :dimension, :dimension]
    skew = np.abs(R @ R.swapaxes(1, 2) - np.eye(dimension)).reshape(count, -1).max(axis=1)
    last_row = np.abs(array[:, dimension] - np.eye(size)[dimension]).max(axis=1)
    good = (skew < _MAX_SKEW) & (np.linalg.det(R) > 0.0) & (last_row < _MAX_SKEW)
    require_all(name, good, "rigid transforms", array)
    return array


def _is_plainly_rigid(first: list[float], second: list[float], last: list[float]) -> bool:
    """True if a matrix (3, 3) is a pose in the plane, well within the tolerances."""
    (a, b, x), (c, d, y) = first, second
    skew = abs(a * a + b * b - 1.0) + abs(c * c + d * d - 1.0) + abs(a * c + b * d)
    is_near = abs(x) < MAX_TRANSLATION and abs(y) < MAX_TRANSLATION
    return skew < 0.5 * _MAX_SKEW and a * d > b * c and is_near and last == [0.0, 0.0, 1.0]


def _describe(array: NDArray[Any]) -> str:
    """Shape and type of an array, as messages give them."""
    return f"{array.shape} {array.dtype}"
