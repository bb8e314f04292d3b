"""Doors: the sector that a leaf sweeps, fitted to the cells where it was observed."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Cells, Float, Index
from stillmap.core.short_repr import ShortRepr
from stillmap.em.options import MapState

_TOLERANCE = 2.0  # cells between the leaf and a cell on it
_MAX_WIDTH, _MIN_ELONGATION = 2.0 * _TOLERANCE + 1.0, 3.0  # of a straight row: cells; of its width
_MIN_INLIERS = 0.8  # share of the cells on the leaf in its end positions
_MAX_HINGES = 400  # candidates that are tried
_MIN_LENGTH, _MAX_LENGTH = 0.4, 2.0  # m, of leaves
_MIN_ANGLE, _MAX_ANGLE = math.radians(20.0), math.radians(200.0)  # of the swing
_NEAR_HINGE = 0.5  # of the leaf: cells nearer to the hinge have uncertain directions


class Sector:
    """A leaf of `length` cells that swings about a hinge between two end directions."""

    def __init__(self, hinge: Cells, cells: Cells) -> None:
        self.hinge = hinge
        distance, angle = self._polar(cells)
        self.length = float(distance.max())
        far = distance > _NEAR_HINGE * self.length
        # relative to the mean direction, so that none wraps around
        at = angle[far]
        self._mean = float(np.angle(np.mean(np.exp(1j * at))))
        turned = np.angle(np.exp(1j * (at - self._mean)))
        half = 0.5 * (turned.min() + turned.max())
        self._low = float(np.median(turned[turned <= half]))
        self._high = float(np.median(turned[turned >= half]))

    @property
    def angle(self) -> float:
        """Radians of the swing."""
        return self._high - self._low

    @property
    def directions(self) -> tuple[float, float]:
        """Radians of the leaf from the hinge in both end positions."""
        return self._mean + self._low, self._mean + self._high

    def swept_cells(self) -> Cells:
        """(S, 2) cells that the leaf sweeps over."""
        radius = math.ceil(self.length)
        square = np.arange(-radius, radius + 1)
        around = self.hinge + np.stack(np.meshgrid(square, square), axis=-1).reshape(-1, 2)
        return np.asarray(around[self.contains(around)])

    def nearer_ends(self, cells: Cells) -> Index:
        """(N,) end position, 0 or 1, nearer to each of cells (N, 2); -1: farther than the leaf."""
        distance, turned = self._relative_polar(cells)
        off = np.abs(turned[:, None] - [self._low, self._high])
        aside = distance[:, None] * np.sin(np.minimum(off, math.pi / 2))
        on_leaf = (aside.min(axis=1) <= _TOLERANCE) & (distance <= self.length + _TOLERANCE)
        return np.where(on_leaf, aside.argmin(axis=1), -1)

    def _polar(self, cells: Cells) -> tuple[Float, Float]:
        x, y = (cells - self.hinge).T
        return np.hypot(x, y), np.arctan2(y, x)

    def _relative_polar(self, cells: Cells) -> tuple[Float, Float]:
        distance, angle = self._polar(cells)
        return distance, np.asarray(np.angle(np.exp(1j * (angle - self._mean))))

    def contains(self, cells: Cells) -> Bool:
        """(N,) whether the leaf sweeps over cells (N, 2)."""
        distance, turned = self._relative_polar(cells)
        between = (turned >= self._low) & (turned <= self._high)
        return np.asarray((distance <= self.length) & between)

    def inlier_share(self, cells: Cells) -> float:
        """Share of the cells that lie on the leaf in either end position."""
        distance, turned = self._relative_polar(cells)
        aside = np.minimum(np.abs(turned - self._low), np.abs(turned - self._high))
        return float(np.mean(distance * np.sin(np.minimum(aside, math.pi / 2)) <= _TOLERANCE))

    def covers_both_ends(self, cells: Cells) -> bool:
        """True if cells cover more than half of the leaf in both end positions."""
        distance, turned = self._relative_polar(cells)
        for end in (self._low, self._high):
            along = distance[distance * np.abs(np.sin(turned - end)) <= _TOLERANCE]
            if len(np.unique(np.round(along))) < 0.5 * self.length:
                return False
        return True


def fit_sector(cells: Cells, resolution: float) -> Sector | None:
    """The door, if it is one: cells (K, 2) along two lines from one of them, the hinge."""
    sector = _fit_two_lines(cells)
    if sector is None or not _MIN_LENGTH <= sector.length * resolution <= _MAX_LENGTH:
        return None
    return sector


def is_row(cells: Cells, resolution: float) -> bool:
    """True for a straight row of cells (K, 2) that is as long as a leaf may be."""
    if not len(cells):
        return False
    along, across = _extent(cells)
    is_thin = across <= _MAX_WIDTH and along >= _MIN_ELONGATION * across
    return is_thin and _MIN_LENGTH <= (along + 1.0) * resolution <= _MAX_LENGTH


def _fit_two_lines(cells: Cells) -> Sector | None:
    if _extent(cells)[1] <= _MAX_WIDTH:
        return None  # straight: two opposite leaves would look alike
    best, best_score = None, (_MIN_INLIERS, -math.inf)
    for hinge in cells[:: math.ceil(len(cells) / _MAX_HINGES)]:
        sector = Sector(hinge, cells)
        # cells beside the hinge of a wide swing fit as many cells with longer leaves
        score = (sector.inlier_share(cells), -sector.length)
        swings = _MIN_ANGLE < sector.angle < _MAX_ANGLE
        if swings and score > best_score and sector.covers_both_ends(cells):
            best, best_score = sector, score
    return best


def _extent(cells: Cells) -> tuple[float, float]:
    """Length in cells along the principal direction, and width across."""
    x, y = (cells - cells.mean(axis=0)).T
    along = 0.5 * math.atan2(2.0 * float(np.sum(x * y)), float(np.sum(x * x - y * y)))
    u, v = math.cos(along), math.sin(along)
    return float(np.ptp(x * u + y * v)), float(np.ptp(y * u - x * v))


Position = Literal["open", "shut"]


class DoorState(NamedTuple):
    """A time in which every observation saw the leaf in one position.

    Attributes:
        position: `open` or `shut`.
        since_ns, until_ns: stamps of the first and the last scan that saw it so.
    """

    position: Position
    since_ns: int
    until_ns: int


def measure_states(states: Iterable[DoorState]) -> dict[Position, int]:
    """Nanoseconds for which leaves were seen in either position."""
    out: dict[Position, int] = {"open": 0, "shut": 0}
    for state in states:
        out[state.position] += state.until_ns - state.since_ns
    return out


@dataclass(frozen=True, eq=False)
class Door(ShortRepr):
    """A leaf that swings about a hinge.

    Attributes:
        hinge: metres, in the map frame.
        length: metres, of the leaf.
        shut, opened: rad, directions from the hinge along the leaf. Shut is the one in which a wall
            goes on beyond the leaf. NaN: it was never seen open.
        shut_cells, open_cells: (K, 2) cells that changed, of the leaf in each position.
        swept_cells: (S, 2) all that it sweeps over.
        states: in the order of time; one of a door that was seen in one position only. Cells of a
            position in which its leaf was never seen are none.
        p_moved: probability that it is a door that moved during the recording; 1: it was seen to.
    """

    hinge: tuple[float, float]
    length: float
    shut: float
    opened: float
    shut_cells: Cells
    open_cells: Cells
    swept_cells: Cells
    states: tuple[DoorState, ...] = ()
    p_moved: float = 1.0

    def position_in(self, state: MapState) -> Position:
        """Position of the leaf in a map: the last one, or that of most of the time, or as asked."""
        if state in ("open", "shut"):
            return "open" if state == "open" else "shut"
        if state == "last" or len(self.states) == 1:
            return self.states[-1].position
        lasts = measure_states(self.states)
        return "open" if lasts["open"] >= lasts["shut"] else "shut"
