"""Geometry of 3D worlds: upright faces, solids, ground, and the parts of vehicles and people."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core.array_types import Bool, Float, Index, Int32, Int64
from stillmap.sim.options import HeightOptions

BOX, CYLINDER, ELLIPSOID = 0, 1, 2


class Faces(NamedTuple):
    """F upright faces.

    Attributes:
        ends: (F, 4) x0, y0, x1, y1 in metres.
        z: (F, 2) lower and upper edges in metres above the street, parallel to it.
        is_glass: (F,) bool.
    """

    ends: Float
    z: Float
    is_glass: Bool

    def distance(self, x: float, y: float) -> Float:
        """(F,) metres from a point to each face, in the plane."""
        x0, y0, x1, y1 = self.ends.T
        ux, uy = x1 - x0, y1 - y0
        share = ((x - x0) * ux + (y - y0) * uy) / np.maximum(ux * ux + uy * uy, 1e-12)
        share = np.clip(share, 0.0, 1.0)
        return np.asarray(np.hypot(x0 + share * ux - x, y0 + share * uy - y))


class Solids(NamedTuple):
    """P upright boxes, elliptic cylinders and ellipsoids, at n times or at all times (n = 1).

    Attributes:
        pose: (n, P, 4) x, y of the center in metres, heading in rad, height of the foot in metres.
        form: (P,) BOX, CYLINDER or ELLIPSOID.
        half: (P, 2) half extents along and across the heading, metres.
        z: (P, 2) lower and upper end above the foot, metres.
        mover: (P,) int32 mover of each; -1: static.
    """

    pose: Float
    form: NDArray[np.int8]
    half: Float
    z: Float
    mover: Int32

    @property
    def radius(self) -> Float:
        """(P,) metres from the center to the farthest point, in the plane."""
        a, b = self.half.T
        return np.asarray(np.where(self.form == BOX, np.hypot(a, b), np.maximum(a, b)))

    def select(self, kept: Bool | Index) -> "Solids":
        """A subset of the solids."""
        return Solids._make([self.pose[:, kept], *(values[kept] for values in self[1:])])

    def concatenate(self, others: "Solids") -> "Solids":
        """These solids followed by others at the same times."""
        pose = np.concatenate([self.pose, others.pose], axis=1)
        rest: Any = zip(self[1:], others[1:], strict=True)
        return Solids._make([pose, *map(np.concatenate, rest)])


class Part(NamedTuple):
    """A solid as a part of an object, at an offset ahead and to the left, in metres.

    `half` and `z` as in Solids; `turn` in rad against the heading of the whole.
    """

    form: int
    ahead: float
    aside: float
    half: tuple[float, float]
    z: tuple[float, float]
    turn: float = 0.0


class Assembly(NamedTuple):
    """Parts attached to K carriers.

    Attributes:
        carrier: (P,) carrier of each part.
        offset: (P, 3) metres ahead and to the left of the carrier's center, rad to the left.
        solids: the parts, at no time.
    """

    carrier: Int64
    offset: Float
    solids: Solids

    def at(self, poses: Float, foot: Float) -> Solids:
        """The solids of all parts.

        Args:
            poses: (n, K, 3) of the carriers: x, y in metres, heading in rad.
            foot: (n, K) height of the floor below them, metres.
        """
        x, y, heading = np.moveaxis(poses, -1, 0)
        c, s = np.cos(heading)[:, self.carrier], np.sin(heading)[:, self.carrier]
        ahead, aside, turn = self.offset.T
        at = np.empty((*c.shape, 4))
        at[..., 0] = x[:, self.carrier] + c * ahead - s * aside
        at[..., 1] = y[:, self.carrier] + s * ahead + c * aside
        at[..., 2], at[..., 3] = heading[:, self.carrier] + turn, foot[:, self.carrier]
        return self.solids._replace(pose=at)


def assemble(parts: Sequence[tuple[int, int, Part]]) -> Assembly:
    """Assemble parts, given with the numbers of carrier and mover."""
    carriers, movers, items = [*zip(*parts, strict=True)] if parts else ((), (), ())
    solids = Solids(
        np.empty((0, len(items), 4)),
        np.array([part.form for part in items], np.int8),
        np.array([part.half for part in items], float).reshape(-1, 2),
        np.array([part.z for part in items], float).reshape(-1, 2),
        np.array(movers, np.int32),
    )
    offset = np.array([(part.ahead, part.aside, part.turn) for part in items], float)
    return Assembly(np.array(carriers, np.int64), offset.reshape(-1, 3), solids)


def make_pose(xyz: ArrayLike, roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Float:
    """(..., 4, 4) poses, rotated by roll about x, then pitch about y, then yaw about z.

    Args:
        xyz: (..., 3) metres.
        roll, pitch, yaw: (...) rad; a positive pitch is nose down.
    """
    angles = np.array([roll, pitch, yaw], float)
    (a, b, c), (u, v, w) = np.cos(angles), np.sin(angles)
    T = np.zeros((*np.shape(yaw), 4, 4))
    T[..., 0, :3] = np.stack([c * b, c * v * u - w * a, c * v * a + w * u], axis=-1)
    T[..., 1, :3] = np.stack([w * b, w * v * u + c * a, w * v * a - c * u], axis=-1)
    T[..., 2, :3] = np.stack([-v, b * u, b * a], axis=-1)
    T[..., :3, 3], T[..., 3, 3] = xyz, 1.0
    return T


class Ground(NamedTuple):
    """z = slope . (x, y), and `kerb` more on the pavements.

    Attributes:
        slope: (2,) metres per metre.
        pavements: (R, 4) rectangles x0, y0, x1, y1.
        kerb: metres.
    """

    slope: Float
    pavements: Float
    kerb: float

    def level(self, x: Float, y: Float) -> Float:
        """(...) metres, height of the street at points (...), also below pavements."""
        return np.asarray(x * self.slope[0] + y * self.slope[1])

    def height(self, x: Float, y: Float) -> Float:
        """(...) metres, height of the floor at points (...)."""
        return np.asarray(self.level(x, y) + self.kerb * self.is_paved(x, y))

    def is_paved(self, x: Float, y: Float) -> Bool:
        """(...) whether points (...) lie on a pavement."""
        inside = np.zeros(np.shape(x), bool)
        for x0, y0, x1, y1 in self.pavements:
            inside |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
        return inside

    def distance(self, origin: Float, direction: Float, above: float = 0.0) -> Float:
        """(...) metres along rays to the surface `above` the street; inf: no intersection.

        Args:
            origin: (3, ...) metres.
            direction: (3, ...) unit vectors.
            above: metres; the surface is hit from both sides.
        """
        (x, y, z), (dx, dy, dz) = origin, direction
        falls = dz - self.slope[0] * dx - self.slope[1] * dy
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -(z - self.level(x, y) - above) / falls
        return np.asarray(np.where(t > 0, t, np.inf))


class StaticSurfaces(NamedTuple):
    """The static surfaces of a world.

    Attributes:
        faces, solids: static ones; the solids at all times.
        ground: the ground.
        ceiling: metres above it; None: open sky.
    """

    faces: Faces
    solids: Solids
    ground: Ground
    ceiling: float | None


class MovingSurfaces(NamedTuple):
    """The parts of the movers at T scans.

    Attributes:
        stamp_ns: (T,) by the clock of the scans.
        solids: the parts, at these times.
    """

    stamp_ns: Int64
    solids: Solids

    def parts(self, mover: int) -> Index:
        """The numbers of a mover's parts."""
        return np.flatnonzero(self.solids.mover == mover)


def to_local(points: Float, pose: Float) -> Float:
    """(n, 3) points in the frame of a solid at poses (4,) or (n, 4): x, y, heading, foot."""
    x, y, heading, foot = np.moveaxis(pose, -1, 0)
    c, s = np.cos(heading), np.sin(heading)
    u, v = points[:, 0] - x, points[:, 1] - y
    return np.stack([c * u + s * v, c * v - s * u, points[:, 2] - foot], axis=1)


VAN = 5.2  # m, minimum length of a van
LEAF = 0.04  # m, thickness of doors

_PANEL_HEIGHT = 2.0  # m
_THIN = 0.2  # m, maximum thickness of a panel
_LEG = 0.1  # m, maximum size of a chair leg
_SEAT = 0.45  # m
_LAMP, _LAMP_RADIUS = 6.0, 0.1  # m, height and maximum radius of lamp posts
_CROWN = 9.0  # ratio of the radii of crown and trunk
_MAX_CROWN = 7.0  # m, radius
_CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
_BRANCHES = 2.3  # m, lower end of crowns


def make_vehicle(length: float, width: float, kind: str) -> list[Part]:
    """Parts of a car, van or forklift."""
    if kind == "forklift":
        return _forklift(length, width)
    half = width / 2
    wheel = (0.3, 0.1), (0.0, 0.6)
    wheels = [Part(BOX, i * 0.31 * length, j * (half - 0.12), *wheel) for i, j in _CORNERS]
    if length > VAN:
        body = Part(BOX, 0.0, 0.0, (length / 2, half), (0.3, 1.1))
        return [body, Part(BOX, -0.09 * length, 0.0, (0.41 * length, half), (1.1, 2.1)), *wheels]
    body = Part(BOX, 0.0, 0.0, (length / 2, half), (0.22, 0.88))
    cabin = Part(BOX, -0.06 * length, 0.0, (0.29 * length, 0.88 * half), (0.88, 1.48))
    return [body, cabin, *wheels]


def _forklift(length: float, width: float) -> list[Part]:
    half, rear = width / 2, -0.17 * length
    mast = Part(BOX, 0.19 * length, 0.0, (0.04 * length, 0.7 * half), (0.05, 2.2))
    forks = [Part(BOX, 0.36 * length, j * 0.3, (0.14 * length, 0.06), (0.04, 0.1)) for j in (-1, 1)]
    roof = Part(BOX, rear, 0.0, (0.2 * length, 0.85 * half), (2.05, 2.12))
    at = [(rear + i * 0.18 * length, j * 0.75 * half) for i, j in _CORNERS]
    posts = [Part(CYLINDER, *xy, (0.03, 0.03), (1.1, 2.05)) for xy in at]
    body = Part(BOX, rear, 0.0, (0.33 * length, half), (0.1, 1.1))
    return [body, mast, roof, *forks, *posts]


def make_leg(half: tuple[float, float], tall: float) -> list[Part]:
    """A leg of a person `tall` metres tall."""
    return [Part(CYLINDER, 0.0, 0.0, half, (0.0, 0.48 * tall))]


def make_torso_and_head(half: tuple[float, float], tall: float) -> list[Part]:
    """Torso and head of a person."""
    torso = Part(CYLINDER, 0.0, 0.0, half, (0.46 * tall, 0.83 * tall))
    return [torso, Part(ELLIPSOID, 0.02, 0.0, (0.1, 0.08), (0.84 * tall, tall))]


def make_door(width: float, height: float) -> list[Part]:
    """A door leaf."""
    return [Part(BOX, 0.0, 0.0, (width / 2, LEAF / 2), (0.01, height))]


def make_box(length: float, width: float, heights: HeightOptions) -> list[Part]:
    """Parts of a rectangle of the plan: a parked car under the open sky, else furniture."""
    if heights.ceiling is None and 3.8 <= length <= 6.0 and 1.5 <= width <= 2.3:
        return make_vehicle(length, width, "car")
    if max(length, width) < _LEG:
        top = _SEAT
    else:
        top = _PANEL_HEIGHT if min(length, width) < _THIN else heights.furniture
    return [Part(BOX, 0.0, 0.0, (length / 2, width / 2), (0.0, min(top, heights.top)))]


def make_round_object(radius: float, heights: HeightOptions) -> list[Part]:
    """Parts of a circle of the plan: a column; under the open sky a lamp post or a tree."""
    around = (radius, radius)
    if heights.ceiling is not None:
        return [Part(CYLINDER, 0.0, 0.0, around, (0.0, heights.ceiling))]
    if radius < _LAMP_RADIUS:
        lamp = Part(BOX, 0.0, 0.0, (0.35, 0.12), (_LAMP, _LAMP + 0.15))
        return [Part(CYLINDER, 0.0, 0.0, around, (0.0, _LAMP)), lamp]
    crown = min(_CROWN * radius, _MAX_CROWN)
    tall = _BRANCHES + math.sqrt(crown) * 2.0
    trunk = Part(CYLINDER, 0.0, 0.0, around, (0.0, _BRANCHES + 0.5))
    return [trunk, Part(ELLIPSOID, 0.0, 0.0, (crown, crown), (_BRANCHES, tall))]
