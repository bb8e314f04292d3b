"""Mirrors: beams of a planar laser that are reflected once, by brute force, as few beams are."""

import numpy as np
from numpy.typing import NDArray

from stillmap.sim.dynamics import Moment, Motion
from stillmap.sim.laser import MIN_RANGE, Float, Movers, Outlines, Returns

MIRRORED = -4  # Truth.mover of beams that end on what a mirror shows
_BLOCK = 2000  # beams intersected at once
_SLACK = 1e-9  # of a wall's length, so that no beam passes between two walls that share a corner


def reflect_beams(
    exact: Returns,
    by: NDArray[np.bool_],
    motion: Motion,
    walls: Float,
    T_base_sensor: Float,
    bearing: Float,
    seconds: Float,
    robot_radius: float,
) -> Returns:
    """Returns whose beams go on, from the mirror that they meet, to what it shows.

    What lies behind a second mirror is not followed: the beam ends there.

    Args:
        exact: returns (T, n) that end at mirrors.
        by: (T, n) beams that are reflected; their `wall` is the mirror.
        motion: of T scans.
        walls: (W, 4) segments in metres, mirrors among them.
        T_base_sensor: (T, 3, 3) pose of the laser of each scan.
        bearing: (T, n) of the beams in the frame of the base, rad.
        seconds: (n,) of the beams after the stamp of their scan.
        robot_radius: m; the robot sees itself as well.
    """
    out = Returns(exact.range.copy(), exact.wall.copy(), exact.mover.copy())
    all_scans, all_beams = np.nonzero(by)
    for first in range(0, len(all_scans), _BLOCK):
        part = slice(first, first + _BLOCK)
        scan, beam = all_scans[part], all_beams[part]
        now = Moment(motion, scan, seconds[beam])
        x, y, theta = now.interpolate(motion.robot).T
        c, s = np.cos(theta), np.sin(theta)
        offset = T_base_sensor[scan, :2, 2]
        sensor = np.stack([x + c * offset[:, 0] - s * offset[:, 1],
                           y + s * offset[:, 0] + c * offset[:, 1]], axis=-1)  # fmt: skip
        heading = theta + bearing[scan, beam]
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        mirror = exact.wall[scan, beam]
        to_mirror = exact.range[scan, beam]
        origin = sensor + to_mirror[:, None] * direction
        direction = _reflect(direction, walls[mirror])
        people, outlines = now.interpolate_movers()
        people = _with_robot(people, x, y, robot_radius)
        wall, r = _cast(origin, direction, walls, mirror)
        moving = np.minimum(_cast_people(origin, direction, people),
                            _cast_faces(origin, direction, outlines))  # fmt: skip
        wall = np.where(moving < r, -1, wall)
        r = np.minimum(r, moving)
        out.range[scan, beam], out.wall[scan, beam] = to_mirror + r, wall
        out.mover[scan, beam] = np.where(np.isfinite(r), MIRRORED, -1)
    return out


def _reflect(direction: Float, mirrors: Float) -> Float:
    """(B, 2) directions after reflection by segments (B, 4)."""
    along = mirrors[:, 2:] - mirrors[:, :2]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(2.0 * np.sum(direction * along, axis=1, keepdims=True) * along - direction)


def _with_robot(people: Movers, x: Float, y: Float, radius: float) -> Movers:
    """The people (B, Q) and the robot at (B,) as one more of them."""
    xy = np.concatenate([people.xy, np.stack([x, y], axis=-1)[:, None]], axis=1)
    heading = np.concatenate([people.heading, np.zeros((len(x), 1))], axis=1)
    semi_axes = np.concatenate([people.semi_axes, [[radius, radius]]])
    return Movers(xy, heading, semi_axes, np.append(people.mover, np.int32(MIRRORED)))


def _cast(
    origin: Float, direction: Float, walls: Float, leave_out: NDArray[np.int32]
) -> tuple[NDArray[np.int32], Float]:
    """(B,) nearest wall of each beam but the one left out, and the range; -1 and inf: none."""
    r = _ranges(origin[:, None], direction[:, None], np.broadcast_to(walls, (1, *walls.shape)))
    r[np.arange(len(r)), leave_out] = np.inf
    wall = np.argmin(r, axis=1).astype(np.int32)
    nearest = r[np.arange(len(r)), wall]
    return np.where(np.isfinite(nearest), wall, np.int32(-1)), nearest


def _ranges(origin: Float, direction: Float, faces: Float) -> Float:
    """(B, F) ranges of beams (B, 1, 2) to segments (B, F, 4) or (1, F, 4); inf: none."""
    start, along = faces[..., :2] - origin, faces[..., 2:] - faces[..., :2]
    # origin + r d = start + share along
    area = direction[..., 0] * along[..., 1] - direction[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (start[..., 0] * along[..., 1] - start[..., 1] * along[..., 0]) / area
        share = (start[..., 0] * direction[..., 1] - start[..., 1] * direction[..., 0]) / area
        met = (r > MIN_RANGE) & (share >= -_SLACK) & (share <= 1 + _SLACK)
    return np.where(met, r, np.inf)


def _cast_faces(origin: Float, direction: Float, outlines: Outlines) -> Float:
    """(B,) ranges to moving faces (B, F, 4)."""
    if not len(outlines.mover):
        return np.full(len(origin), np.inf)
    r = _ranges(origin[:, None], direction[:, None], outlines.faces)
    return np.asarray(r.min(axis=1, initial=np.inf))


def _cast_people(origin: Float, direction: Float, people: Movers) -> Float:
    """(B,) ranges to elliptic cross sections (B, Q)."""
    c, s = np.cos(people.heading), np.sin(people.heading)
    dx, dy = np.moveaxis(origin[:, None] - people.xy, -1, 0)
    a, b = people.semi_axes.T
    # the ellipse as the unit circle: origin at o, direction d
    ox, oy = (dx * c + dy * s) / a, (dy * c - dx * s) / b
    ux, uy = direction[:, :1], direction[:, 1:]
    vx, vy = (ux * c + uy * s) / a, (uy * c - ux * s) / b
    A, B = vx**2 + vy**2, ox * vx + oy * vy
    rest = B**2 - A * (ox**2 + oy**2 - 1)
    r = np.where(rest >= 0, (-B - np.sqrt(np.maximum(rest, 0))) / A, np.inf)
    return np.asarray(np.where(r > MIN_RANGE, r, np.inf).min(axis=1, initial=np.inf))
