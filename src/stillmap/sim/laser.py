"""What a laser scanner measures among walls and movers: exact ranges, then noise and losses.

A wall or a mover covers an interval of beams in each scan. Only those beams are intersected with
it, for all scans at once, so the work grows with what is covered, not with beams times walls.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.sim.options import LaserOptions

Float = NDArray[np.float64]
Index = NDArray[np.int64]

_CHUNK = 1000  # scans worked on together
_EDGE = 1e-9  # beams, so that no ray slips between two walls that share a corner
_NEAREST = 1e-3  # m, the laser sees nothing nearer


@dataclass(frozen=True, eq=False)
class Movers:
    """What the laser sees of people: upright cylinders with elliptic outline.

    Attributes:
        xy: (T, Q, 2) centres in metres at each scan.
        heading: (T, Q) direction of the first axis in radians.
        semi_axes: (Q, 2) metres.
        mover: (Q,) whose part this is.
    """

    xy: Float
    heading: Float
    semi_axes: Float
    mover: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Outlines:
    """What the laser sees of doors, vehicles and things: upright faces that move.

    Attributes:
        faces: (T, Q, 4) segments x0, y0, x1, y1 in metres at each scan. No beam meets one that
            has no length.
        mover: (Q,) whose face this is.
    """

    faces: Float
    mover: NDArray[np.int32]


class Returns(NamedTuple):
    """The nearest thing on each beam.

    Attributes:
        range: (T, n) metres, inf where there is nothing.
        wall: (T, n) int32 index of the wall that is hit, -1: none.
        mover: (T, n) int32 id of the mover that is hit, -1: none.
    """

    range: Float
    wall: NDArray[np.int32]
    mover: NDArray[np.int32]


def compute_beam_angles(beams: int, fov: float) -> Float:
    """(n,) angles in the sensor frame, rising, in radians.

    As SICK scanners number them: an odd number of beams includes both ends of the field of view,
    an even number (and a full circle) leaves out the last one.
    """
    closed = beams % 2 == 1 and fov < 2 * np.pi - 1e-9
    step = fov / (beams - 1 if closed else beams)
    return np.asarray(-fov / 2 + step * np.arange(beams), np.float64)


def cast_beams(
    poses: Float,
    angles: Float,
    walls: Float,
    movers: Movers,
    outlines: Outlines | None = None,
    reach: float = np.inf,
) -> Returns:
    """Exact ranges of T scans with n beams each.

    Args:
        poses: (T, 3) sensor poses x, y, theta in the world.
        angles: (n,) evenly spaced beam angles in the sensor frame, rising, at least 2.
        walls: (W, 4) segments in metres.
        movers: their parts at these T scans.
        outlines: further movers at these T scans.
        reach: metres, walls farther away than this may be left out.
    """
    shape = (len(poses), len(angles))
    out = Returns(
        np.full(shape, np.inf), np.full(shape, -1, np.int32), np.full(shape, -1, np.int32)
    )
    for first in range(0, len(poses), _CHUNK):
        part = slice(first, first + _CHUNK)
        scans = _Scans(poses[part], angles)
        near = _within(reach, scans, walls)
        _cast_walls(scans, walls, near, out.range[part], out.wall[part])
        _cast_movers(scans, movers, part, out.range[part], out.mover[part])
        if outlines is not None:
            _cast_outlines(scans, outlines, part, out.range[part], out.mover[part])
    out.wall[out.mover >= 0] = -1
    return out


class _Scans:
    """Sensor poses and beam directions of a chunk of scans."""

    def __init__(self, poses: Float, angles: Float) -> None:
        self.x, self.y, self.theta = poses.T
        self.first, self.step, self.n = angles[0], angles[1] - angles[0], len(angles)
        world = self.theta[:, None] + angles
        self.cos, self.sin = np.cos(world).ravel(), np.sin(world).ravel()

    def covered(self, start: Float, span: Float) -> tuple[Index, Index]:
        """Pairs (scan, flat beam index) of the beams within world bearings start + [0, span]."""
        turn = 2 * np.pi / self.step
        low = ((start - self.theta - self.first) % (2 * np.pi)) / self.step
        scans, beams = [], []
        for shift in (0.0, turn):
            a = np.ceil(low - shift - _EDGE).astype(np.int64)
            b = np.floor(low - shift + span / self.step + _EDGE).astype(np.int64)
            a, b = np.maximum(a, 0), np.minimum(b, self.n - 1)
            count = np.maximum(b - a + 1, 0)
            scan = np.repeat(np.arange(len(low)), count)
            ends = np.cumsum(count)
            within = np.arange(len(scan)) - np.repeat(ends - count, count)
            scans.append(scan)
            beams.append(scan * self.n + np.repeat(a, count) + within)
        return np.concatenate(scans), np.concatenate(beams)


def _within(reach: float, scans: _Scans, walls: Float) -> Index:
    """The walls that come as near as `reach` to the box around all sensors."""
    x, y = walls[:, ::2], walls[:, 1::2]
    near = (x.max(axis=1) >= scans.x.min() - reach) & (x.min(axis=1) <= scans.x.max() + reach)
    near &= (y.max(axis=1) >= scans.y.min() - reach) & (y.min(axis=1) <= scans.y.max() + reach)
    return np.flatnonzero(near)


def _cast_walls(
    scans: _Scans, walls: Float, near: Index, ranges: Float, which: NDArray[np.int32]
) -> None:
    flat, flat_which = ranges.reshape(-1), which.reshape(-1)
    for w in near.tolist():
        flat_which[_lowered(scans, walls[w], flat)] = w


def _cast_outlines(
    scans: _Scans, outlines: Outlines, part: slice, ranges: Float, which: NDArray[np.int32]
) -> None:
    flat, flat_which = ranges.reshape(-1), which.reshape(-1)
    for q, mover in enumerate(outlines.mover):
        flat_which[_lowered(scans, outlines.faces[part, q].T, flat)] = mover


def _lowered(scans: _Scans, face: Float, ranges: Float) -> Index:
    """Lower flat ranges to a face (4,), or (4, T) if it moves; the beams that it is nearest on."""
    x0, y0, x1, y1 = face
    bearing = np.arctan2(y0 - scans.y, x0 - scans.x)
    other = np.arctan2(y1 - scans.y, x1 - scans.x)
    turn = (other - bearing + np.pi) % (2 * np.pi) - np.pi
    scan, beam = scans.covered(np.where(turn >= 0, bearing, other), np.abs(turn))
    nx, ny = np.broadcast_to(y0 - y1, turn.shape), np.broadcast_to(x1 - x0, turn.shape)
    height = nx * (x0 - scans.x) + ny * (y0 - scans.y)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = height[scan] / (nx[scan] * scans.cos[beam] + ny[scan] * scans.sin[beam])
    nearer = (r > _NEAREST) & (r < ranges[beam])
    ranges[beam[nearer]] = r[nearer]
    return np.asarray(beam[nearer])


def _cast_movers(
    scans: _Scans, movers: Movers, part: slice, ranges: Float, which: NDArray[np.int32]
) -> None:
    flat, flat_which = ranges.reshape(-1), which.reshape(-1)
    for q, (a, b) in enumerate(movers.semi_axes):
        dx = movers.xy[part, q, 0] - scans.x
        dy = movers.xy[part, q, 1] - scans.y
        half = np.arcsin(np.minimum(max(a, b) / np.maximum(np.hypot(dx, dy), 1e-6), 1.0))
        scan, beam = scans.covered(np.arctan2(dy, dx) - half, 2 * half)
        c, s = np.cos(movers.heading[part, q]), np.sin(movers.heading[part, q])
        # the ellipse as the unit circle: sensor at o, beam direction d
        ox, oy = ((-dx * c - dy * s) / a)[scan], ((dx * s - dy * c) / b)[scan]
        ux, uy = scans.cos[beam], scans.sin[beam]
        dirx, diry = (ux * c[scan] + uy * s[scan]) / a, (uy * c[scan] - ux * s[scan]) / b
        A, B = dirx**2 + diry**2, ox * dirx + oy * diry
        rest = B**2 - A * (ox**2 + oy**2 - 1)
        r = np.where(rest >= 0, (-B - np.sqrt(np.maximum(rest, 0))) / A, np.inf)
        nearer = (r > _NEAREST) & (r < flat[beam])
        flat[beam[nearer]] = r[nearer]
        flat_which[beam[nearer]] = movers.mover[q]


def simulate_measurement(
    exact: Returns, is_glass: NDArray[np.bool_], options: LaserOptions, rng: np.random.Generator
) -> tuple[Float, NDArray[np.bool_]]:
    """Measured ranges (T, n) and whether something came back (T, n).

    Args:
        exact: what the beams meet.
        is_glass: (W,) which walls lose beams.
        options: noise and losses. A beam without return gets options.max_range.
        rng: noise and losses.
    """
    lost = rng.random(exact.range.shape)
    share = np.full(exact.range.shape, options.no_return_share)
    on_wall = exact.wall >= 0
    share[on_wall] += is_glass[exact.wall[on_wall]] * options.glass_no_return_share
    noisy = exact.range + options.range_noise * rng.standard_normal(exact.range.shape)
    hit = (noisy < options.max_range) & (lost >= share)
    return np.where(hit, np.maximum(noisy, _NEAREST), options.max_range), hit
