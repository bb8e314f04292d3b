"""Cameras: where they sit, where each pixel looks, and when pictures are taken."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.recording.images import Camera
from stillmap.simulation import lidar
from stillmap.simulation.camera_options import CameraOptions
from stillmap.simulation.happening import Happening

Float = NDArray[np.float64]

_LATER = 0.31  # of the time between two scans: no picture is taken at a scan's stamp
_STEPS = 50  # that undo a lens
_EXACT = 1e-10  # of the focal length

# x right, y down, z ahead in the camera, of x ahead, y left, z up
_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Shots(NamedTuple):
    """N pictures, in the order of their stamps.

    Attributes:
        stamp_ns: (N,) int64, by the clock of the scans.
        camera: (N,) int32.
        scan: (N,) the last scan before.
        seconds: (N,) after it.
    """

    stamp_ns: NDArray[np.int64]
    camera: NDArray[np.int32]
    scan: NDArray[np.int64]
    seconds: Float

    @classmethod
    def of(cls, happening: Happening, o: CameraOptions) -> "Shots":
        """Pictures at an even rate while the robot scans."""
        motion, T = happening.motion, len(happening.motion.robot)
        step = 1.0 / (o.rate * motion.period)  # in scans
        at = np.arange(_LATER, max(T - 1, _LATER), step)
        scan = at.astype(np.int64)
        seconds = (at - scan) * motion.period
        # rounded as the recorder rounds them, stamps of scans could lie on either side
        since = np.round(seconds * 1e9).astype(np.int64)
        if happening.scene.robot.stamps_missing:
            since = np.round((at - scan) * 1e9).astype(np.int64)
        stamp_ns = happening.exact_ns[scan] + since
        which = np.tile(np.arange(o.count, dtype=np.int32), len(at))
        scan, seconds = np.repeat(scan, o.count), np.repeat(seconds, o.count)
        return cls(np.repeat(stamp_ns, o.count), which, scan, seconds)


def cameras(o: CameraOptions) -> tuple[Camera, ...]:
    """The cameras; the centre of the first pixel is at (0, 0)."""
    f = 0.5 * o.width / math.tan(0.5 * o.fov)
    K = np.array([[f, 0.0, 0.5 * (o.width - 1)], [0.0, f, 0.5 * (o.height - 1)], [0.0, 0.0, 1.0]])
    model = "plumb_bob" if o.distortion else ""
    out = []
    for k in range(o.count):
        turn = 2 * math.pi * k / o.count
        sits = np.array([o.x, o.y, o.z])
        T = lidar.matrix(np.zeros(3), *np.array([0.0, 0.0, turn])) @ lidar.matrix(
            sits, *np.array([0.0, o.pitch, o.yaw])
        )
        T[:3, :3] = T[:3, :3] @ _AHEAD
        name = f"simulated camera {k}" if o.count > 1 else "simulated camera"
        distortion = np.array(o.distortion, np.float64)
        out.append(Camera(name, o.width, o.height, K, model, distortion, T))
    return tuple(out)


def looking(camera: Camera, right: float = 0.0, down: float = 0.0) -> Float:
    """(3, height, width) of length one: where each pixel looks, in the camera's frame.

    Args:
        camera: ideal, or of the model `plumb_bob`.
        right, down: pixels beside their centres.
    """
    assert camera.K is not None
    u, v = np.arange(camera.width) + right, np.arange(camera.height) + down
    bent = np.stack(
        np.broadcast_arrays(
            (u[None] - camera.K[0, 2]) / camera.K[0, 0],
            (v[:, None] - camera.K[1, 2]) / camera.K[1, 1],
        )
    )
    xy = straightened(bent, camera.distortion) if len(camera.distortion) else bent
    rays = np.concatenate([xy, np.ones((1, *xy.shape[1:]))])
    return np.asarray(rays / np.linalg.norm(rays, axis=0))


def bent(xy: Float, distortion: Float) -> Float:
    """(2, ...) where a lens k1, k2, p1, p2, k3 shows what an ideal one shows at (2, ...).

    Both in units of the focal length: Brown, "Decentering distortion of lenses", 1966, as OpenCV
    writes it. Not the code that maps with pictures (`texture/lens.py`): each checks the other.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = xy
    rr = x * x + y * y
    radial = 1.0 + rr * (k1 + rr * (k2 + rr * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x),
            y * radial + p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    )


def straightened(shown: Float, distortion: Float) -> Float:
    """The inverse of `bent`, by Newton's method.

    Raises:
        InputError: the lens shows nothing there, or several things.
    """
    k1, k2, p1, p2, k3 = distortion
    xy = shown.copy()
    for _ in range(_STEPS):
        x, y = xy
        rr = x * x + y * y
        radial, slope = 1.0 + rr * (k1 + rr * (k2 + rr * k3)), k1 + rr * (2 * k2 + rr * 3 * k3)
        xx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        across = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        left, size = shown - bent(xy, distortion), xx * yy - across * across
        if np.abs(left).max() < _EXACT:
            break
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            xy = (
                xy
                + np.stack([yy * left[0] - across * left[1], xx * left[1] - across * left[0]])
                / size
            )
    if not (np.abs(left).max() < _EXACT and (size > 0).all() and (xx > 0).all()):
        hint = "a smaller camera.fov, or a larger camera.k2"
        raise InputError("the camera's lens does not reach the corners of its pictures", hint=hint)
    return xy
