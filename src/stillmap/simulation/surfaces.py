"""The true surfaces of what stands still in a simulated world: how far points are from them."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.simulation.ground import Ground
from stillmap.simulation.solids import BOX, CYLINDER, Faces, Solids

Float = NDArray[np.float64]
Nearest = Callable[[Float], Float]
_Thing = tuple[Float, Float, Nearest]

_SQUARE = 4.0  # m, within which points have the same things near
_HALVINGS = 80  # after which the nearest point of an ellipse is known to the last digit


class Standing(NamedTuple):
    """What stands still in a world.

    Attributes:
        faces, solids: what there is; the solids at all times.
        ground: the ground.
        ceiling: metres above it; None: the open sky.
    """

    faces: Faces
    solids: Solids
    ground: Ground
    ceiling: float | None

    def nearest(self, points: Float) -> tuple[Float, Float]:
        """The nearest places of the surfaces.

        Exact for solids, and for faces and ground where the ground is level; where it slopes, up
        to the square of the slope. Surfaces within others count: the floor below a cupboard.

        Args:
            points: (n, 3) metres.

        Returns:
            (n,) distances in metres, and the places (n, 3).
        """
        places = _on_ground(points, self.ground, self.ceiling)
        distance = np.linalg.norm(places - points, axis=1)
        things = list(self._things())
        lowest = np.array([low for low, _, _ in things]).reshape(-1, 2)
        highest = np.array([high for _, high, _ in things]).reshape(-1, 2)
        for part in _in_squares(points):
            some, d, at = points[part], distance[part], places[part]
            low, high = some[:, :2].min(axis=0), some[:, :2].max(axis=0)
            off = np.maximum(np.maximum(lowest - high, low - highest), 0.0)
            for k in np.flatnonzero((off * off).sum(axis=1) < d.max() ** 2).tolist():
                _take_nearer(some, d, at, things[k])
            distance[part], places[part] = d, at
        return distance, places

    def _things(self) -> Iterator[_Thing]:
        """Least and greatest x and y of each thing, and its nearest places."""
        for ends, z in zip(self.faces.ends, self.faces.z, strict=True):
            low, high = np.minimum(ends[:2], ends[2:]), np.maximum(ends[:2], ends[2:])
            yield low, high, partial(_on_face, ends=ends, z=z, ground=self.ground)
        for k, pose in enumerate(self.solids.pose[0]):
            reach = float(np.hypot(*self.solids.half[k]))
            nearest = partial(nearest_on_solid, solids=self.solids, k=k)
            yield pose[:2] - reach, pose[:2] + reach, nearest


def _in_squares(points: Float) -> Iterator[NDArray[np.intp]]:
    """Numbers of the points (n, 3) in each square of the plane that has any."""
    if not len(points):
        return
    cell = np.floor(points[:, :2] / _SQUARE).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    order = np.argsort(key, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(key[order])) + 1)


def _take_nearer(points: Float, distance: Float, places: Float, thing: _Thing) -> None:
    """Replaces places (n, 3) and how far they are from points by those of a thing, if nearer."""
    low, high, nearest = thing
    off = np.maximum(np.maximum(low - points[:, :2], points[:, :2] - high), 0.0)
    near = np.flatnonzero((off * off).sum(axis=1) < distance * distance)
    if not len(near):
        return
    found = nearest(points[near])
    d = np.linalg.norm(found - points[near], axis=1)
    better = d < distance[near]
    distance[near[better]], places[near[better]] = d[better], found[better]


def to_world(local: Float, pose: Float) -> Float:
    """(n, 3) of points in the frame of a solid at poses (4,) or (n, 4): x, y, heading, foot."""
    x, y, heading, foot = np.moveaxis(pose, -1, 0)
    c, s = np.cos(heading), np.sin(heading)
    u, v, w = local.T
    return np.stack([x + c * u - s * v, y + s * u + c * v, foot + w], axis=1)


def to_local(points: Float, pose: Float) -> Float:
    """The inverse of `to_world`."""
    x, y, heading, foot = np.moveaxis(pose, -1, 0)
    c, s = np.cos(heading), np.sin(heading)
    u, v = points[:, 0] - x, points[:, 1] - y
    return np.stack([c * u + s * v, c * v - s * u, points[:, 2] - foot], axis=1)


def nearest_on_solid(points: Float, solids: Solids, k: int) -> Float:
    """(n, 3) the places of the surface of solid k nearest to points (n, 3), each at a time of its
    own, or all at one."""
    (a, b), (z0, z1) = solids.half[k], solids.z[k]
    pose, form = solids.pose[:, k], solids.form[k]
    middle, h = np.array([0.0, 0.0, (z0 + z1) / 2]), (z1 - z0) / 2
    p = to_local(points, pose) - middle
    if form == BOX:
        found = _on_box(p, np.array([a, b, h]))
    elif form == CYLINDER:
        found = _on_cylinder(p, np.array([a, b]), h)
    else:
        found = _on_ellipsoid(p, np.array([a, b, h]))
    return to_world(found + middle, pose)


def _on_ground(points: Float, ground: Ground, ceiling: float | None) -> Float:
    """The nearest places of street, pavements and ceiling."""
    x, y, z = points.T
    level = ground.level(x, y)
    gx, gy = ground.gradient(x, y)
    steep = 1.0 + gx * gx + gy * gy
    above = [ground.kerb * ground.is_paved(x, y)]
    if ceiling is not None:
        above.append(np.full(len(points), ceiling))
    best, places = np.full(len(points), np.inf), points.copy()
    for up in above:
        over = (z - level - up) / steep
        d = np.abs(over) * np.sqrt(steep)
        found = np.stack([x + gx * over, y + gy * over, z - over], axis=1)
        places = np.where((d < best)[:, None], found, places)
        best = np.minimum(best, d)
    return places


def _on_face(points: Float, ends: Float, z: Float, ground: Ground) -> Float:
    start, along = ends[:2], ends[2:] - ends[:2]
    share = (points[:, :2] - start) @ along / max(float(along @ along), 1e-24)
    xy = start + np.clip(share, 0.0, 1.0)[:, None] * along
    level = ground.level(*xy.T)
    return np.column_stack([xy, np.clip(points[:, 2], level + z[0], level + z[1])])


def _on_box(p: Float, half: Float) -> Float:
    out = np.clip(p, -half, half)
    inside = np.flatnonzero((np.abs(p) < half).all(axis=1))
    axis = (half - np.abs(p[inside])).argmin(axis=1)
    out[inside, axis] = np.where(p[inside, axis] < 0, -half[axis], half[axis])
    return out


def _on_cylinder(p: Float, half: Float, h: float) -> Float:
    rim = _on_ellipsoid(p[:, :2], half)
    within = (p[:, :2] ** 2 / half**2).sum(axis=1) <= 1.0
    z = np.clip(p[:, 2], -h, h)
    out = np.column_stack([np.where(within[:, None], p[:, :2], rim), z])
    inside = within & (np.abs(p[:, 2]) < h)
    to_side = np.linalg.norm(rim - p[:, :2], axis=1)
    side = inside & (to_side < h - np.abs(p[:, 2]))
    out[side, :2] = rim[side]
    cap = inside & ~side
    out[cap, 2] = np.where(p[cap, 2] < 0, -h, h)
    return out


def _on_ellipsoid(p: Float, half: Float) -> Float:
    """The nearest places of an ellipse or ellipsoid (D half axes) to points (n, D).

    They are half^2 |p| / (t + half^2) for the greatest root t of sum (half |p| / (t + half^2))^2
    = 1 (Eberly, "Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid", 2013),
    found by halving.
    """
    if not len(p):
        return p.copy()
    q = np.maximum(np.abs(p), 1e-9 * half.min())  # off the axes, where the root is a pole
    squares, least = half * half, half.argmin()
    low = -squares[least] + half[least] * q[:, least]
    high = -squares[least] + np.linalg.norm(half * q, axis=1)
    for _ in range(_HALVINGS):
        t = 0.5 * (low + high)
        beyond = ((half * q / (t[:, None] + squares)) ** 2).sum(axis=1) > 1.0
        low, high = np.where(beyond, t, low), np.where(beyond, high, t)
    found = squares * q / (0.5 * (low + high)[:, None] + squares)
    return np.asarray(np.copysign(found, p))
