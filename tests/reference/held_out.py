"""The density of held-out ranges given the labels of the other beams."""

from functools import partial
from math import erfc, exp, inf, log, log1p, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.beams import Beam, usable_beams
from reference.grid import Cell, Grid
from reference.traverse import cell_of, traverse

Float = NDArray[np.float64]


class StaticShares:
    """Mean e of the beams that ended in each cell; rates at which beams end.

    Args:
        resolution: edge of a cell, metres.
        dimension: 2 or 3.
    """

    def __init__(self, resolution: float, dimension: int) -> None:
        self.cells = Grid(resolution, dimension)  # alpha: sum of e, beta: sum of 1 - e
        self.length = 0.0

    @property
    def resolution(self) -> float:
        return self.cells.resolution

    @property
    def end_rate(self) -> float:
        """Ends of beams per metre, one end at one metre added."""
        hits = sum(self.cells.alpha.values()) + sum(self.cells.beta.values())
        return (hits + 1.0) / (self.length + 1.0)

    @property
    def dynamic_rate(self) -> float:
        """Ends at what moves, per metre, one end at one metre added."""
        return (sum(self.cells.beta.values()) + 1.0) / (self.length + 1.0)

    def share(self, cell: Cell) -> float:
        """Mean e of the hits in a cell, 0 where there are none."""
        m = self.cells.occupancy_of(cell)
        return 0.0 if np.isnan(m) else m

    def add(
        self,
        points: ArrayLike,
        hit: ArrayLike,
        e: ArrayLike,
        offset: ArrayLike,
        T_map_sensor: ArrayLike,
        held: ArrayLike,
    ) -> None:
        """Add the beams of the scans that are not held (T,)."""
        expectation, left_out = np.asarray(e, float), np.asarray(held, bool)
        for beam in usable_beams(self.cells.dimension, points, hit, offset, T_map_sensor):
            if left_out[beam.scan]:
                continue
            self.length += float(np.linalg.norm(beam.end - beam.start))
            if beam.hit:
                static = float(expectation[beam.number])
                cell = tuple(cell_of(beam.end, self.resolution).tolist())
                self.cells.add(cell, static, 1.0 - static)


StaticShares2D = partial(StaticShares, dimension=2)
StaticShares3D = partial(StaticShares, dimension=3)


def held_out(
    shares: StaticShares,
    points: ArrayLike,
    hit: ArrayLike,
    offset: ArrayLike,
    T_map_sensor: ArrayLike,
    held: ArrayLike,
    *,
    stopping: float,
    noise: float,
    late: float,
    delay: float,
    outliers: float,
    threads: int = 1,  # noqa: ARG001  the core's signature
) -> Float:
    """Sums per scan of ln p(z) - ln q(z) over its beams, and how many they are.

    Args:
        shares: of the scans that are not held.
        points: (M, D) metres, sensor frame.
        hit: (M,) bool.
        offset: (T+1,).
        T_map_sensor: (T, D+1, D+1).
        held: (T,) bool; the others' sums are zero.
        stopping: per metre, what is surely static.
        noise: metres, standard deviation of measured ranges.
        late: share of beams that end behind what they met.
        delay: metres behind it, on average.
        outliers: share of p that is q.
        threads: not used here.

    Returns:
        (T, 2): nats, beams.
    """
    out = np.zeros((len(np.asarray(held)), 2))
    q = shares.end_rate
    for beam in usable_beams(shares.cells.dimension, points, hit, offset, T_map_sensor):
        z = float(np.linalg.norm(beam.end - beam.start))
        if not np.asarray(held)[beam.scan] or z == 0.0:
            continue
        log_p = _log_density(shares, beam, z, stopping, noise, late, delay)
        log_q = (log(q) if beam.hit else 0.0) - q * z
        gain = np.logaddexp(log1p(-outliers) + log_p - log_q, log(outliers))
        out[beam.scan] += float(gain), 1.0
    return out


def _log_density(
    shares: StaticShares,
    beam: Beam,
    z: float,
    stopping: float,
    noise: float,
    late: float,
    delay: float,
) -> float:
    """ln of the density of a hit at z, or of the probability that nothing stops the beam."""
    behind = beam.end + (beam.end - beam.start) * (5.0 * noise / z if beam.hit else 0.0)
    cells, lengths = traverse(beam.start, behind, shares.resolution)
    moves = shares.dynamic_rate
    density, hazard, r = 0.0, 0.0, 0.0
    for cell, length in zip(cells, lengths * shares.resolution, strict=True):
        if length <= 0.0:
            continue
        still = stopping * shares.share(tuple(cell.tolist()))
        stops = exp(-hazard) * (1.0 - exp(-(still + moves) * length)) * still / (still + moves)
        # where in the cell it stops is as good as evenly spread
        noisy = _normal((r + length - z) / noise) - _normal((r - z) / noise)
        delayed = _exponential((z - r) / delay) - _exponential((z - r - length) / delay)
        density += stops / length * ((1.0 - late) * noisy + late * delayed)
        if r <= z < r + length:
            density += moves * exp(-hazard - (still + moves) * (z - r))
        hazard += (still + moves) * length
        r += length
    if not beam.hit:
        return -hazard
    return log(density) if density > 0.0 else -inf


def _normal(x: float) -> float:
    return 0.5 * erfc(-x / sqrt(2.0))


def _exponential(x: float) -> float:
    return 1.0 - exp(-x) if x > 0.0 else 0.0
