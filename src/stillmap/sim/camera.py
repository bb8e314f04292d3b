"""Cameras: poses, pixel rays, image times; images are rendered on access, reproducibly."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.camera import Camera, Images, unproject
from stillmap.core.errors import InputError
from stillmap.sim import appearance
from stillmap.sim.appearance import Color, SurfacePoints
from stillmap.sim.geometry import Float, Solids, make_pose, to_local
from stillmap.sim.options import CameraOptions
from stillmap.sim.ray_casting import Rays, cast_rays
from stillmap.sim.truth import ImageTruth
from stillmap.sim.world_3d import World

SKY = 65535  # in masks

_OFFSET = 0.31  # of the scan period, from a scan's stamp to the first image

# x right, y down, z ahead in the camera, from x ahead, y left, z up
_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class TrueImage(NamedTuple):
    """An image and its truth.

    Attributes:
        color: (h, w, 3) uint8.
        mask: (h, w) uint16, 0: static, k + 1: mover k, `SKY`: nothing.
        distance: (h, w) float32 metres along the pixel's ray; inf: nothing.
    """

    color: Color
    mask: NDArray[np.uint16]
    distance: NDArray[np.float32]


def place_cameras(o: CameraOptions) -> tuple[Camera, ...]:
    """The cameras; the center of the first pixel is at (0, 0)."""
    f = 0.5 * o.width / math.tan(0.5 * o.fov)
    K = np.array([[f, 0.0, 0.5 * (o.width - 1)], [0.0, f, 0.5 * (o.height - 1)], [0.0, 0.0, 1.0]])
    model = "plumb_bob" if o.distortion else ""
    out = []
    for k in range(o.count):
        T = make_pose((0, 0, 0), 0, 0, 2 * math.pi * k / o.count)
        T = T @ make_pose((o.x, o.y, o.z), 0, o.pitch, o.yaw)
        T[:3, :3] = T[:3, :3] @ _AHEAD
        name = f"simulated camera {k}" if o.count > 1 else "simulated camera"
        distortion = np.array(o.distortion, np.float64)
        out.append(Camera(name, o.width, o.height, K, model, distortion, T))
    return tuple(out)


def compute_pixel_rays(camera: Camera) -> Float:
    """(3, height, width) unit ray of each pixel, in the camera frame.

    Raises:
        InputError: no ray of the lens meets some pixel.
    """
    assert camera.K is not None
    u, v = np.arange(camera.width), np.arange(camera.height)
    if len(camera.distortion):
        uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        rays = unproject(camera, uv.astype(float)).T.reshape(3, len(v), len(u))
        if np.isnan(rays).any():
            hint = "a smaller camera.fov, or a larger camera.k2"
            what = "the camera's lens does not reach the corners of its images"
            raise InputError(what, hint=hint)
    else:
        x, y = (u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]
        rays = np.stack([*np.meshgrid(x, y), np.ones((len(v), len(u)))])
    return np.asarray(rays / np.linalg.norm(rays, axis=0))


class CameraSimulator:
    """All images of the cameras of a world.

    Attributes:
        images: as in a recording.
        T_world_camera: (N, 4, 4) pose of each.
        colour_seed: of the appearance.
    """

    def __init__(self, world: World) -> None:
        episode, o = world.episode, world.episode.scene.camera
        if episode.colour_seed is None:
            raise ValueError("the scene has no camera")
        self._world, self._options, self.colour_seed = world, o, episode.colour_seed
        cameras, motion = place_cameras(o), episode.motion
        self._rays, self._K = compute_pixel_rays(cameras[0]), cameras[0].K
        at = np.arange(_OFFSET, max(len(motion.robot) - 1, _OFFSET), 1.0 / (o.rate * motion.period))
        scan = at.astype(np.int64)
        seconds = (at - scan) * motion.period
        # from exact stamps: rounded ones could lie on either side
        stamp_ns = episode.exact_ns[scan] + np.round(seconds * 1e9).astype(np.int64)
        self._scan, self._seconds = np.repeat(scan, o.count), np.repeat(seconds, o.count)
        which = np.tile(np.arange(o.count, dtype=np.int32), len(at))
        T_base_camera = np.stack([c.T_base_camera for c in cameras if c.T_base_camera is not None])
        moment = world.moment(self._scan, self._seconds)
        self.T_world_camera = world.T_world_base(moment) @ T_base_camera[which]
        self.images = Images(
            np.repeat(stamp_ns, o.count), which, cameras, lambda image: self.render(image).color
        )

    def __len__(self) -> int:
        return len(self.images)

    def truth(self) -> ImageTruth:
        """The truth about the images and the surfaces that they show."""
        return ImageTruth(
            self.colour_seed,
            *self._world.collect_surfaces(),
            self.T_world_camera,
            lambda image: self.render(image).mask,
            lambda image: self.render(image).distance,
        )

    def render(self, image: int) -> TrueImage:
        """Render an image with its truth."""
        world, T, scan = self._world, self.T_world_camera[image], int(self._scan[image])
        moment = world.moment(np.array([scan]), self._seconds[image : image + 1])
        moving = world.movers.at(moment, scan)
        direction = np.einsum("ij,jhw->hwi", T[:3, :3], self._rays)
        seen = cast_rays(_to_rays(direction, T[:3, 3]), world.static, moving)
        # columns from left to right, rows from the top
        range = np.ascontiguousarray(seen.range[::-1, ::-1].T)
        part = np.ascontiguousarray(seen.part[::-1, ::-1].T)
        moves = (part >= 0) & (moving.mover[part] >= 0)
        sky = np.isinf(range)
        mask = np.where(moves, moving.mover[part] + 1, 0).astype(np.uint16)
        mask[sky] = SKY
        color = self._paint(range, np.where(moves, part, -1), direction, T[:3, 3], moving)
        return TrueImage(self._expose(color, image), mask, range.astype(np.float32))

    def _paint(
        self, range: Float, part: NDArray[np.int32], direction: Float, at: Float, moving: Solids
    ) -> Color:
        """(h, w, 3) colors of the pixels (h, w), given the moving part at each, or -1."""
        assert self._K is not None
        color = np.empty((*range.shape, 3), np.uint8)
        sky = np.isinf(range)
        color[sky] = appearance.compute_sky_color(direction[sky])
        static = ~sky & (part < 0)
        places = at + range[static][:, None] * direction[static]
        blur = range[static] / self._K[0, 0]
        color[static] = appearance.compute_static_color(places, self.colour_seed, blur)
        kinds = self._world.episode.motion.kinds
        for k in np.unique(part[part >= 0]).tolist():
            pixels, mover = part == k, int(moving.mover[k])
            p = to_local(at + range[pixels][:, None] * direction[pixels], moving.pose[0, k])
            form, half, z = int(moving.form[k]), moving.half[k], moving.z[k]
            spot = SurfacePoints(mover, form, half, z, p, self.colour_seed)
            color[pixels] = appearance.compute_mover_color(kinds[mover], spot)
        return color

    def _expose(self, color: Color, image: int) -> Color:
        """Apply the exposure and the noise of this image."""
        rng = np.random.default_rng((self.colour_seed, image))
        o = self._options
        gain = np.exp(o.exposure * rng.standard_normal())
        noise = o.noise * rng.standard_normal(color.shape, dtype=np.float32)
        out: Color = np.clip(np.rint(gain * color + noise), 0, 255).astype(np.uint8)
        return out


def _to_rays(direction: Float, at: Float) -> Rays:
    """The rays (h, w, 3) of pixels, from a point (3,): columns from the right, rows from below."""
    upward = np.moveaxis(direction, -1, 0)[:, ::-1, ::-1].swapaxes(1, 2)
    x, y, z = upward
    azimuth, elevation = np.arctan2(y, x), np.arcsin(z)
    columns, rows = azimuth.shape
    along, up = np.unwrap(azimuth[:, rows // 2]), elevation[columns // 2]
    off = (azimuth - along[:, None] + np.pi) % (2 * np.pi) - np.pi
    origin = np.broadcast_to(at[:, None, None], (3, columns, 1))
    spread, tilt = float(np.abs(off).max()), float(np.abs(elevation - up).max())
    return Rays(origin, upward, along, spread, up, tilt)
