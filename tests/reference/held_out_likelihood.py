"""The density of held-out ranges given the labels of the other beams."""

# ruff: noqa: ARG001  (threads: as the kernels have it)

from functools import partial
from math import erfc, exp, inf, log, log1p, sqrt

import numpy as np

from reference.beam_counting import usable_beams
from reference.occupancy_grid import OccupancyGrid
from reference.ray_traversal import cell_of, traverse


class StaticFractionGrid:
    """Mean e of the returns in each cell, and the rates at which beams end.

    Args:
        resolution: edge of a cell, metres.
        dimension: 2 or 3.
    """

    def __init__(self, resolution, dimension):
        self.cells = OccupancyGrid(resolution, dimension)  # alpha: sum of e, beta: sum of 1 - e
        self.length = 0.0

    @property
    def resolution(self):
        return self.cells.resolution

    @property
    def end_rate(self):
        """Beam ends per metre, with one end in one metre added."""
        hits = sum(self.cells.alpha.values()) + sum(self.cells.beta.values())
        return (hits + 1.0) / (self.length + 1.0)

    @property
    def dynamic_rate(self):
        """Beam ends on moving objects per metre, with one end in one metre added."""
        return (sum(self.cells.beta.values()) + 1.0) / (self.length + 1.0)

    def share(self, cell):
        """Mean e of the hits in a cell, 0 where there are none."""
        m = self.cells.occupancy_of(cell)
        return 0.0 if np.isnan(m) else m

    def add(self, points, hit, e, offset, T_map_sensor, is_held_out):
        """Add the beams of the scans that are not held out (T,)."""
        expectation, held_out = np.asarray(e, float), np.asarray(is_held_out, bool)
        for beam in usable_beams(self.cells.dimension, points, hit, offset, T_map_sensor):
            if held_out[beam.scan]:
                continue
            self.length += float(np.linalg.norm(beam.end - beam.start))
            if beam.hit:
                static = float(expectation[beam.number])
                cell = tuple(cell_of(beam.end, self.resolution).tolist())
                self.cells.add(cell, static, 1.0 - static)


StaticFractionGrid2D = partial(StaticFractionGrid, dimension=2)
StaticFractionGrid3D = partial(StaticFractionGrid, dimension=3)


def score_held_out(
    fractions,
    points,
    hit,
    offset,
    T_map_sensor,
    is_held_out,
    *,
    stopping_rate,
    range_std,
    late_share,
    mean_delay,
    outlier_share,
    threads=1,
):
    """Sums per scan of ln p(z) - ln q(z) over its beams, and number of beams.

    Args:
        fractions: of the scans that are not held out.
        points: (M, D) metres, sensor frame.
        hit: (M,) bool.
        offset: (T+1,).
        T_map_sensor: (T, D+1, D+1).
        is_held_out: (T,) bool; the others' sums are zero.
        stopping_rate: ends per metre in static cells.
        range_std: metres, standard deviation of measured ranges.
        late_share: share of beams that end behind the surface.
        mean_delay: metres behind the surface, on average.
        outlier_share: share of q in p.
        threads: not used here.

    Returns:
        (T, 2): nats, beams.
    """
    out = np.zeros((len(np.asarray(is_held_out)), 2))
    q = fractions.end_rate
    for beam in usable_beams(fractions.cells.dimension, points, hit, offset, T_map_sensor):
        z = float(np.linalg.norm(beam.end - beam.start))
        if not np.asarray(is_held_out)[beam.scan] or z == 0.0:
            continue
        log_p = _log_density(fractions, beam, z, stopping_rate, range_std, late_share, mean_delay)
        log_q = (log(q) if beam.hit else 0.0) - q * z
        gain = np.logaddexp(log1p(-outlier_share) + log_p - log_q, log(outlier_share))
        out[beam.scan] += float(gain), 1.0
    return out


def _log_density(fractions, beam, z, stopping_rate, range_std, late_share, mean_delay):
    """Log density of a return at z, or log probability of no return."""
    behind = beam.end + (beam.end - beam.start) * (5.0 * range_std / z if beam.hit else 0.0)
    cells, lengths = traverse(beam.start, behind, fractions.resolution)
    moves = fractions.dynamic_rate
    density, hazard, r = 0.0, 0.0, 0.0
    for cell, length in zip(cells, lengths * fractions.resolution, strict=True):
        if length <= 0.0:
            continue
        still = stopping_rate * fractions.share(tuple(cell.tolist()))
        stops = exp(-hazard) * (1.0 - exp(-(still + moves) * length)) * still / (still + moves)
        # uniform within the cell
        noisy = _normal((r + length - z) / range_std) - _normal((r - z) / range_std)
        delayed = _exponential((z - r) / mean_delay) - _exponential((z - r - length) / mean_delay)
        density += stops / length * ((1.0 - late_share) * noisy + late_share * delayed)
        if r <= z < r + length:
            density += moves * exp(-hazard - (still + moves) * (z - r))
        hazard += (still + moves) * length
        r += length
    if not beam.hit:
        return -hazard
    return log(density) if density > 0.0 else -inf


def _normal(x):
    return 0.5 * erfc(-x / sqrt(2.0))


def _exponential(x):
    return 1.0 - exp(-x) if x > 0.0 else 0.0
