"""Pictures that a recording holds beside its scans: where and when they were taken, read one by
one.

Where points fall in a picture, and where pixels look: pinhole cameras and their distortion.

The models are those of OpenCV ("Camera Calibration and 3D Reconstruction", "Fisheye camera model"),
by the names that ROS gives them: `plumb_bob` (k1, k2, p1, p2[, k3]), `rational_polynomial` (k1, k2,
p1, p2, k3, k4, k5, k6), `equidistant` (k1, k2, k3, k4), and "" for none. Centres of pixels have
whole numbers.

With x the way aside per way ahead, s = |x|^2 and q = (p2, p1), the first two are

    F(x) = g(s) x + 2 (q x) x + s q,    g(s) = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + ...)

whose Jacobian is symmetric. On a disc around the centre in which it is positive definite, F is the
gradient of a convex function, and so one-to-one. Farther out, polynomials fold back, and what lies
far beside the picture would land inside: there nothing is seen.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

Mask = NDArray[np.bool_]

Lens = tuple[str, tuple[float, ...]]


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera on the robot.

    Attributes:
        name: of its topic or folder.
        width, height: pixels.
        K: (3, 3) float64, pinhole matrix of the pictures as they are recorded; None: unknown.
        model: of the lens, `plumb_bob`, `rational_polynomial`, `equidistant` or "" for none.
        distortion: (n,) float64, its parameters; empty for none.
        T_base_camera: (4, 4) float64, x right, y down, z ahead in the camera; None: unknown.
    """

    name: str
    width: int
    height: int
    K: NDArray[np.float64] | None
    model: str
    distortion: NDArray[np.float64]
    T_base_camera: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class Images:
    """N pictures in the order of their stamps; none is in memory.

    Attributes:
        stamp_ns: (N,) int64, the clock of the scans, non-decreasing.
        camera: (N,) int32, which of `cameras` took each.
        cameras: the cameras.
        load: reads one picture; see `read`.
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
            raise ValueError(f"images: expected ({N},) cameras and stamps that do not fall")
        if N and (self.camera.min() < 0 or self.camera.max() >= len(self.cameras)):
            raise ValueError("images: a camera that is not there")

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def read(self, image: int) -> NDArray[Any]:
        """(height, width, 3) uint8 red, green, blue, or (height, width) uint8, uint16 or float32.

        Raises:
            InputError: it is damaged or no longer there.
        """
        return self.load(image)


_PARAMETERS = {
    "": (0,),
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (0, 8),
    "equidistant": (0, 4),
}

_WIDEST = np.radians(89.5)  # from the axis; a pinhole camera sees nothing beside itself

_SAMPLES, _DIRECTIONS = 4096, 64  # at which the Jacobian is looked at

_LARGEST, _LEAST = 1e9, 1e-6  # pixels, and their square, of a calibration that means something

_STEPS = 50  # of Newton's method at most; a handful does away from the fold

_CLOSE = 1e-10  # error at which it ends, in units of the focal length

_SOLVED = 1e-6  # error with which a solution counts as one


def calibration_error(camera: Camera) -> str:
    """Why nothing can be said of where points fall in a camera's pictures; "" if it can."""
    if camera.K is None:
        return "a camera without calibration"
    K = camera.K
    if not (np.abs(K) <= _LARGEST).all() or not abs(np.linalg.det(K[:2, :2])) >= _LEAST:
        return "a camera whose calibration is none"
    if camera.model not in _PARAMETERS:
        return f"a lens of a model that is not known ({camera.model})"
    if len(camera.distortion) not in _PARAMETERS[camera.model]:
        return f"a lens with {len(camera.distortion)} parameters ({camera.model or 'none'})"
    if not (np.abs(camera.distortion) <= _LARGEST).all():
        return "a lens whose parameters are not finite, or far too large"
    return ""


def project(camera: Camera, points: Float) -> tuple[Float, Mask]:
    """Pixels in which points are seen.

    Args:
        camera: of which `unusable` says nothing.
        points: (n, 3) metres in the camera's frame: x right, y down, z ahead.

    Returns:
        (n, 2) column and row, beyond the picture's edges too, NaN where there are none; and (n,)
        whether there are any: the point lies ahead, and within what the lens shows one-to-one.
    """
    lens = _lens(camera)
    z = points[:, 2]
    ahead = z > 0.0
    safe = np.where(ahead, z, np.inf)
    x = points[:, :2] / safe[:, None]
    ok: Mask = ahead & (_square(x) < float(np.tan(_limit(*lens))) ** 2)
    distorted = _distorted(lens, np.where(ok[:, None], x, 0.0))
    assert camera.K is not None
    uv = distorted @ camera.K[:2, :2].T + camera.K[:2, 2]
    uv[~ok] = np.nan
    return uv, ok


def unproject(camera: Camera, uv: Float) -> Float:
    """(n, 3) directions into which pixels (n, 2) look, z = 1; NaN where the lens shows nothing.

    Args:
        camera: of which `unusable` says nothing.
        uv: columns and rows.
    """
    lens = _lens(camera)
    assert camera.K is not None
    wanted = (uv - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    x = _undistorted(lens, wanted)
    out: Float = np.column_stack([x, np.where(np.isnan(x[:, 0]), np.nan, 1.0)])
    return out


def is_in_image(camera: Camera, uv: Float) -> Mask:
    """(n,) whether pixels (n, 2) lie in the camera's pictures: up to the edges of the outermost."""
    size = np.array([camera.width, camera.height])
    return np.asarray(((uv >= -0.5) & (uv < size - 0.5)).all(axis=1))


def _lens(camera: Camera) -> Lens:
    """Model and parameters, with the zeros that may be left out."""
    why = calibration_error(camera)
    if why:
        raise ValueError(f"{camera.name}: {why}")
    numbers = tuple(float(number) for number in camera.distortion)
    if camera.model == "equidistant":  # without parameters it is no pinhole camera yet
        return camera.model, numbers + (0.0,) * (4 - len(numbers))
    return ("brown", numbers + (0.0,) * (8 - len(numbers))) if any(numbers) else ("", ())


def _distorted(lens: Lens, x: Float) -> Float:
    """(n, 2) where the lens shows directions (n, 2), both per unit of focal length."""
    model, k = lens
    if model == "":
        return x
    if model == "equidistant":
        r = np.sqrt(_square(x))
        angle = np.arctan(r)
        scale = np.divide(_shown_angle(k, angle)[0], r, out=np.ones_like(r), where=r > 0.0)
        return scale[:, None] * x
    s, q = _square(x), np.array([k[3], k[2]])
    out: Float = (_radial(k, s)[0] + 2.0 * (x @ q))[:, None] * x + s[:, None] * q
    return out


def _undistorted(lens: Lens, wanted: Float) -> Float:
    """(n, 2) the directions that the lens shows at (n, 2); NaN where there is none.

    Newton's method, a step halved as long as it leads away, or out of what is one-to-one.
    """
    if lens[0] == "":
        return wanted.copy()
    widest = np.tan(_limit(*lens))
    r = np.sqrt(_square(wanted))
    x: Float = wanted * np.minimum(1.0, 0.5 * widest / np.maximum(r, 1e-300))[:, None]
    open_ = np.flatnonzero(np.isfinite(wanted).all(axis=1))
    error = np.full(len(wanted), np.inf)
    error[open_] = _norm(_distorted(lens, x[open_]) - wanted[open_])
    for _ in range(_STEPS):
        open_ = open_[error[open_] > _CLOSE]
        if not len(open_):
            break
        step = _newton(lens, x[open_], wanted[open_])
        better = np.zeros(len(open_), np.bool_)
        for half in range(6):
            tried = x[open_] - 0.5**half * np.where(better[:, None], 0.0, step)
            found = _norm(_distorted(lens, tried) - wanted[open_])
            taken = ~better & (found < error[open_]) & (_square(tried) < widest**2)
            x[open_[taken]], error[open_[taken]] = tried[taken], found[taken]
            better |= taken
        open_ = open_[better]
    x[~(error < _SOLVED)] = np.nan
    return x


def _newton(lens: Lens, x: Float, wanted: Float) -> Float:
    """(n, 2) the steps, by the Jacobian along and across the way out from the centre."""
    model, k = lens
    r = np.sqrt(_square(x))
    u = np.divide(x, r[:, None], out=np.zeros_like(x), where=r[:, None] > 0.0)
    u[r == 0.0] = (1.0, 0.0)
    v = np.column_stack([-u[:, 1], u[:, 0]])
    along, across, mixed = _jacobian(model, k, r, *_towards(k, u, v, model))
    residual = _distorted(lens, x) - wanted
    a, b = np.sum(residual * u, axis=1), np.sum(residual * v, axis=1)
    det = along * across - mixed * mixed
    back, aside = (across * a - mixed * b) / det, (along * b - mixed * a) / det
    return np.asarray(back[:, None] * u + aside[:, None] * v)


def _towards(k: tuple[float, ...], u: Float, v: Float, model: str) -> tuple[Float, Float]:
    """(n,) q along directions u and v (n, 2)."""
    q = np.zeros(2) if model == "equidistant" else np.array([k[3], k[2]])
    return np.asarray(u @ q), np.asarray(v @ q)


def _jacobian(
    model: str, k: tuple[float, ...], r: Float, q_along: Float, q_across: Float
) -> tuple[Float, Float, Float]:
    """Its entries along the way out, across it, and that which mixes them, r from the centre."""
    if model == "equidistant":
        angle = np.arctan(r)
        shown, slope = _shown_angle(k, angle)
        across = np.divide(shown, r, out=np.ones_like(r), where=r > 0.0)
        return slope / (1.0 + r * r), across, np.zeros_like(r)
    g, slope = _radial(k, r * r)
    along = g + 2.0 * r * r * slope + 6.0 * r * q_along
    return along, g + 2.0 * r * q_along, 2.0 * r * q_across


def _radial(k: tuple[float, ...], s: Float) -> tuple[Float, Float]:
    """g and its derivative by s."""
    k1, k2, _, _, k3, k4, k5, k6 = k
    over, under = 1.0 + s * (k1 + s * (k2 + s * k3)), 1.0 + s * (k4 + s * (k5 + s * k6))
    d_over, d_under = k1 + s * (2.0 * k2 + 3.0 * s * k3), k4 + s * (2.0 * k5 + 3.0 * s * k6)
    # beyond a pole the sign is wrong, and nothing is looked at there
    under = np.where(under > 0.0, under, np.nan)
    return over / under, (d_over - over / under * d_under) / under


def _shown_angle(k: tuple[float, ...], angle: Float) -> tuple[Float, Float]:
    """What a fisheye lens shows of angles from the axis, and its derivative."""
    k1, k2, k3, k4 = k
    s = angle * angle
    shown = angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    return shown, 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))


@lru_cache(maxsize=64)
def _limit(model: str, k: tuple[float, ...]) -> float:
    """Angle from the axis, up to which the lens is one-to-one: the Jacobian is positive definite
    in every direction."""
    if model == "":
        return float(_WIDEST)
    angle = np.linspace(0.0, _WIDEST, _SAMPLES)
    around = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    u = np.column_stack([np.cos(around), np.sin(around)])
    v = np.column_stack([-u[:, 1], u[:, 0]])
    towards = (q[:, None] for q in _towards(k, u, v, model))
    along, across, mixed = _jacobian(model, k, np.tan(angle)[None], *towards)
    # NaN beyond a pole is no better than a fold
    sound = ((along > 0.0) & (across > 0.0) & (along * across > mixed * mixed)).all(axis=0)
    folds = np.flatnonzero(~sound)
    return float(angle[max(folds[0] - 1, 0)] if len(folds) else _WIDEST)


def _square(x: Float) -> Float:
    out: Float = x[:, 0] * x[:, 0] + x[:, 1] * x[:, 1]
    return out


def _norm(x: Float) -> Float:
    out: Float = np.sqrt(_square(x))
    return out
