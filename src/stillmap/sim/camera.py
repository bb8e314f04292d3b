"""Cameras: poses, pixel rays, image times; images are rendered on access, reproducibly."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.sim import appearance, lidar, renderer
from stillmap.sim.appearance import Color, SurfacePoints
from stillmap.sim.episode import Episode
from stillmap.sim.geometry import Float, Solids
from stillmap.sim.options import CameraOptions
from stillmap.sim.recorder import World, collect_surfaces
from stillmap.sim.renderer import NOTHING, Lens, RenderedImage
from stillmap.sim.truth import ImageTruth
from stillmap.sim.truth_surfaces import to_local

_OFFSET = 0.31  # of the scan period, from a scan's stamp to the first image
_MAX_ITERATIONS = 50  # of Newton's method, to undistort
_TOLERANCE = 1e-10  # of the focal length

# x right, y down, z ahead in the camera, from x ahead, y left, z up
_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class ImageTimes(NamedTuple):
    """Times of N images, in the order of their stamps.

    Attributes:
        stamp_ns: (N,) int64, by the clock of the scans.
        camera: (N,) int32.
        scan: (N,) preceding scan.
        seconds: (N,) after its stamp.
    """

    stamp_ns: NDArray[np.int64]
    camera: NDArray[np.int32]
    scan: NDArray[np.int64]
    seconds: Float

    @classmethod
    def of(cls, happening: Episode, o: CameraOptions) -> "ImageTimes":
        """Images at a constant rate during the recording."""
        motion, T = happening.motion, len(happening.motion.robot)
        step = 1.0 / (o.rate * motion.period)  # in scans
        at = np.arange(_OFFSET, max(T - 1, _OFFSET), step)
        scan = at.astype(np.int64)
        seconds = (at - scan) * motion.period
        # from exact stamps: rounded ones could lie on either side
        since = np.round(seconds * 1e9).astype(np.int64)
        stamp_ns = happening.exact_ns[scan] + since
        which = np.tile(np.arange(o.count, dtype=np.int32), len(at))
        scan, seconds = np.repeat(scan, o.count), np.repeat(seconds, o.count)
        return cls(np.repeat(stamp_ns, o.count), which, scan, seconds)


def place_cameras(o: CameraOptions) -> tuple[Camera, ...]:
    """The cameras; the center of the first pixel is at (0, 0)."""
    f = 0.5 * o.width / math.tan(0.5 * o.fov)
    K = np.array([[f, 0.0, 0.5 * (o.width - 1)], [0.0, f, 0.5 * (o.height - 1)], [0.0, 0.0, 1.0]])
    model = "plumb_bob" if o.distortion else ""
    out = []
    for k in range(o.count):
        turn = 2 * math.pi * k / o.count
        sits = (o.x, o.y, o.z)
        T = lidar.make_pose((0, 0, 0), 0, 0, turn) @ lidar.make_pose(sits, 0, o.pitch, o.yaw)
        T[:3, :3] = T[:3, :3] @ _AHEAD
        name = f"simulated camera {k}" if o.count > 1 else "simulated camera"
        distortion = np.array(o.distortion, np.float64)
        out.append(Camera(name, o.width, o.height, K, model, distortion, T))
    return tuple(out)


def compute_pixel_rays(camera: Camera, right: float = 0.0, down: float = 0.0) -> Float:
    """(3, height, width) unit ray of each pixel, in the camera frame.

    Args:
        camera: ideal, or of the model `plumb_bob`.
        right, down: offset from the pixel centers, in pixels.
    """
    assert camera.K is not None
    u, v = np.arange(camera.width) + right, np.arange(camera.height) + down
    x, y = (u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]
    bent = np.stack(np.meshgrid(x, y))
    xy = undistort(bent, camera.distortion) if len(camera.distortion) else bent
    rays = np.concatenate([xy, np.ones((1, *xy.shape[1:]))])
    return np.asarray(rays / np.linalg.norm(rays, axis=0))


def distort(xy: Float, distortion: Float) -> Float:
    """(2, ...) distorted by a lens k1, k2, p1, p2, k3, from ideal image coordinates (2, ...).

    Both in units of the focal length: Brown, "Decentering distortion of lenses", 1966, in OpenCV's
    form. Independent of `core/camera.py`, so that each checks the other.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = xy
    rr = x * x + y * y
    radial = 1.0 + rr * (k1 + rr * (k2 + rr * k3))
    bent_x = x * radial + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x)
    return np.stack([bent_x, y * radial + p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y])


def undistort(shown: Float, distortion: Float) -> Float:
    """The inverse of `bent`, by Newton's method.

    Raises:
        InputError: no ray, or several, meet such a point.
    """
    k1, k2, p1, p2, k3 = distortion
    xy = shown.copy()
    for _ in range(_MAX_ITERATIONS):
        x, y = xy
        rr = x * x + y * y
        radial, slope = 1.0 + rr * (k1 + rr * (k2 + rr * k3)), k1 + rr * (2 * k2 + rr * 3 * k3)
        xx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        across = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        left, size = shown - distort(xy, distortion), xx * yy - across * across
        if np.abs(left).max() < _TOLERANCE:
            break
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = np.stack([yy * left[0] - across * left[1], xx * left[1] - across * left[0]])
            xy = xy + step / size
    if not (np.abs(left).max() < _TOLERANCE and (size > 0).all() and (xx > 0).all()):
        hint = "a smaller camera.fov, or a larger camera.k2"
        raise InputError("the camera's lens does not reach the corners of its images", hint=hint)
    return xy


SKY = 65535  # in masks


class TrueImage(NamedTuple):
    """An image and its truth.

    Attributes:
        colour: (h, w, 3) uint8.
        mask: (h, w) uint16, 0: static, k + 1: mover k, `SKY`: nothing.
        distance: (h, w) float32 metres along the pixel's ray; inf: nothing.
    """

    color: Color
    mask: NDArray[np.uint16]
    distance: NDArray[np.float32]


class CameraSimulator:
    """All images of the cameras of a world.

    Attributes:
        images: as in a recording.
        T_world_camera: (N, 4, 4) pose of each.
        colour_seed: of the appearance.
    """

    def __init__(self, world: World) -> None:
        happening, o = world.happening, world.happening.scene.camera
        if happening.colour_seed is None:
            raise ValueError("the scene has no camera")
        self._world, self._options, self.colour_seed = world, o, happening.colour_seed
        self._shots = ImageTimes.of(happening, o)
        cameras = place_cameras(o)
        # identical cameras
        steps = ((np.arange(o.antialias) + 0.5) / o.antialias - 0.5).tolist()
        self._lenses = [_make_lens(cameras[0], right, down) for down in steps for right in steps]
        T_base_camera = np.stack([c.T_base_camera for c in cameras if c.T_base_camera is not None])
        moment = world.moment(self._shots.scan, self._shots.seconds)
        self.T_world_camera = world.T_world_base(moment) @ T_base_camera[self._shots.camera]
        stamp_ns, camera = self._shots.stamp_ns, self._shots.camera
        self.images = Images(stamp_ns, camera, cameras, lambda image: self.render(image).color)

    def __len__(self) -> int:
        return len(self.images)

    def truth(self) -> ImageTruth:
        """The truth about the images and the surfaces that they show."""
        return ImageTruth(
            self.colour_seed,
            *collect_surfaces(self._world),
            self.T_world_camera,
            lambda image: self.render(image).mask,
            lambda image: self.render(image).distance,
        )

    def render(self, image: int) -> TrueImage:
        """Render an image with its truth.

        With several rays per pixel, the mask shows a mover that any of them hits, and the distance
        is the least one.
        """
        T, scan = self.T_world_camera[image], int(self._shots.scan[image])
        moment = self._world.moment(np.array([scan]), self._shots.seconds[image : image + 1])
        moving = self._world.carried.at(moment, scan)
        parts = [self._render_once(lens, T, moving) for lens in self._lenses]
        mask, distance = parts[0].mask, parts[0].distance
        total = parts[0].color.astype(np.float64)
        for one in parts[1:]:
            theirs = (mask == 0) | ((mask == SKY) & (one.mask != 0))
            mask = np.where(theirs & (one.mask != SKY), one.mask, mask)
            distance = np.minimum(distance, one.distance)
            total += one.color
        return TrueImage(self._expose(total / len(parts), image), mask, distance)

    def _render_once(self, lens: Lens, T_world_camera: Float, moving: Solids) -> TrueImage:
        world, R = self._world, T_world_camera[:3, :3]
        seen = renderer.render(lens, T_world_camera, world.static, moving)
        direction = np.einsum("ij,jhw->hwi", R, lens.direction)
        colour = np.empty((*seen.part.shape, 3), np.uint8)
        sky, static = seen.part == NOTHING, seen.part == renderer.STATIC
        colour[sky] = appearance.compute_sky_color(direction[sky])
        range = seen.range[static]
        places = T_world_camera[:3, 3] + range[:, None] * direction[static]
        blur = range / lens.K[0, 0]
        colour[static] = appearance.compute_static_color(places, self.colour_seed, blur)
        self._paint_movers(colour, seen, T_world_camera[:3, 3], direction, moving)
        mask = np.zeros(seen.part.shape, np.uint16)
        mask[sky] = SKY
        moves = seen.part >= 0
        mask[moves] = moving.mover[seen.part[moves]] + 1
        return TrueImage(colour, mask, seen.range.astype(np.float32))

    def _paint_movers(
        self, colour: Color, seen: RenderedImage, at: Float, direction: Float, moving: Solids
    ) -> None:
        kinds = self._world.happening.motion.kinds
        for k in np.unique(seen.part[seen.part >= 0]).tolist():
            pixels, mover = seen.part == k, int(moving.mover[k])
            p = at + seen.range[pixels][:, None] * direction[pixels]
            part = (int(moving.form[k]), moving.half[k], moving.z[k])
            spot = SurfacePoints(mover, *part, to_local(p, moving.pose[0, k]), self.colour_seed)
            colour[pixels] = appearance.compute_mover_color(kinds[mover], spot)

    def _expose(self, colour: Float, image: int) -> Color:
        """Apply the exposure and the noise of this image."""
        rng = np.random.default_rng((self.colour_seed, image))
        o = self._options
        gain = np.exp(o.exposure * rng.standard_normal())
        noise = o.noise * rng.standard_normal(colour.shape, dtype=np.float32)
        out: Color = np.clip(np.rint(gain * colour + noise), 0, 255).astype(np.uint8)
        return out


def _make_lens(camera: Camera, right: float, down: float) -> Lens:
    direction, K = compute_pixel_rays(camera, right, down), camera.K
    assert K is not None
    x, y = direction[:2] / direction[2]
    off_x = np.abs(K[0, 0] * x + K[0, 2] - np.arange(camera.width)).max()
    off_y = np.abs(K[1, 1] * y + K[1, 2] - np.arange(camera.height)[:, None]).max()
    return Lens(direction, K, float(max(off_x, off_y)))
