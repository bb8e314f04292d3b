"""The true surfaces of what moves in a simulated world, as points."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.simulation.solids import BOX, CYLINDER, Solids
from stillmap.simulation.surfaces import to_local, to_world

Float = NDArray[np.float64]

_FASTEST = 40.0  # m/s; what goes faster has begun its way again elsewhere
_INSIDE = 1e-6  # m, points less deep in another part are on the surface


class Moving(NamedTuple):
    """The parts of what moves, at T scans.

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
        """Some parts at n times; between two scans, and during the last one, they go on evenly."""
        at_ns, last = np.atleast_1d(np.asarray(stamp_ns, np.int64)), len(self.stamp_ns) - 1
        t = np.clip(np.searchsorted(self.stamp_ns, at_ns, side="right") - 1, 0, max(last - 1, 0))
        after = np.minimum(t + 1, last)
        span, since = self.stamp_ns[after] - self.stamp_ns[t], at_ns - self.stamp_ns[t]
        share = np.clip(since / np.where(span > 0, span, np.inf), 0.0, 2.0)[:, None, None]
        before = self.solids.pose[t[:, None], parts]
        change = self.solids.pose[after[:, None], parts] - before
        change[..., 2] = (change[..., 2] + np.pi) % (2 * np.pi) - np.pi
        way = np.hypot(change[..., 0], change[..., 1])
        goes_on = way < _FASTEST * 1e-9 * np.maximum(span, 1)[:, None]
        # who is somewhere else in the next scan was put there
        stays = np.where(share < 1.0, before, before + change)
        pose = np.where(goes_on[..., None], before + share * change, stays)
        return self.solids._replace(pose=self.solids.pose[:1]).some(parts)._replace(pose=pose)


def mover_points(
    moving: Moving, mover: int, stamp_ns: int, spacing: float
) -> tuple[Float, NDArray[np.intp]]:
    """Points on the surface of a mover at one time.

    What lies within another of its parts is no surface.

    Args:
        moving: what moves.
        mover: which.
        stamp_ns: when.
        spacing: metres from one point to the next, about.

    Returns:
        (n, 3) metres in the world, none where it is nowhere; (n,) which of `moving.parts(mover)`
        each is on.
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
    (a, b), (z0, z1) = solids.half[k] - _INSIDE, solids.z[k] + (_INSIDE, -_INSIDE)
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
    (a, b), (z0, z1) = solids.half[k], solids.z[k]
    h, middle = (z1 - z0) / 2, np.array([0.0, 0.0, (z0 + z1) / 2])
    if solids.form[k] == BOX:
        found = _box_samples(np.array([a, b, h]), spacing)
    elif solids.form[k] == CYLINDER:
        found = _cylinder_samples(np.array([a, b]), h, spacing)
    else:
        found = _ellipsoid_samples(np.array([a, b, h]), spacing)
    return np.asarray(found + middle)


def _cylinder_samples(half: Float, h: float, spacing: float) -> Float:
    around = _even(2 * np.pi * half.max(), spacing) * 2 * np.pi
    angle, up = np.meshgrid(around, _along(h, spacing))
    rim = [half[0] * np.cos(angle), half[1] * np.sin(angle), up]
    disc = np.stack(np.meshgrid(*(_along(one, spacing) for one in half)), axis=-1).reshape(-1, 2)
    disc = disc[((disc / half) ** 2).sum(axis=1) <= 1.0]
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
    """Middles of equal parts of -half to half."""
    return half * (2.0 * _even(2.0 * half, spacing) - 1.0)


def _even(length: float, spacing: float) -> Float:
    """Middles of equal parts of 0 to 1, each no longer than `spacing` of `length`."""
    n = max(1, int(np.ceil(length / spacing - 1e-9)))
    return np.asarray((np.arange(n) + 0.5) / n)
