"""True surfaces of a simulated world: projection of points to static ones, samples of movers."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.sim.dynamics import MAX_SPEED
from stillmap.sim.geometry import BOX, CYLINDER, Faces, Float, Ground, Solids

_SQUARE = 4.0  # m, points within one share their candidate surfaces
_BISECTIONS = 80  # of the root for the nearest point of an ellipse, to the last digit


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

    def project(self, points: Float) -> tuple[Float, Float]:
        """Project points to the nearest surface.

        Exact for solids, and for faces and ground where the ground is level; where it slopes, up
        to the square of the slope. Hidden surfaces count, as the floor below a cupboard.

        Args:
            points: (n, 3) metres.

        Returns:
            Distances (n,) in metres, and the projected points (n, 3).
        """
        places = _on_ground(points, self.ground, self.ceiling)
        distance = np.linalg.norm(places - points, axis=1)
        a, b, center = self.faces.ends[:, :2], self.faces.ends[:, 2:], self.solids.pose[0, :, :2]
        reach = np.hypot(*self.solids.half.T)[:, None]
        lowest = np.concatenate([np.minimum(a, b), center - reach])
        highest = np.concatenate([np.maximum(a, b), center + reach])
        for part in _in_squares(points):
            some, d, at = points[part], distance[part], places[part]
            off = _gap(some[:, :2].min(axis=0), some[:, :2].max(axis=0), lowest, highest)
            for k in np.flatnonzero(off < d.max() ** 2).tolist():
                near = np.flatnonzero(_gap(some[:, :2], some[:, :2], lowest[k], highest[k]) < d * d)
                if len(near):
                    found = self._project_to(k, some[near])
                    off_found = np.linalg.norm(found - some[near], axis=1)
                    better = off_found < d[near]
                    d[near[better]], at[near[better]] = off_found[better], found[better]
            distance[part], places[part] = d, at
        return distance, places

    def _project_to(self, k: int, points: Float) -> Float:
        """Project points to face k or, counted after the faces, a solid."""
        first = len(self.faces.ends)
        if k >= first:
            return project_to_solid(points, self.solids, k - first)
        return _on_face(points, self.faces.ends[k], self.faces.z[k], self.ground)


def _in_squares(points: Float) -> Iterator[NDArray[np.intp]]:
    """Indices of the points (n, 3) in each non-empty square of the plane."""
    if not len(points):
        return
    cell = np.floor(points[:, :2] / _SQUARE).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    order = np.argsort(key, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(key[order])) + 1)


def _gap(low: Float, high: Float, lowest: Float, highest: Float) -> Float:
    """(n,) squared distance between rectangles low to high and lowest to highest."""
    off = np.maximum(np.maximum(lowest - high, low - highest), 0.0)
    return np.asarray((off * off).sum(axis=1))


def to_world(local: Float, pose: Float) -> Float:
    """(n, 3) points in the frame of a solid at poses (4,) or (n, 4): x, y, heading, foot."""
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


def project_to_solid(points: Float, solids: Solids, k: int) -> Float:
    """(n, 3) projection of points (n, 3) to the surface of solid k, at n times or at one."""
    pose, (middle, half) = solids.pose[:, k], _middle_and_half(solids, k)
    on_form = {BOX: _on_box, CYLINDER: _on_cylinder}.get(solids.form[k], _on_ellipsoid)
    return to_world(on_form(to_local(points, pose) - middle, half) + middle, pose)


def _middle_and_half(solids: Solids, k: int) -> tuple[Float, Float]:
    """(3,) center of solid k in its frame, and (3,) half extents along its axes."""
    z0, z1 = solids.z[k]
    return np.array([0.0, 0.0, (z0 + z1) / 2]), np.array([*solids.half[k], (z1 - z0) / 2])


def _on_ground(points: Float, ground: Ground, ceiling: float | None) -> Float:
    """Projection to street, pavements and ceiling."""
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


def _on_cylinder(p: Float, half: Float) -> Float:
    h, rim = half[2], _on_ellipsoid(p[:, :2], half[:2])
    within = (p[:, :2] ** 2 / half[:2] ** 2).sum(axis=1) <= 1.0
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
    """Projection of points (n, D) to an ellipse or ellipsoid with D half axes.

    They are half^2 |p| / (t + half^2) for the greatest root t of sum (half |p| / (t + half^2))^2
    = 1 (Eberly, "Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid", 2013),
    found by bisection.
    """
    if not len(p):
        return p.copy()
    q = np.maximum(np.abs(p), 1e-9 * half.min())  # off the axes, where the root is a pole
    squares, least = half * half, half.argmin()
    low = -squares[least] + half[least] * q[:, least]
    high = -squares[least] + np.linalg.norm(half * q, axis=1)
    for _ in range(_BISECTIONS):
        t = 0.5 * (low + high)
        beyond = ((half * q / (t[:, None] + squares)) ** 2).sum(axis=1) > 1.0
        low, high = np.where(beyond, t, low), np.where(beyond, high, t)
    found = squares * q / (0.5 * (low + high)[:, None] + squares)
    return np.asarray(np.copysign(found, p))


_MIN_DEPTH = 1e-6  # m, of a point inside another part


class MovingSurfaces(NamedTuple):
    """The parts of the movers at T scans.

    Attributes:
        stamp_ns: (T,) by the clock of the scans.
        solids: the parts, at these times.
    """

    stamp_ns: NDArray[np.int64]
    solids: Solids

    def parts(self, mover: int) -> NDArray[np.intp]:
        """The numbers of a mover's parts."""
        return np.flatnonzero(self.solids.mover == mover)

    def at(self, parts: NDArray[np.intp], stamp_ns: NDArray[np.int64] | int) -> Solids:
        """Some parts at n times; interpolated between scans, extrapolated after the last one."""
        at_ns, last = np.atleast_1d(np.asarray(stamp_ns, np.int64)), len(self.stamp_ns) - 1
        t = np.clip(np.searchsorted(self.stamp_ns, at_ns, side="right") - 1, 0, max(last - 1, 0))
        after = np.minimum(t + 1, last)
        span, since = self.stamp_ns[after] - self.stamp_ns[t], at_ns - self.stamp_ns[t]
        share = np.clip(since / np.where(span > 0, span, np.inf), 0.0, 2.0)[:, None, None]
        before = self.solids.pose[t[:, None], parts]
        change = self.solids.pose[after[:, None], parts] - before
        change[..., 2] = (change[..., 2] + np.pi) % (2 * np.pi) - np.pi
        way = np.hypot(change[..., 0], change[..., 1])
        goes_on = way < MAX_SPEED * 1e-9 * np.maximum(span, 1)[:, None]
        # a jump between scans is not interpolated
        stays = np.where(share < 1.0, before, before + change)
        pose = np.where(goes_on[..., None], before + share * change, stays)
        return self.solids._replace(pose=self.solids.pose[:1]).select(parts)._replace(pose=pose)


def sample_mover(
    moving: MovingSurfaces, mover: int, stamp_ns: int, spacing: float
) -> tuple[Float, NDArray[np.intp]]:
    """Sample the surface of a mover at one time, without points inside another of its parts.

    Args:
        moving: the movers.
        mover: number of the mover.
        stamp_ns: time.
        spacing: approximate distance between points, metres.

    Returns:
        (n, 3) metres in the world, none while absent; (n,) index into `moving.parts(mover)`.
    """
    parts = moving.parts(mover)
    solids = moving.at(parts, stamp_ns)
    points, which = [np.empty((0, 3))], [np.empty(0, np.intp)]
    for k in np.flatnonzero(np.isfinite(solids.pose[0]).all(axis=1)).tolist():
        on = to_world(_samples(solids, k, spacing), solids.pose[0, k])
        outside = np.ones(len(on), bool)
        for other in range(len(parts)):
            if other != k:
                outside &= ~_is_within(on, solids, other)
        points.append(on[outside])
        which.append(np.full(len(points[-1]), k, np.intp))
    return np.concatenate(points), np.concatenate(which)


def _is_within(points: Float, solids: Solids, k: int) -> NDArray[np.bool_]:
    (a, b), (z0, z1) = solids.half[k] - _MIN_DEPTH, solids.z[k] + (_MIN_DEPTH, -_MIN_DEPTH)
    u, v, w = to_local(points, solids.pose[0, k]).T
    h, up = (z1 - z0) / 2, w - (z0 + z1) / 2
    if solids.form[k] == BOX:
        return np.asarray((np.abs(u) < a) & (np.abs(v) < b) & (np.abs(up) < h))
    flat = (u / a) ** 2 + (v / b) ** 2
    if solids.form[k] == CYLINDER:
        return np.asarray((flat < 1.0) & (np.abs(up) < h))
    return np.asarray(flat + (up / h) ** 2 < 1.0)


def _samples(solids: Solids, k: int, spacing: float) -> Float:
    """(n, 3) points on the surface of solid k, in its frame."""
    middle, half = _middle_and_half(solids, k)
    samples = {BOX: _box_samples, CYLINDER: _cylinder_samples}
    return np.asarray(samples.get(solids.form[k], _ellipsoid_samples)(half, spacing) + middle)


def _cylinder_samples(half: Float, spacing: float) -> Float:
    flat, h = half[:2], half[2]
    around = _even(2 * np.pi * flat.max(), spacing) * 2 * np.pi
    angle, up = np.meshgrid(around, _along(h, spacing))
    rim = [half[0] * np.cos(angle), half[1] * np.sin(angle), up]
    disc = np.stack(np.meshgrid(*(_along(one, spacing) for one in flat)), axis=-1).reshape(-1, 2)
    disc = disc[((disc / flat) ** 2).sum(axis=1) <= 1.0]
    caps = [np.column_stack([disc, np.full(len(disc), end)]) for end in (-h, h)]
    return np.concatenate([np.stack(rim, axis=-1).reshape(-1, 3), *caps])


def _ellipsoid_samples(half: Float, spacing: float) -> Float:
    rows = []
    for tilt in ((_even(np.pi * half.max(), spacing) - 0.5) * np.pi).tolist():
        round_it = 2 * np.pi * half[:2].max() * np.cos(tilt)
        angle = _even(round_it, spacing) * 2 * np.pi
        flat = np.cos(tilt) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rows.append(half * np.column_stack([flat, np.full(len(angle), np.sin(tilt))]))
    return np.concatenate(rows)


def _box_samples(half: Float, spacing: float) -> Float:
    sides = []
    for axis in range(3):
        others = [(axis + 1) % 3, (axis + 2) % 3]
        grid = np.meshgrid(*(_along(half[one], spacing) for one in others))
        for end in (-half[axis], half[axis]):
            side = np.full((grid[0].size, 3), end)
            side[:, others] = np.stack(grid, axis=-1).reshape(-1, 2)
            sides.append(side)
    return np.concatenate(sides)


def _along(half: float, spacing: float) -> Float:
    """Centers of equal parts of -half to half."""
    return half * (2.0 * _even(2.0 * half, spacing) - 1.0)


def _even(length: float, spacing: float) -> Float:
    """Centers of equal parts of 0 to 1, each at most `spacing` / `length` long."""
    n = max(1, int(np.ceil(length / spacing - 1e-9)))
    return np.asarray((np.arange(n) + 0.5) / n)
