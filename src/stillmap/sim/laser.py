"""A planar laser: exact ranges to walls and movers, then noise and losses.

A wall or mover covers an interval of beams in each scan. Only those beams are intersected with it,
for all scans at once.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Float, Int32, Int64
from stillmap.sim.options import LaserOptions, LidarOptions
from stillmap.sim.scene import Scene

_CHUNK = 1000  # scans processed at once
_SLACK = 1e-9  # beams, so that no ray passes between two walls that share a corner
MIN_RANGE = 1e-3  # m


@dataclass(frozen=True, eq=False)
class Movers:
    """Cross sections of people: upright elliptic cylinders.

    Attributes:
        xy: (T, Q, 2) centres in metres at each scan.
        heading: (T, Q) direction of the first axis in radians.
        semi_axes: (Q, 2) metres.
        mover: (Q,) mover of each part.
    """

    xy: Float
    heading: Float
    semi_axes: Float
    mover: Int32


@dataclass(frozen=True, eq=False)
class Outlines:
    """Moving upright faces of doors, vehicles and movable objects.

    Attributes:
        faces: (T, Q, 4) segments x0, y0, x1, y1 in metres at each scan. No beam hits one of length
            0.
        mover: (Q,) mover of each face.
    """

    faces: Float
    mover: Int32


class Returns(NamedTuple):
    """The nearest surface on each beam.

    Attributes:
        range: (T, n) metres, inf without a hit.
        wall: (T, n) int32 index of the wall, -1: none.
        mover: (T, n) int32 id of the mover, -1: none.
    """

    range: Float
    wall: Int32
    mover: Int32


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
    none = np.full(shape, -1, np.int32)
    out = Returns(np.full(shape, np.inf), none, none.copy())
    for first in range(0, len(poses), _CHUNK):
        part = slice(first, first + _CHUNK)
        scans = _Scans(poses[part], angles)
        ranges, mover = out.range[part].reshape(-1), out.mover[part].reshape(-1)
        for w in _within(reach, scans, walls).tolist():
            out.wall[part].reshape(-1)[_lower_ranges(scans, walls[w], ranges)] = w
        _cast_movers(scans, movers, part, ranges, mover)
        if outlines is not None:
            for q, number in enumerate(outlines.mover):
                mover[_lower_ranges(scans, outlines.faces[part, q].T, ranges)] = number
    out.wall[out.mover >= 0] = -1
    return out


class _Scans:
    """Sensor poses and beam directions of a chunk of scans."""

    def __init__(self, poses: Float, angles: Float) -> None:
        self.x, self.y, self.theta = poses.T
        self.first, self.step, self.n = angles[0], angles[1] - angles[0], len(angles)
        world = self.theta[:, None] + angles
        self.cos, self.sin = np.cos(world).ravel(), np.sin(world).ravel()

    def covered(self, start: Float, span: Float) -> tuple[Int64, Int64]:
        """Pairs (scan, flat beam index) of the beams within world bearings start + [0, span]."""
        turn = 2 * np.pi / self.step
        low = ((start - self.theta - self.first) % (2 * np.pi)) / self.step
        scans, beams = [], []
        for shift in (0.0, turn):
            a = np.ceil(low - shift - _SLACK).astype(np.int64)
            b = np.floor(low - shift + span / self.step + _SLACK).astype(np.int64)
            a, b = np.maximum(a, 0), np.minimum(b, self.n - 1)
            count = np.maximum(b - a + 1, 0)
            scan = np.repeat(np.arange(len(low)), count)
            ends = np.cumsum(count)
            within = np.arange(len(scan)) - np.repeat(ends - count, count)
            scans.append(scan)
            beams.append(scan * self.n + np.repeat(a, count) + within)
        return np.concatenate(scans), np.concatenate(beams)


def _within(reach: float, scans: _Scans, walls: Float) -> Int64:
    """Indices of walls within `reach` of the box around all sensors."""
    x, y = walls[:, ::2], walls[:, 1::2]
    near = (x.max(axis=1) >= scans.x.min() - reach) & (x.min(axis=1) <= scans.x.max() + reach)
    near &= (y.max(axis=1) >= scans.y.min() - reach) & (y.min(axis=1) <= scans.y.max() + reach)
    return np.flatnonzero(near)


def _lower_ranges(scans: _Scans, face: Float, ranges: Float) -> Int64:
    """Lower flat ranges to a face (4,), or (4, T) if it moves; returns the beams that changed."""
    x0, y0, x1, y1 = face
    bearing = np.arctan2(y0 - scans.y, x0 - scans.x)
    end = np.arctan2(y1 - scans.y, x1 - scans.x)
    turn = (end - bearing + np.pi) % (2 * np.pi) - np.pi
    scan, beam = scans.covered(np.where(turn >= 0, bearing, end), np.abs(turn))
    nx, ny = np.broadcast_to(y0 - y1, turn.shape), np.broadcast_to(x1 - x0, turn.shape)
    height = nx * (x0 - scans.x) + ny * (y0 - scans.y)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = height[scan] / (nx[scan] * scans.cos[beam] + ny[scan] * scans.sin[beam])
    return _keep_nearer(r, beam, ranges)


def _keep_nearer(r: Float, beam: Int64, ranges: Float) -> Int64:
    """Lower the flat ranges of beams to `r` where it is less; returns the beams that changed."""
    nearer = (r > MIN_RANGE) & (r < ranges[beam])
    ranges[beam[nearer]] = r[nearer]
    return np.asarray(beam[nearer])


def _cast_movers(scans: _Scans, movers: Movers, part: slice, ranges: Float, which: Int32) -> None:
    for q, (a, b) in enumerate(movers.semi_axes):
        dx = movers.xy[part, q, 0] - scans.x
        dy = movers.xy[part, q, 1] - scans.y
        half = np.arcsin(np.minimum(max(a, b) / np.maximum(np.hypot(dx, dy), 1e-6), 1.0))
        scan, beam = scans.covered(np.arctan2(dy, dx) - half, 2 * half)
        c, s = np.cos(movers.heading[part, q]), np.sin(movers.heading[part, q])
        # the ellipse as the unit circle: sensor at o, beam direction d
        ox, oy = ((-dx * c - dy * s) / a)[scan], ((dx * s - dy * c) / b)[scan]
        ux, uy = scans.cos[beam], scans.sin[beam]
        vx, vy = (ux * c[scan] + uy * s[scan]) / a, (uy * c[scan] - ux * s[scan]) / b
        A, B = vx**2 + vy**2, ox * vx + oy * vy
        rest = B**2 - A * (ox**2 + oy**2 - 1)
        r = np.where(rest >= 0, (-B - np.sqrt(np.maximum(rest, 0))) / A, np.inf)
        which[_keep_nearer(r, beam, ranges)] = movers.mover[q]


def find_glass(walls: Int32, scene: Scene) -> Bool:
    """Mask of the wall indices that are glass; indices of glass follow those of opaque walls."""
    first = len(scene.walls)
    return (walls >= first) & (walls < first + len(scene.glass))


def simulate_measurement(
    exact: Float, on_glass: Bool, o: LidarOptions | LaserOptions, rng: np.random.Generator
) -> tuple[Float, Bool]:
    """Measured ranges (T, n) and whether each is a hit (T, n).

    Args:
        exact: (T, n) exact ranges, metres; inf without a hit.
        on_glass: (T, n) whether a beam hits glass, on which more are lost.
        o: noise and losses. A beam without return gets o.max_range.
        rng: of noise and losses.
    """
    lost = rng.random(exact.shape)
    noisy = exact + o.range_noise * rng.standard_normal(exact.shape)
    hit = (noisy < o.max_range) & (lost >= o.no_return_share + on_glass * o.glass_no_return_share)
    return np.where(hit, np.maximum(noisy, MIN_RANGE), o.max_range), hit
