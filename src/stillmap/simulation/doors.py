"""Doors: leaves that swing open and shut by themselves, and for whoever wants to pass."""

import numpy as np
from numpy.typing import NDArray

from stillmap.simulation.options import DoorOptions
from stillmap.simulation.scene import Door

Float = NDArray[np.float64]

REACH = 3.0  # m before the doorway somebody's coming opens the door
_NEAR = 1.2  # m around the doorway's middle: no leaf closes while somebody is there


class Doors:
    """State of D doors.

    Attributes:
        share: (D,) how far each is open, from 0 to 1.
        width: (D,) metres.
    """

    def __init__(
        self, doors: tuple[Door, ...], options: DoorOptions, rng: np.random.Generator
    ) -> None:
        D = len(doors)
        self._options, self._rng = options, rng
        self._hinge = np.array([door.hinge for door in doors]).reshape(-1, 2)
        self.width = np.array([door.width for door in doors])
        self._closed = np.array([door.closed for door in doors])
        self._sweep = np.array([door.opened for door in doors]) - self._closed
        leaf = self.width[:, None] * _direction(self._closed)
        self._end, self._middle = self._hinge + leaf, self._hinge + leaf / 2
        self._opens = rng.random(D) < 0.5
        self.share = self._opens.astype(float)
        self._left = rng.random(D) * [self._lasts(opens) for opens in self._opens.tolist()]

    @property
    def angle(self) -> Float:
        """(D,) rad, direction from the hinge along the leaf."""
        return np.asarray(self._closed + self.share * self._sweep)

    def poses(self) -> Float:
        """(D, 3) the middle of each leaf in metres and its direction in radians."""
        middle = self._hinge + self.width[:, None] / 2 * _direction(self.angle)
        return np.column_stack([middle, self.angle])

    def faces(self) -> Float:
        """(D, 4) each leaf as a segment from its hinge."""
        end = self._hinge + self.width[:, None] * _direction(self.angle)
        return np.concatenate([self._hinge, end], axis=1)

    def step(self, dt: float, standing: Float, ways: Float) -> None:
        """The leaves go on for dt seconds.

        Args:
            dt: seconds.
            standing: (N, 2) where people and robot are, metres.
            ways: (K, 4) the legs of the ways that they want to go next, x0, y0, x1, y1.
        """
        delta = self._middle[:, None] - standing
        near = np.any(np.hypot(delta[..., 0], delta[..., 1]) < _NEAR, axis=1)
        passing = self._crossed_by(ways)
        self._left -= dt
        for door in np.flatnonzero(passing & ~self._opens).tolist():
            self._turn(door, opens=True)
        for door in np.flatnonzero((self._left <= 0) & ~passing & ~near).tolist():
            self._turn(door, opens=not self._opens[door])
        step = dt / self._options.swing
        change = np.where(self._opens, step, np.where(near, 0.0, -step))
        self.share = np.clip(self.share + change, 0.0, 1.0)

    def _turn(self, door: int, opens: bool) -> None:
        self._opens[door] = opens
        self._left[door] = self._lasts(opens)

    def _lasts(self, opens: bool) -> float:
        o = self._options
        low, high = (o.min_open, o.max_open) if opens else (o.min_closed, o.max_closed)
        return float(np.exp(self._rng.uniform(np.log(low), np.log(high))))

    def _crossed_by(self, ways: Float) -> NDArray[np.bool_]:
        """(D,) whether a leg of the ways (K, 4) goes through the doorway."""
        start, end = ways[:, None, :2], ways[:, None, 2:]
        aside = _turned(self._hinge, self._end, start) * _turned(self._hinge, self._end, end)
        through = _turned(start, end, self._hinge) * _turned(start, end, self._end)
        return np.asarray(np.any((aside < 0) & (through < 0), axis=0))


def legs(corners: Float) -> Float:
    """(N (K - 1), 4) the legs of N ways with K corners (N, K, 2)."""
    return np.concatenate([corners[:, :-1], corners[:, 1:]], axis=-1).reshape(-1, 4)


def _direction(angle: Float) -> Float:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _turned(a: Float, b: Float, c: Float) -> Float:
    """Positive where c lies to the left of the line from a to b."""
    along, across = b - a, c - a
    return np.asarray(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])
