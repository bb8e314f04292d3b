"""The sums of (10), the E-step (6), (8), and the log likelihoods (4), (5), (7)."""

# ruff: noqa: ARG001  (threads: as the kernels have it)

from dataclasses import dataclass
from math import isfinite, isnan, log

import numpy as np
from numpy.typing import NDArray

from reference.ray_traversal import cell_of, traverse

Float = NDArray[np.float64]

PROBABILITY_FLOOR = 1e-12  # m and 1 - m are floored here inside logarithms, in both kernels


@dataclass(frozen=True)
class Beam:
    """One usable beam in the map frame."""

    scan: int
    number: int
    hit: bool
    start: Float  # (D,) metres, map frame
    end: Float


def usable_beams(dimension, points, hit, offset, T_map_sensor):
    """The beams whose points are finite, in order, with both ends in the map frame."""
    z, struck = np.asarray(points, float), np.asarray(hit, bool)
    bounds, T = np.asarray(offset, np.int64), np.asarray(T_map_sensor, float)
    D = dimension
    for name, shape, expected in (
        ("points", z.shape, (len(z), D)),
        ("hit", struck.shape, (len(z),)),
        ("T_map_sensor", T.shape, (len(bounds) - 1, D + 1, D + 1)),
    ):
        if shape != expected:
            raise ValueError(f"{name}: expected shape {expected}, got {shape}")
    if bounds[0] != 0 or bounds[-1] != len(z) or (np.diff(bounds) < 0).any():
        raise ValueError(f"offset: must rise from 0 to {len(z)}, the number of points")
    for t in range(len(T)):
        R, origin = T[t, :D, :D], T[t, :D, D]
        for n in range(bounds[t], bounds[t + 1]):
            if np.isfinite(z[n]).all():
                yield Beam(t, n, bool(struck[n]), origin, R @ z[n] + origin)


def passed_cells(grid, beam):
    """Cells before the end cell with their l_j."""
    cells, lengths = traverse(beam.start, beam.end, grid.resolution)
    for cell, length in zip(cells[:-1], lengths[:-1], strict=True):
        yield tuple(cell.tolist()), float(length)


def _end_cell(grid, beam):
    return tuple(cell_of(beam.end, grid.resolution).tolist())


def _checked_prior(prior):
    if not 0 <= prior <= 1:
        raise ValueError(f"prior: expected a probability in [0, 1], got {prior}")
    return prior


def per_beam(e, points):
    values = np.asarray(e, float)
    if values.shape != (len(np.asarray(points)),):
        raise ValueError(f"e: expected one value for each of points, got shape {values.shape}")
    return values


def add_beams(grid, points, hit, e, offset, T_map_sensor, threads=1):
    """Add the sums alpha_j and beta_j below (10) of these beams to `grid`.

    The cells before the end cell get the chord length l_j as beta, whatever e is. The end cell of
    a hit gets e as alpha and 1 - e as beta, and not the chord inside it; the end cell of a
    maximum-range beam gets nothing.

    Args:
        grid: changed in place.
        points: (M, D) metres, sensor frame.
        hit: (M,) bool.
        e: (M,) expectation of c, used for hits only.
        offset: (T+1,).
        T_map_sensor: (T, D+1, D+1).
        threads: not used here.
    """
    for beam in usable_beams(grid.dimension, points, hit, offset, T_map_sensor):
        for cell, length in passed_cells(grid, beam):
            grid.add(cell, 0.0, length)
    add_end_points(grid, points, hit, e, offset, T_map_sensor)


def add_end_points(grid, points, hit, e, offset, T_map_sensor, *, remove=False):
    """Add or remove the sums of the end cells, the part of `add_beams` that depends on e.

    Args: see `add_beams`.
    """
    expectation, sign = per_beam(e, points), -1.0 if remove else 1.0
    for beam in usable_beams(grid.dimension, points, hit, offset, T_map_sensor):
        if beam.hit:
            static = float(expectation[beam.number])
            if not 0 <= static <= 1:
                raise ValueError(f"e: expected probabilities in [0, 1], got {static}")
            end = _end_cell(grid, beam)
            grid.add(end, sign * static, sign * (1.0 - static), beam.end)


def e_step(grid, points, hit, offset, T_map_sensor, prior, threads=1):
    """Equations (6), (8): (M,) the expectation e of c for each beam, given the map.

    p m / (p m + (1 - p)(1 - m)) with m of the end cell. The prior p is kept for maximum-range
    beams, hits in an unobserved cell, and 0 / 0 (p = 1 at m = 0, p = 0 at m = 1). Unusable beams
    are NaN.
    """
    p = _checked_prior(prior)
    e = np.full(len(np.asarray(points)), np.nan)
    for beam in usable_beams(grid.dimension, points, hit, offset, T_map_sensor):
        m = grid.occupancy_of(_end_cell(grid, beam)) if beam.hit else float("nan")
        evidence = p * m + (1 - p) * (1 - m)
        e[beam.number] = p * m / evidence if evidence > 0 else p
    return e.astype(np.float32)


def log_likelihood(grid, points, hit, e, offset, T_map_sensor, prior, threads=1):
    """The terms of the expected log likelihood (5) per scan, in nats.

    Inside logarithms m and 1 - m are floored at 1e-12, so that the cost of a beam that contradicts
    the map is finite. 0 ln 0 = 0. Unobserved cells contribute nothing.

    Returns:
        (T, 4): [0] end points, sum of (1 - zeta)(e ln m + (1 - e) ln(1 - m)); [1] cells before
        the end cell, sum of l_j ln(1 - m_j); [2] gamma of (7), sum of e ln p + (1 - e) ln(1 - p);
        [3] entropy of e. With e in {0, 1}, [0] + [1] + [2] is (4); [0] + ... + [3] is the bound
        that EM increases.
    """
    p = _checked_prior(prior)
    expectation = per_beam(e, points)
    terms = np.zeros((len(np.asarray(offset)) - 1, 4))
    for beam in usable_beams(grid.dimension, points, hit, offset, T_map_sensor):
        static = float(expectation[beam.number])
        m_end = grid.occupancy_of(_end_cell(grid, beam))
        end = _expected_log(static, m_end) if beam.hit and isfinite(m_end) else 0.0
        passed = 0.0
        for cell, length in passed_cells(grid, beam):
            m = grid.occupancy_of(cell)
            passed += 0.0 if isnan(m) else length * log(max(1.0 - m, PROBABILITY_FLOOR))
        entropy = -sum(x * log(x) for x in (static, 1.0 - static) if x > 0)
        terms[beam.scan] += end, passed, _expected_log(static, p), entropy
    return terms


def _expected_log(e, m):
    """e ln m + (1 - e) ln(1 - m) with 0 ln 0 = 0."""
    weighted = ((e, m), (1.0 - e, 1.0 - m))
    return sum(w * log(max(x, PROBABILITY_FLOOR)) for w, x in weighted if w > 0)
