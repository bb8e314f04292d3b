"""Cameras and images of a recording; projection through pinhole cameras with lens distortion.

The models are those of OpenCV ("Camera Calibration and 3D Reconstruction", "Fisheye camera model"),
by the names of ROS: `plumb_bob` (k1, k2, p1, p2[, k3]), `rational_polynomial` (k1, k2, p1, p2, k3,
k4, k5, k6), `equidistant` (k1, k2, k3, k4), and "" for none. Pixel centres are integers.

With normalized coordinates x, s = |x|^2 and q = (p2, p1), the first two models are

    F(x) = g(s) x + 2 (q x) x + s q,    g(s) = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + ...)

whose Jacobian is symmetric. On a disc around the centre in which it is positive definite, F is the
gradient of a convex function, and so injective. Beyond, polynomials fold back, and points far
outside the image would project inside: nothing is visible there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float
from stillmap.core.short_repr import ShortRepr
from stillmap.core.timestamps import are_dated

Mask = NDArray[np.bool_]

Lens = tuple[str, tuple[float, ...]]


@dataclass(frozen=True, eq=False)
class Camera(ShortRepr):
    """One camera on the robot.

    Attributes:
        name: of its topic or folder.
        width, height: pixels.
        K: (3, 3) float64 intrinsics of the distorted images; None: unknown.
        model: distortion model, `plumb_bob`, `rational_polynomial`, `equidistant` or "" for none.
        distortion: (n,) float64 distortion parameters; empty for none.
        T_base_camera: (4, 4) float64, camera axes x right, y down, z ahead; None: unknown.
    """

    name: str
    width: int
    height: int
    K: NDArray[np.float64] | None
    model: str
    distortion: NDArray[np.float64]
    T_base_camera: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class Images(ShortRepr):
    """N images ordered by stamp, read from disk on demand.

    Attributes:
        stamp_ns: (N,) int64, clock of the scans, non-decreasing.
        camera: (N,) int32, index of the camera of each image.
        cameras: the cameras.
        load: reads one image; see `read`.
    """

    stamp_ns: NDArray[np.int64]
    camera: NDArray[np.int32]
    cameras: tuple[Camera, ...]
    load: Callable[[int], NDArray[Any]]

    def __post_init__(self) -> None:
        N = len(self.stamp_ns)
        if self.stamp_ns.dtype != np.int64 or self.camera.dtype != np.int32:
            raise ValueError("images: expected int64 stamps and int32 cameras")
        if self.camera.shape != (N,) or np.any(self.stamp_ns[1:] < self.stamp_ns[:-1]):
            raise ValueError(f"images: expected ({N},) cameras and non-decreasing stamps")
        if not are_dated(self.stamp_ns):
            raise ValueError("images: expected times from 1824 to 2116")
        if N and (self.camera.min() < 0 or self.camera.max() >= len(self.cameras)):
            raise ValueError("images: camera index out of range")

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def read(self, image: int) -> NDArray[Any]:
        """Read an image: (height, width, 3) uint8 RGB, or (height, width) uint8, uint16 or float32.

        Raises:
            InputError: it is damaged or missing.
        """
        return self.load(image)


PARAMETER_COUNTS = {
    "": (0,),
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (0, 8),
    "equidistant": (0, 4),
}

_MAX_ANGLE = np.radians(89.5)  # from the optical axis
_SAMPLES, _DIRECTIONS = 4096, 64  # at which the Jacobian is checked
_MAX_PARAMETER, _MIN_DETERMINANT = 1e9, 1e-6  # of a valid calibration: pixels, pixels squared
_MAX_ITERATIONS = 50  # of Newton's method; a handful is enough away from the fold
_TOLERANCE = 1e-10  # error at which it stops, in units of the focal length
_MAX_ERROR = 1e-6  # error of an accepted solution


def calibration_error(camera: Camera) -> str:
    """Why a camera cannot project points; "" where it can."""
    if camera.K is None:
        return "a camera without calibration"
    K = camera.K
    if (
        not (np.abs(K) <= _MAX_PARAMETER).all()
        or not abs(np.linalg.det(K[:2, :2])) >= _MIN_DETERMINANT
    ):
        return "a camera with an invalid calibration"
    if camera.model not in PARAMETER_COUNTS:
        return f"a lens of an unknown model ({camera.model})"
    if len(camera.distortion) not in PARAMETER_COUNTS[camera.model]:
        return f"a lens with {len(camera.distortion)} parameters ({camera.model or 'none'})"
    if not (np.abs(camera.distortion) <= _MAX_PARAMETER).all():
        return "a lens with parameters that are not finite, or far too large"
    return ""


def project(camera: Camera, points: Float) -> tuple[Float, Mask]:
    """Project points into the image.

    Args:
        camera: its `calibration_error` is "".
        points: (n, 3) metres in the camera frame: x right, y down, z ahead.

    Returns:
        (n, 2) column and row, beyond the image bounds too, NaN where invalid; (n,) mask of valid
        points: ahead of the camera and within the injective part of the lens model.
    """
    lens = _lens(camera)
    z = points[:, 2]
    ahead = z > 0.0
    safe = np.where(ahead, z, np.inf)
    x = points[:, :2] / safe[:, None]
    ok: Mask = ahead & (_square(x) < float(np.tan(_limit(lens))) ** 2)
    distorted = _distort(lens, np.where(ok[:, None], x, 0.0))
    assert camera.K is not None
    uv = distorted @ camera.K[:2, :2].T + camera.K[:2, 2]
    uv[~ok] = np.nan
    return uv, ok


def unproject(camera: Camera, uv: Float) -> Float:
    """(n, 3) viewing directions with z = 1 of pixels (n, 2); NaN outside the lens model.

    Args:
        camera: its `calibration_error` is "".
        uv: columns and rows.
    """
    lens = _lens(camera)
    assert camera.K is not None
    distorted = (uv - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    x = _undistort(lens, distorted)
    return np.asarray(np.column_stack([x, np.where(np.isnan(x[:, 0]), np.nan, 1.0)]))


def is_in_image(camera: Camera, uv: Float) -> Mask:
    """(n,) mask of pixels (n, 2) within the image, up to the edges of the outermost pixels."""
    size = np.array([camera.width, camera.height])
    return np.asarray(((uv >= -0.5) & (uv < size - 0.5)).all(axis=1))


def _lens(camera: Camera) -> Lens:
    """Model and parameters, padded with zeros."""
    error = calibration_error(camera)
    if error:
        raise ValueError(f"{camera.name}: {error}")
    k = tuple(float(value) for value in camera.distortion)
    if camera.model == "equidistant":  # no pinhole camera even without parameters
        return camera.model, k + (0.0,) * (4 - len(k))
    return ("brown", k + (0.0,) * (8 - len(k))) if any(k) else ("", ())


def _distort(lens: Lens, x: Float) -> Float:
    """(n, 2) distorted from undistorted normalized coordinates (n, 2)."""
    model, k = lens
    if model == "":
        return x
    if model == "equidistant":
        r = np.sqrt(_square(x))
        angle = np.arctan(r)
        scale = np.divide(_distort_angle(k, angle)[0], r, out=np.ones_like(r), where=r > 0.0)
        return scale[:, None] * x
    s, q = _square(x), np.array([k[3], k[2]])
    return np.asarray((_radial(k, s)[0] + 2.0 * (x @ q))[:, None] * x + s[:, None] * q)


def _undistort(lens: Lens, target: Float) -> Float:
    """(n, 2) undistorted from distorted normalized coordinates (n, 2); NaN: no solution.

    Newton's method with step halving while the error grows or the step leaves the injective disc.
    """
    if lens[0] == "":
        return target.copy()
    radius = np.tan(_limit(lens))
    r = np.sqrt(_square(target))
    x: Float = target * np.minimum(1.0, 0.5 * radius / np.maximum(r, 1e-300))[:, None]
    open_ = np.flatnonzero(np.isfinite(target).all(axis=1))
    error = np.full(len(target), np.inf)
    error[open_] = _norm(_distort(lens, x[open_]) - target[open_])
    for _ in range(_MAX_ITERATIONS):
        open_ = open_[error[open_] > _TOLERANCE]
        if not len(open_):
            break
        step = _newton_step(lens, x[open_], target[open_])
        improved = np.zeros(len(open_), np.bool_)
        for half in range(6):
            trial = x[open_] - 0.5**half * np.where(improved[:, None], 0.0, step)
            trial_error = _norm(_distort(lens, trial) - target[open_])
            taken = ~improved & (trial_error < error[open_]) & (_square(trial) < radius**2)
            x[open_[taken]], error[open_[taken]] = trial[taken], trial_error[taken]
            improved |= taken
        open_ = open_[improved]
    x[~(error < _MAX_ERROR)] = np.nan
    return x


def _newton_step(lens: Lens, x: Float, target: Float) -> Float:
    """(n, 2) Newton steps, with the Jacobian in radial and tangential coordinates."""
    r = np.sqrt(_square(x))
    u = np.divide(x, r[:, None], out=np.zeros_like(x), where=r[:, None] > 0.0)
    u[r == 0.0] = (1.0, 0.0)
    v = _rotate_90_degrees(u)
    along, across, mixed = _jacobian(lens, r, u)
    residual = _distort(lens, x) - target
    a, b = np.sum(residual * u, axis=1), np.sum(residual * v, axis=1)
    det = along * across - mixed * mixed
    radial, tangential = (across * a - mixed * b) / det, (along * b - mixed * a) / det
    return np.asarray(radial[:, None] * u + tangential[:, None] * v)


def _jacobian(lens: Lens, r: Float, u: Float) -> tuple[Float, Float, Float]:
    """Radial, tangential and mixed entries of the Jacobian at radii r, in directions u (n, 2)."""
    model, k = lens
    if model == "equidistant":
        shown, slope = _distort_angle(k, np.arctan(r))
        across = np.divide(shown, r, out=np.ones_like(r), where=r > 0.0)
        return slope / (1.0 + r * r), across, np.zeros_like(r)
    q = np.array([k[3], k[2]])
    q_along, q_across = u @ q, _rotate_90_degrees(u) @ q
    g, slope = _radial(k, r * r)
    along = g + 2.0 * r * r * slope + 6.0 * r * q_along
    return along, g + 2.0 * r * q_along, 2.0 * r * q_across


def _rotate_90_degrees(u: Float) -> Float:
    return np.column_stack([-u[:, 1], u[:, 0]])


def _radial(k: tuple[float, ...], s: Float) -> tuple[Float, Float]:
    """g(s) and its derivative."""
    k1, k2, _, _, k3, k4, k5, k6 = k
    over, under = 1.0 + s * (k1 + s * (k2 + s * k3)), 1.0 + s * (k4 + s * (k5 + s * k6))
    d_over, d_under = k1 + s * (2.0 * k2 + 3.0 * s * k3), k4 + s * (2.0 * k5 + 3.0 * s * k6)
    # beyond a pole the model is invalid
    under = np.where(under > 0.0, under, np.nan)
    return over / under, (d_over - over / under * d_under) / under


def _distort_angle(k: tuple[float, ...], angle: Float) -> tuple[Float, Float]:
    """Distorted angles of a fisheye lens, and their derivative."""
    k1, k2, k3, k4 = k
    s = angle * angle
    shown = angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    return shown, 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))


@lru_cache(maxsize=64)
def _limit(lens: Lens) -> float:
    """Angle from the axis up to which the model is injective: its Jacobian is positive definite."""
    if lens[0] == "":
        return float(_MAX_ANGLE)
    angle = np.linspace(0.0, _MAX_ANGLE, _SAMPLES)
    around = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    u = np.column_stack([np.cos(around), np.sin(around)])
    along, across, mixed = _jacobian(lens, np.tan(angle)[:, None], u)
    # NaN beyond a pole counts as a fold
    is_injective = ((along > 0.0) & (across > 0.0) & (along * across > mixed * mixed)).all(axis=1)
    folds = np.flatnonzero(~is_injective)
    return float(angle[max(folds[0] - 1, 0)] if len(folds) else _MAX_ANGLE)


def _square(x: Float) -> Float:
    return np.asarray(x[:, 0] * x[:, 0] + x[:, 1] * x[:, 1])


def _norm(x: Float) -> Float:
    return np.asarray(np.sqrt(_square(x)))
