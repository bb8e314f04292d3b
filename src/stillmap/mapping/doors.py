"""The area that a door takes."""

import math

import numpy as np
from numpy.typing import NDArray

Cells = NDArray[np.int64]
Float = NDArray[np.float64]

_BESIDE = 2.0  # cells beside an end of its way at which a leaf may be seen
_LEAF = 0.8  # share of the cells that must lie at the ends of its way
_HINGES = 400  # cells at most that are tried
_SHORTEST, _LONGEST = 0.4, 2.0  # m, of leaves
_NARROW, _WIDE = math.radians(20.0), math.radians(200.0)  # how far doors swing
_FROM_HINGE = 0.5  # of the leaf: nearer to the hinge, directions say little


def compute_swept_cells(cells: Cells, resolution: float) -> Cells:
    """(S, 2) these cells (K, 2) and, if a door is seen there open and shut, all that it sweeps."""
    sector = _sector(cells)
    if sector is None or not _SHORTEST <= sector.length * resolution <= _LONGEST:
        return cells
    reach = math.ceil(sector.length)
    square = np.arange(-reach, reach + 1)
    around = sector.hinge + np.stack(np.meshgrid(square, square), axis=-1).reshape(-1, 2)
    return np.unique(np.concatenate([cells, around[sector.holds(around)]]), axis=0)


class _Sector:
    """Where a leaf of a length, in cells, swings about a hinge from one direction to another."""

    def __init__(self, hinge: Cells, cells: Cells) -> None:
        self.hinge = hinge
        distance, angle = self._polar(cells)
        self.length = float(distance.max())
        far = distance > _FROM_HINGE * self.length
        # directions seen from the middle one, so that none jumps by a whole turn
        at = angle[far]
        self._middle = float(np.angle(np.mean(np.exp(1j * at))))
        turned = np.angle(np.exp(1j * (at - self._middle)))
        half = 0.5 * (turned.min() + turned.max())
        self._low = float(np.median(turned[turned <= half]))
        self._high = float(np.median(turned[turned >= half]))

    @property
    def angle(self) -> float:
        """Radians, by which the leaf swings."""
        return self._high - self._low

    def _polar(self, cells: Cells) -> tuple[Float, Float]:
        x, y = (cells - self.hinge).T
        return np.hypot(x, y), np.arctan2(y, x)

    def _turned(self, cells: Cells) -> tuple[Float, Float]:
        distance, angle = self._polar(cells)
        return distance, np.asarray(np.angle(np.exp(1j * (angle - self._middle))))

    def holds(self, cells: Cells) -> NDArray[np.bool_]:
        """(N,) whether the leaf sweeps over cells (N, 2)."""
        distance, turned = self._turned(cells)
        between = (turned >= self._low) & (turned <= self._high)
        return np.asarray((distance <= self.length) & between)

    def at_its_ends(self, cells: Cells) -> float:
        """Share of cells that lie along the leaf where it begins to swing, or stops."""
        distance, turned = self._turned(cells)
        aside = np.minimum(np.abs(turned - self._low), np.abs(turned - self._high))
        return float(np.mean(distance * np.sin(np.minimum(aside, math.pi / 2)) <= _BESIDE))

    def fills_both(self, cells: Cells) -> bool:
        """Whether the leaf was seen at both ends, each along most of its length."""
        distance, turned = self._turned(cells)
        for end in (self._low, self._high):
            along = distance[distance * np.abs(np.sin(turned - end)) <= _BESIDE]
            if len(np.unique(np.round(along))) < 0.5 * self.length:
                return False
        return True


def _sector(cells: Cells) -> _Sector | None:
    """The door, if it is one: cells along two lines from one of them, the hinge."""
    if _breadth(cells) <= 2.0 * _BESIDE + 1.0:
        return None  # straight: two leaves that point away from each other would look alike
    best, most = None, (_LEAF, -math.inf)
    for hinge in cells[:: math.ceil(len(cells) / _HINGES)]:
        sector = _Sector(hinge, cells)
        # beside the hinge of a door that swings far, others explain as much with longer leaves
        now = (sector.at_its_ends(cells), -sector.length)
        if _NARROW < sector.angle < _WIDE and now > most and sector.fills_both(cells):
            best, most = sector, now
    return best


def _breadth(cells: Cells) -> float:
    """Cells, across the direction in which they spread most."""
    x, y = (cells - cells.mean(axis=0)).T
    along = 0.5 * math.atan2(2.0 * float(np.sum(x * y)), float(np.sum(x * x - y * y)))
    return float(np.ptp(y * math.cos(along) - x * math.sin(along)))
