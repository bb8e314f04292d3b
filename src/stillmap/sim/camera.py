"""Cameras, and the colors of simulated surfaces; images are rendered on access, reproducibly."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float, Float32, Int32
from stillmap.core.camera import Camera, Images
from stillmap.sim.dynamics import Moment
from stillmap.sim.geometry import BOX, ELLIPSOID, Solids, make_pose, to_local
from stillmap.sim.options import CameraOptions
from stillmap.sim.ray_casting import Rays, cast_rays
from stillmap.sim.truth import ImageTruth
from stillmap.sim.world_3d import World

Color = NDArray[np.uint8]

# rotation of the lattices
_LATTICE = make_pose((0, 0, 0), 0.5257, 0.4142, 0.7321)[:3, :3]
_TILE, _CHIP, _STRIPE = 0.55, 0.17, 0.09  # m
_FLOOR = 0.07  # m, height of skirtings
_CHIPS, _STRIPES, _DRIFT = 0.10, 0.05, 0.08  # relative contrast


def _palette(colors: str) -> Float:
    """(n, 3) red, green and blue of 255, of colors in hexadecimal digits."""
    return np.array([[*bytes.fromhex(color)] for color in colors.split()], float)


_WALLS = _palette(
    "d6cbb2 c4b296 ded6c8 b0babe 9caca0 ceb8a0 bca08c aab4cc dcc4aa 96a0b2 c6cebc b89684 "
    "e2dcbe a696a0 8c9e96 ccaa96"
)
_FLOORS = _palette("787068 686462 867a6a 62686e 8c8278 706258 7e7876 5c5e60")
_CLOTHES = _palette("d01e28 1860c8 f0be00 149646 9628aa f06e0a 0aa0aa e63c8c 28283c f0f0ec")
_CARS = _palette("be141e 1e46a0 e6e6e8 3c4046 f0c41e 146e50 96a0aa 78326e")
_GLASS, _TYRE, _RIM = (40, 56, 70), (28, 28, 30), (170, 172, 176)
_SKIN, _HAIR, _SHOE = (222, 172, 140), (70, 46, 30), (40, 34, 30)
_ZENITH, _HORIZON = np.array((120, 170, 232.0)), np.array((206, 226, 244.0))


def compute_static_color(points: Float, seed: int, blur: Float | float = 0.0) -> Color:
    """(n, 3) RGB of static surfaces at points (n, 3) in the world.

    Args:
        points: metres, z up.
        seed: of the world's appearance, `colour_seed` in its truth.
        blur: metres, (n,) or one for all: finer patterns are averaged, as within a distant pixel.
    """
    x, y, z = points.T
    q = points @ _LATTICE.T
    blur = np.broadcast_to(blur, x.shape)
    tile = _hash(np.floor(q / _TILE), seed)
    base = np.where((z > _FLOOR)[:, None], _WALLS[tile % 16], _FLOORS[tile % 8])
    waves = [np.sin(0.9 * x + 0.5 * y + k) + np.sin(0.6 * y - 0.7 * x + 2 * k) for k in range(3)]
    chip = _hash(np.floor(q / _CHIP), seed + 1)
    light = _CHIPS * ((chip & 255) / 127.5 - 1.0) * _contrast(blur, _CHIP)
    along = np.where(tile & 256, q[:, 0] + q[:, 1], q[:, 1] - q[:, 2])
    light += _STRIPES * np.sin(2 * np.pi / _STRIPE * along) * _contrast(blur, _STRIPE)
    colour = base * (1.0 + light[:, None] + _DRIFT / 2 * np.stack(waves, 1))
    return _to_uint8(colour)


def compute_sky_color(direction: Float) -> Color:
    """(n, 3) RGB of the sky along unit directions (n, 3)."""
    up = np.clip(direction[:, 2:], 0.0, 1.0)
    return _to_uint8(_HORIZON + (_ZENITH - _HORIZON) * np.sqrt(up))


# colors of a part of a mover at points (n, 3), metres ahead and to the left of the part's center,
# and above its foot; `seed` as for `compute_static_color`


def _person(part: Solids, points: Float, seed: int) -> Float:
    _, (form,), (half,), (z,), (mover,) = part
    u, v, w = points.T
    around = np.arctan2(v / half[1], u / half[0])
    if form == ELLIPSOID:
        up = (w - z[0]) / (z[1] - z[0])
        face = (up < 0.75) & (np.abs(around) < 1.3)
        colour = np.where(face[:, None], _SKIN, _HAIR)
        eyes = face & (np.abs(up - 0.55) < 0.07) & (np.abs(np.abs(around) - 0.45) < 0.16)
        return np.where(eyes[:, None], (20.0, 20.0, 30.0), colour)
    shirt, trousers = _pick_colors(_CLOTHES, mover, seed)
    if z[0] <= 0.0:
        folds = (1.0 + 0.25 * np.sin(8 * around))[:, None]
        return np.where((w < 0.09)[:, None], _SHOE, 0.55 * trousers * folds)
    pattern = _hash_number(mover, seed + 7) % 3
    bands, spokes = np.floor(w / 0.07), np.floor(around / (np.pi / 5))
    checked = (bands, spokes, bands + spokes)[pattern].astype(np.int64) % 2 == 0
    belt = (w < z[0] + 0.05)[:, None]
    return np.where(belt, _SHOE, np.where(checked[:, None], shirt, trousers))


def _vehicle(part: Solids, points: Float, seed: int) -> Float:
    _, (form,), (half,), (z,), (mover,) = part
    u, v, w = points.T
    paint = _pick_colors(_CARS, mover, seed)[0]
    if form == BOX and half[0] <= 0.31 and z[0] <= 0.0:  # a wheel
        r = np.hypot(u, w - z[1] / 2)
        return np.where(((r < 0.16) & (np.abs(v) > half[1] - 1e-3))[:, None], _RIM, _TYRE)
    up = (w - z[0]) / (z[1] - z[0])
    end, side = np.abs(u) > half[0] - 1e-3, np.abs(v) > half[1] - 1e-3
    if z[0] > 0.5:  # the cabin
        pillar = side & (np.abs(np.abs(u) - 0.1 * half[0]) < 0.05)
        window = (end | side) & (up > 0.15) & (up < 0.85) & ~pillar
        return np.where(window[:, None], _GLASS, paint)
    colour = np.where((np.abs(up - 0.5) < 0.08)[:, None], 0.6 * paint, paint)
    gap = side & (np.abs(np.abs(u) - 0.3 * half[0]) < 0.02)
    colour = np.where(gap[:, None], 0.4 * paint, colour)
    lamp = end & (np.abs(v) > 0.6 * half[1]) & (up > 0.45) & (up < 0.75)
    colour = np.where((lamp & (u > 0))[:, None], (250.0, 246.0, 210.0), colour)
    return np.where((lamp & (u < 0))[:, None], (200.0, 16.0, 20.0), colour)


def _door(_part: Solids, points: Float, _seed: int) -> Float:
    u, _, w = points.T
    wood = np.array((150, 92, 48.0)) * (1.0 + 0.12 * np.sin(40 * u + 3 * np.sin(5 * w)))[:, None]
    panel = (np.abs(np.abs(u) - 0.25) < 0.16) & (np.abs(w % 0.9 - 0.45) < 0.3)
    return np.asarray(np.where(panel[:, None], 0.75 * wood, wood))


def _thing(part: Solids, points: Float, seed: int) -> Float:
    light, dark = _pick_colors(_CLOTHES, part.mover[0], seed)
    squares = np.floor(points / 0.15 + 0.01).astype(np.int64).sum(axis=1)
    return np.where((squares % 2 == 0)[:, None], light, 0.7 * light + 0.3 * dark)


_PAINTS = {"person": _person, "door": _door, "thing": _thing}  # others are vehicles


def _pick_colors(palette: Float, mover: int, seed: int) -> tuple[Float, Float]:
    """Two different colors."""
    first = _hash_number(mover, seed) % len(palette)
    step = 1 + _hash_number(mover, seed + 3) % (len(palette) - 1)
    return palette[first], palette[(first + step) % len(palette)]


def _to_uint8(colour: Float) -> Color:
    return np.clip(np.rint(colour), 0, 255).astype(np.uint8)


def _contrast(blur: Float, size: float) -> Float:
    """Remaining contrast of a pattern of that size."""
    return np.asarray(np.exp(-((blur / (0.35 * size)) ** 2)))


def _hash_number(value: int, seed: int) -> int:
    return int(_hash(np.array([[value, 0, 0]], float), seed)[0])


def _hash(cell: Float, seed: int) -> NDArray[np.uint32]:
    """(n,) a number for each cell (n, 3) of a lattice (murmur3's last steps)."""
    i = cell.astype(np.int64).astype(np.uint32)
    h = i[:, 0] * np.uint32(0x8DA6B343) ^ i[:, 1] * np.uint32(0xD8163841)
    h ^= i[:, 2] * np.uint32(0xCB1AB31F) ^ np.uint32(seed * 0x9E3779B1 & 0xFFFFFFFF)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        h = (h ^ (h >> np.uint32(shift))) * np.uint32(factor)
    return np.asarray(h ^ (h >> np.uint32(16)))


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
    distance: Float32


def place_cameras(o: CameraOptions) -> tuple[Camera, ...]:
    """The cameras; the center of the first pixel is at (0, 0)."""
    f = 0.5 * o.width / math.tan(0.5 * o.fov)
    K = np.array([[f, 0.0, 0.5 * (o.width - 1)], [0.0, f, 0.5 * (o.height - 1)], [0.0, 0.0, 1.0]])
    out = []
    for k in range(o.count):
        T = make_pose((0, 0, 0), 0, 0, 2 * math.pi * k / o.count)
        T = T @ make_pose((o.x, o.y, o.z), 0, o.pitch, o.yaw)
        T[:3, :3] = T[:3, :3] @ _AHEAD
        name = f"simulated camera {k}" if o.count > 1 else "simulated camera"
        out.append(Camera(name, o.width, o.height, K, "", np.empty(0), T))
    return tuple(out)


def compute_pixel_rays(camera: Camera) -> Float:
    """(3, height, width) unit ray of each pixel, in the camera frame."""
    assert camera.K is not None
    u, v = np.arange(camera.width), np.arange(camera.height)
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
        moment = Moment(motion, self._scan, self._seconds)
        self.T_world_camera = world.T_world_base(moment) @ T_base_camera[which]
        stamps = np.repeat(stamp_ns, o.count)
        self.images = Images(stamps, which, cameras, lambda image: self.render(image).color)

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
        motion, seconds = world.episode.motion, self._seconds[image : image + 1]
        moment = Moment(motion, np.array([scan]), seconds)
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
        self, range: Float, part: Int32, direction: Float, at: Float, moving: Solids
    ) -> Color:
        """(h, w, 3) colors of the pixels (h, w), given the moving part at each, or -1."""
        assert self._K is not None
        color = np.empty((*range.shape, 3), np.uint8)
        sky = np.isinf(range)
        color[sky] = compute_sky_color(direction[sky])
        static = ~sky & (part < 0)
        places = at + range[static][:, None] * direction[static]
        blur = range[static] / self._K[0, 0]
        color[static] = compute_static_color(places, self.colour_seed, blur)
        kinds = self._world.episode.motion.kinds
        for k in np.unique(part[part >= 0]).tolist():
            pixels, paint = part == k, _PAINTS.get(kinds[moving.mover[k]], _vehicle)
            p = to_local(at + range[pixels][:, None] * direction[pixels], moving.pose[0, k])
            color[pixels] = _to_uint8(paint(moving.select(np.array([k])), p, self.colour_seed))
        return color

    def _expose(self, color: Color, image: int) -> Color:
        """Apply the exposure and the noise of this image."""
        rng = np.random.default_rng((self.colour_seed, image))
        o = self._options
        gain = np.exp(o.exposure * rng.standard_normal())
        return _to_uint8(gain * color + o.noise * rng.standard_normal(color.shape, np.float32))


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
