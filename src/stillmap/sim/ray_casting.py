"""Exact ranges of the beams of one lidar turn to faces, solids, ground and ceiling.

A surface covers an interval of columns and one of channels. Only the beams within both are
intersected with it, all at once, unless they all end at nearer surfaces: the nearest come first.
"""

from collections.abc import Iterator
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Float, Int32
from stillmap.sim.geometry import BOX, CYLINDER, Faces, Ground, Solids, StaticSurfaces
from stillmap.sim.laser import MIN_RANGE

Window = tuple[slice, slice]  # columns, channels
Candidate = tuple[float, int, Window]  # metres that a surface is away at least, its number

_SLACK = 1e-9  # rad, so that no beam passes between two faces that share an edge
_ABSENT = 1e9  # m, position of absent solids


class Rays(NamedTuple):
    """n columns of C simultaneous beams each.

    Attributes:
        origin: (3, n, 1) metres, in the world.
        direction: (3, n, C) unit vectors, in the world.
        azimuth: (n,) rad, rising over about one turn; of each column in the world.
        spread: rad, maximum deviation of a beam from its column's azimuth.
        elevation: (C,) rad, rising.
        tilt: rad, maximum deviation of a beam from its channel's elevation, in the world.
    """

    origin: Float
    direction: Float
    azimuth: Float
    spread: float
    elevation: Float
    tilt: float

    def within(self, window: Window) -> tuple[Float, Float]:
        """Origins (3, k, 1) and directions (3, k, c) of the beams in a window."""
        columns, channels = window
        return self.origin[:, columns], self.direction[:, columns, channels]


class RayReturns(NamedTuple):
    """The nearest surface on each of (n, C) beams.

    Attributes:
        range: metres, inf without a hit.
        part: int32, number of the moving solid, -1: none.
        mover: int32 id of the mover, -1: none.
        on_glass: bool.
    """

    range: Float
    part: Int32
    mover: Int32
    on_glass: Bool


def cast_rays(rays: Rays, static: StaticSurfaces, moving: Solids) -> RayReturns:
    """Intersect beams with a world.

    Args:
        rays: the beams.
        static: the static surfaces.
        moving: further solids, at all times or at those of the columns.
    """
    faces, ground = static.faces, static.ground
    range = intersect_ground(rays.origin, rays.direction, ground, static.ceiling)
    part, glass = np.full(range.shape, -1, np.int32), np.zeros(range.shape, bool)
    surfaces: list[tuple[float, int, Window, Solids | None]] = [
        *((*candidate, None) for candidate in _find_faces(rays, faces, ground)),
        *((*candidate, static.solids) for candidate in _find_solids(rays, static.solids)),
        *((*candidate, moving) for candidate in _find_solids(rays, moving)),
    ]
    for near, k, window, solids in sorted(surfaces, key=itemgetter(0)):
        before, (origin, direction) = range[window], rays.within(window)
        if before.max() <= near:
            continue
        if solids is None:
            t = intersect_face(origin, direction, faces.ends[k], faces.z[k], ground)
        else:
            pose = solids.pose[window[0] if len(solids.pose) > 1 else slice(None), k]
            t = intersect_solid(origin, direction, solids, k, pose)
        nearer = t < before
        before[nearer] = t[nearer]
        part[window][nearer] = k if solids is moving else -1
        glass[window][nearer] = solids is None and faces.is_glass[k]
    mover = np.append(moving.mover, np.int32(-1))[part]  # part -1 is the last one
    return RayReturns(range, part, mover, glass)


def intersect_ground(
    origin: Float, direction: Float, ground: Ground, ceiling: float | None
) -> Float:
    """(...) metres along rays to street, pavements and ceiling; inf: no intersection."""
    range = ground.distance(origin, direction)
    if ground.kerb > 0 and len(ground.pavements):
        upper = ground.distance(origin, direction, ground.kerb)
        with np.errstate(invalid="ignore"):
            x, y = (origin + upper * direction)[:2]
        np.copyto(range, upper, where=ground.is_paved(x, y))
    if ceiling is not None:
        np.minimum(range, ground.distance(origin, direction, ceiling), out=range)
    range[range < MIN_RANGE] = np.inf
    return range


def intersect_face(origin: Float, direction: Float, ends: Float, z: Float, ground: Ground) -> Float:
    """(n, C) metres along rays from (3, n, 1) to an upright face; inf: no intersection."""
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    x0, y0, x1, y1 = ends
    ux, uy = x1 - x0, y1 - y0
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((x0 - ox) * uy - (y0 - oy) * ux) / (dx * uy - dy * ux)
        x, y = ox + t * dx, oy + t * dy
        along = (x - x0) * ux + (y - y0) * uy
        above = oz + t * dz - ground.level(x, y)
        met = (t > MIN_RANGE) & (along >= -_SLACK) & (along <= ux * ux + uy * uy + _SLACK)
        met &= (above >= z[0]) & (above <= z[1])
    return np.asarray(np.where(met, t, np.inf))


def intersect_solid(origin: Float, direction: Float, solids: Solids, k: int, pose: Float) -> Float:
    """(n, C) metres along rays from (3, n, 1), outside it, to solid k at poses (n, 4) or (1, 4)."""
    x, y, heading, foot = pose.T[:, :, None]
    (a, b), (z0, z1), form = solids.half[k], solids.z[k], solids.form[k]
    c, s, h = np.cos(heading), np.sin(heading), (z1 - z0) / 2
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    # scaled to the unit cube, cylinder or sphere; distances along beams stay
    u, v = ((ox - x) * c + (oy - y) * s) / a, ((oy - y) * c - (ox - x) * s) / b
    w = (oz - foot - z0 - h) / h
    du, dv, dw = dx * (c / a) + dy * (s / a), dy * (c / b) - dx * (s / b), dz / h
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if form == BOX:
            enters, leaves = _intersect(_slab(u, du), _slab(v, dv))
        elif form == CYLINDER:
            enters, leaves = _sphere(du * du + dv * dv, u * du + v * dv, u * u + v * v)
        else:
            squares = du * du + dv * dv + dw * dw
            enters, leaves = _sphere(squares, u * du + v * dv + w * dw, u * u + v * v + w * w)
        if form in (BOX, CYLINDER):
            enters, leaves = _intersect((enters, leaves), _slab(w, dw))
        return np.asarray(np.where((enters <= leaves) & (enters > MIN_RANGE), enters, np.inf))


def _slab(u: Float, du: Float) -> tuple[Float, Float]:
    """Distances at which rays enter and leave -1 <= u <= 1."""
    per = 1.0 / du  # infinite for rays along it: within from -inf to inf, or never
    near, far = (-1.0 - u) * per, (1.0 - u) * per
    return np.minimum(near, far), np.maximum(near, far)


def _sphere(squares: Float, product: Float, rest: Float) -> tuple[Float, Float]:
    """Distances at which rays enter and leave |u| <= 1, from |du|^2, u . du and |u|^2."""
    root = np.sqrt(product * product - squares * (rest - 1.0))  # NaN: no intersection
    return (-product - root) / squares, (-product + root) / squares


def _intersect(a: tuple[Float, Float], b: tuple[Float, Float]) -> tuple[Float, Float]:
    return np.maximum(a[0], b[0]), np.minimum(a[1], b[1])


def _find_faces(rays: Rays, faces: Faces, ground: Ground) -> Iterator[Candidate]:
    """The faces that beams may hit."""
    if not len(faces.ends):
        return
    ox, oy, oz, move = _middle(rays)
    x0, y0, x1, y1 = faces.ends.T
    bearing, end = np.arctan2(y0 - oy, x0 - ox), np.arctan2(y1 - oy, x1 - ox)
    turn = (end - bearing + np.pi) % (2 * np.pi) - np.pi
    far = np.maximum(np.hypot(x0 - ox, y0 - oy), np.hypot(x1 - ox, y1 - oy))
    levels = np.stack([ground.level(x0, y0), ground.level(x1, y1)])
    low = levels.min(axis=0) + faces.z[:, 0] - oz
    high = levels.max(axis=0) + faces.z[:, 1] - oz
    near, middle = faces.distance(ox, oy), bearing + turn / 2
    yield from _windows(rays, middle, np.abs(turn) / 2, near, far, (low, high), move)


def _find_solids(rays: Rays, solids: Solids) -> Iterator[Candidate]:
    """The solids that beams may hit."""
    if not len(solids.form):
        return
    ox, oy, oz, move = _middle(rays)
    pose = np.nan_to_num(solids.pose, nan=_ABSENT)
    at = pose[len(pose) // 2]
    own = np.hypot(pose[..., 0] - at[:, 0], pose[..., 1] - at[:, 1]).max(axis=0)
    radius = solids.radius + own
    distance = np.hypot(at[:, 0] - ox, at[:, 1] - oy)
    z = solids.z + at[:, 3:] - oz
    z[:, 0] -= np.ptp(pose[..., 3], axis=0)
    z[:, 1] += np.ptp(pose[..., 3], axis=0)
    bearing = np.arctan2(at[:, 1] - oy, at[:, 0] - ox)
    half = np.arcsin(np.minimum(radius / np.maximum(distance, 1e-6), 1.0))
    near, far = distance - radius, distance + radius
    yield from _windows(rays, bearing, half, near, far, (z[:, 0], z[:, 1]), move)


def _middle(rays: Rays) -> tuple[float, float, float, float]:
    """x, y, z of the lidar in the middle of its turn and its maximum distance from there, m."""
    at = rays.origin[:, rays.origin.shape[1] // 2]
    x, y, z = at[:, 0].tolist()
    return x, y, z, float(np.sqrt(((rays.origin - at[:, None]) ** 2).sum(axis=0)).max())


def _windows(
    rays: Rays,
    bearing: Float,
    half: Float,
    near: Float,
    far: Float,
    heights: tuple[Float, Float],
    move: float,
) -> Iterator[Candidate]:
    """Columns and channels that may hit P surfaces.

    Args:
        rays: the beams.
        bearing, half: (P,) rad, they lie within bearing +- half, seen from the middle of the turn.
        near, far: (P,) metres, minimum and maximum distance from there.
        heights: minimum and maximum height over the lidar, (P,) metres each.
        move: metres, maximum distance of the lidar from there.
    """
    n, first = len(rays.azimuth), rays.azimuth[0]
    near, far = near - move, far + move
    half = half + np.arcsin(np.minimum(move / np.maximum(near + move, 1e-9), 1.0))
    half += rays.spread + _SLACK
    half[(near <= 0) | (half >= np.pi)] = np.inf
    low, high = heights[0] - move, heights[1] + move
    closest = np.maximum(near, 1e-3)
    lowest = np.arctan2(low, np.where(low > 0, far, closest)) - rays.tilt - _SLACK
    highest = np.arctan2(high, np.where(high > 0, closest, far)) + rays.tilt + _SLACK
    begin = np.searchsorted(rays.elevation, lowest, side="left")
    end = np.searchsorted(rays.elevation, highest, side="right")
    middle = first + (bearing - first) % (2 * np.pi)
    shifts = middle[:, None] + 2 * np.pi * np.arange(-1, 2)
    start = np.searchsorted(rays.azimuth, shifts - half[:, None], side="left")
    stop = np.searchsorted(rays.azimuth, shifts + half[:, None], side="right")
    all_round = np.isinf(half)
    start[all_round], stop[all_round] = 0, [n, 0, 0]
    use = (start < stop) & (begin < end)[:, None]
    for k, turn in np.argwhere(use).tolist():
        window = (slice(start[k, turn], stop[k, turn]), slice(begin[k], end[k]))
        yield float(near[k]) - _SLACK, k, window
