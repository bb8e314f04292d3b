"""Appearance of simulated surfaces: colors as functions of position.

Static surfaces have a solid texture: the color is a function of the position in the world alone,
which gives the true color of any point of a model. Its lattices are rotated, so that no wall is
parallel to them. Movers have patterns in the frames of their parts.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.sim.geometry import BOX, ELLIPSOID, Float, make_pose

Color = NDArray[np.uint8]

# rotation of the lattices
_LATTICE = make_pose((0, 0, 0), 0.5257, 0.4142, 0.7321)[:3, :3]
_TILE, _CHIP, _STRIPE = 0.55, 0.17, 0.09  # m
_FLOOR = 0.07  # m, height of skirtings
_CHIPS, _STRIPES, _DRIFT = 0.10, 0.05, 0.08  # relative contrast

# red, green, blue of 255
_WALLS = np.array([
    (214, 203, 178), (196, 178, 150), (222, 214, 200), (176, 186, 190), (156, 172, 160),
    (206, 184, 160), (188, 160, 140), (170, 180, 204), (220, 196, 170), (150, 160, 178),
    (198, 206, 188), (184, 150, 132), (226, 220, 190), (166, 150, 160), (140, 158, 150),
    (204, 170, 150),
], float)  # fmt: skip
_FLOORS = np.array([
    (120, 112, 104), (104, 100, 98), (134, 122, 106), (98, 104, 110), (140, 130, 120),
    (112, 98, 88), (126, 120, 118), (92, 94, 96),
], float)  # fmt: skip
_CLOTHES = np.array([
    (208, 30, 40), (24, 96, 200), (240, 190, 0), (20, 150, 70), (150, 40, 170), (240, 110, 10),
    (10, 160, 170), (230, 60, 140), (40, 40, 60), (240, 240, 236),
], float)  # fmt: skip
_CARS = np.array([
    (190, 20, 30), (30, 70, 160), (230, 230, 232), (60, 64, 70), (240, 196, 30), (20, 110, 80),
    (150, 160, 170), (120, 50, 110),
], float)  # fmt: skip
_GLASS, _TYRE, _RIM = (40, 56, 70), (28, 28, 30), (170, 172, 176)
_SKIN, _HAIR, _SHOE = (222, 172, 140), (70, 46, 30), (40, 34, 30)
_ZENITH, _HORIZON = np.array((120, 170, 232.0)), np.array((206, 226, 244.0))


class SurfacePoints(NamedTuple):
    """Points on one part of a mover.

    Attributes:
        mover: its number.
        form, half, z: of the part, see Solids.
        local: (n, 3) metres ahead and to the left of the part's center, and above its foot.
        seed: see `compute_static_color`.
    """

    mover: int
    form: int
    half: Float
    z: Float
    local: Float
    seed: int


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
    drift = np.stack(
        [np.sin(0.9 * x + 0.5 * y + k) + np.sin(0.6 * y - 0.7 * x + 2 * k) for k in range(3)], 1
    )
    chip = _hash(np.floor(q / _CHIP), seed + 1)
    light = _CHIPS * ((chip & 255) / 127.5 - 1.0) * _contrast(blur, _CHIP)
    along = np.where(tile & 256, q[:, 0] + q[:, 1], q[:, 1] - q[:, 2])
    light += _STRIPES * np.sin(2 * np.pi / _STRIPE * along) * _contrast(blur, _STRIPE)
    colour = base * (1.0 + light[:, None] + _DRIFT / 2 * drift)
    return _to_uint8(colour)


def compute_sky_color(direction: Float) -> Color:
    """(n, 3) RGB of the sky along unit directions (n, 3)."""
    up = np.clip(direction[:, 2:], 0.0, 1.0)
    return _to_uint8(_HORIZON + (_ZENITH - _HORIZON) * np.sqrt(up))


def compute_mover_color(kind: str, spot: SurfacePoints) -> Color:
    """(n, 3) RGB of points on a "person", "door", "car", "forklift" or "thing"."""
    paint = {"person": _person, "door": _door, "thing": _thing}.get(kind, _vehicle)
    return _to_uint8(paint(spot))


def _person(spot: SurfacePoints) -> Float:
    mover, form, half, z, p, seed = spot
    u, v, w = p.T
    around = np.arctan2(v / half[1], u / half[0])
    if form == ELLIPSOID:
        up = (w - z[0]) / (z[1] - z[0])
        face = (up < 0.75) & (np.abs(around) < 1.3)
        colour = np.where(face[:, None], _SKIN, _HAIR)
        eyes = face & (np.abs(up - 0.55) < 0.07) & (np.abs(np.abs(around) - 0.45) < 0.16)
        return np.where(eyes[:, None], (20.0, 20.0, 30.0), colour)
    one, other = _pick_colors(_CLOTHES, mover, seed)
    if z[0] <= 0.0:
        trousers = 0.55 * other * (1.0 + 0.25 * np.sin(8 * around))[:, None]
        return np.where((w < 0.09)[:, None], _SHOE, trousers)
    pattern = _hash_number(mover, seed + 7) % 3
    bands, spokes = np.floor(w / 0.07), np.floor(around / (np.pi / 5))
    checked = (bands, spokes, bands + spokes)[pattern].astype(np.int64) % 2 == 0
    belt = (w < z[0] + 0.05)[:, None]
    return np.where(belt, _SHOE, np.where(checked[:, None], one, other))


def _vehicle(spot: SurfacePoints) -> Float:
    mover, form, half, z, p, seed = spot
    u, v, w = p.T
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


def _door(spot: SurfacePoints) -> Float:
    u, _, w = spot.local.T
    wood = np.array((150, 92, 48.0)) * (1.0 + 0.12 * np.sin(40 * u + 3 * np.sin(5 * w)))[:, None]
    panel = (np.abs(np.abs(u) - 0.25) < 0.16) & (np.abs(w % 0.9 - 0.45) < 0.3)
    return np.asarray(np.where(panel[:, None], 0.75 * wood, wood))


def _thing(spot: SurfacePoints) -> Float:
    one, other = _pick_colors(_CLOTHES, spot.mover, spot.seed)
    squares = np.floor(spot.local / 0.15 + 0.01).astype(np.int64).sum(axis=1)
    return np.where((squares % 2 == 0)[:, None], one, 0.7 * one + 0.3 * other)


def _pick_colors(palette: Float, mover: int, seed: int) -> tuple[Float, Float]:
    """Two different colors."""
    first = _hash_number(mover, seed) % len(palette)
    step = 1 + _hash_number(mover, seed + 3) % (len(palette) - 1)
    return palette[first], palette[(first + step) % len(palette)]


def _to_uint8(colour: Float) -> Color:
    out: Color = np.clip(np.rint(colour), 0, 255).astype(np.uint8)
    return out


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
