"""Checks of the arrays that a recording is made from: each error names argument and shape."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core import se2
from stillmap.core.timestamps import MAX_STAMP_NS
from stillmap.io.rigid_transforms import MAX_TRANSLATION

Float = NDArray[np.float64]

_MAX_SECONDS = MAX_STAMP_NS // 10**9
_MIN_STEP_NS = 1000  # between scans: integers that rise more slowly are no nanoseconds
_MAX_SKEW = 1e-3  # of R R^T from the identity: poses printed with few digits pass


def stamps_to_ns(stamps: ArrayLike) -> NDArray[np.int64]:
    """(T,) int64 nanoseconds of stamps in seconds (float), nanoseconds (integer) or datetime64.

    Raises:
        ValueError: no vector of T >= 1 times from 1824 to 2116 that do not decrease.
    """
    given = np.asarray(stamps)
    if given.ndim != 1 or not len(given) or given.dtype.kind not in "fiuM":
        raise ValueError(
            "stamps: expected (T,) seconds (float), nanoseconds (int) or datetime64, T >= 1, "
            f"got {describe(given)}"
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
        raise ValueError(f"{name}: expected {shape} real numbers, got {describe(array)}")
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
        raise ValueError(f"{name}: expected {shapes}, got {describe(array)}")
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


def describe(array: NDArray[Any]) -> str:
    """Shape and type of an array, as messages give them."""
    return f"{array.shape} {array.dtype}"
