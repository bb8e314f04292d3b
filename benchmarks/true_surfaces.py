"""True surfaces of a simulated world: projection of points to them, places of movers."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap.sim.dynamics import MAX_SPEED
from stillmap.sim.geometry import (
    BOX,
    CYLINDER,
    Float,
    Ground,
    MovingSurfaces,
    Solids,
    StaticSurfaces,
    to_local,
)

_SQUARE = 4.0  # m, points within one share their candidate surfaces
_BISECTIONS = 80  # of the root for the nearest point of an ellipse, to the last digit


def project_to_static(surfaces: StaticSurfaces, points: Float) -> tuple[Float, Float]:
    """Project points to the nearest static surface.

    Exact for solids, and for faces and ground where the ground is level; where it slopes, up
    to the square of the slope. Hidden surfaces count, as the floor below a cupboard.

    Args:
        surfaces: of the world.
        points: (n, 3) metres.

    Returns:
        Distances (n,) in metres, and the projected points (n, 3).
    """
    places = _on_ground(points, surfaces.ground, surfaces.ceiling)
    distance = np.linalg.norm(places - points, axis=1)
    a, b, center = (
        surfaces.faces.ends[:, :2],
        surfaces.faces.ends[:, 2:],
        surfaces.solids.pose[0, :, :2],
    )
    reach = np.hypot(*surfaces.solids.half.T)[:, None]
    lowest = np.concatenate([np.minimum(a, b), center - reach])
    highest = np.concatenate([np.maximum(a, b), center + reach])
    for part in _in_squares(points):
        some, d, at = points[part], distance[part], places[part]
        off = _gap(some[:, :2].min(axis=0), some[:, :2].max(axis=0), lowest, highest)
        for k in np.flatnonzero(off < d.max() ** 2).tolist():
            near = np.flatnonzero(_gap(some[:, :2], some[:, :2], lowest[k], highest[k]) < d * d)
            if len(near):
                found = _project_to(surfaces, k, some[near])
                off_found = np.linalg.norm(found - some[near], axis=1)
                better = off_found < d[near]
                d[near[better]], at[near[better]] = off_found[better], found[better]
        distance[part], places[part] = d, at
    return distance, places


def _project_to(surfaces: StaticSurfaces, k: int, points: Float) -> Float:
    """Project points to face k or, counted after the faces, a solid."""
    first = len(surfaces.faces.ends)
    if k >= first:
        return project_to_solid(points, surfaces.solids, k - first)
    return _on_face(points, surfaces.faces.ends[k], surfaces.faces.z[k], surfaces.ground)


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
    level, (gx, gy) = ground.level(x, y), ground.slope
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


def place_parts(
    moving: MovingSurfaces, parts: NDArray[np.intp], stamp_ns: NDArray[np.int64] | int
) -> Solids:
    """Some parts at n times; interpolated between scans, extrapolated after the last one."""
    at_ns, last = np.atleast_1d(np.asarray(stamp_ns, np.int64)), len(moving.stamp_ns) - 1
    t = np.clip(np.searchsorted(moving.stamp_ns, at_ns, side="right") - 1, 0, max(last - 1, 0))
    after = np.minimum(t + 1, last)
    span, since = moving.stamp_ns[after] - moving.stamp_ns[t], at_ns - moving.stamp_ns[t]
    share = np.clip(since / np.where(span > 0, span, np.inf), 0.0, 2.0)[:, None, None]
    before = moving.solids.pose[t[:, None], parts]
    change = moving.solids.pose[after[:, None], parts] - before
    change[..., 2] = (change[..., 2] + np.pi) % (2 * np.pi) - np.pi
    way = np.hypot(change[..., 0], change[..., 1])
    goes_on = way < MAX_SPEED * 1e-9 * np.maximum(span, 1)[:, None]
    # a jump between scans is not interpolated
    stays = np.where(share < 1.0, before, before + change)
    pose = np.where(goes_on[..., None], before + share * change, stays)
    return moving.solids._replace(pose=moving.solids.pose[:1]).select(parts)._replace(pose=pose)
