"""Interpolation of end points between neighbouring beams on one flat surface."""

from math import ceil

import numpy as np

from reference.beam_counting import per_beam, usable_beams
from reference.ray_traversal import cell_of


def interpolate_end_points(
    grid, points, hit, e, offset, T_map_sensor, *, max_gap, tolerance, max_gap_ratio
):
    """Interpolate end points between neighbouring beams on one flat surface.

    Two neighbouring hits of one scan are on one surface if they are collinear with the hit before
    or after them. The fewest end points that leave no gap of more than a cell are added between
    them, with the smaller e of the two. They add nothing to crossed cells.

    Args:
        grid: changed in place.
        points: (M, 2) metres, sensor frame.
        hit: (M,) bool.
        e: (M,) expectation of c, used where end points are added.
        offset: (T+1,).
        T_map_sensor: (T, 3, 3).
        max_gap: metres, largest distance of two neighbours.
        tolerance: metres, largest distance of the third hit from their line.
        max_gap_ratio: largest ratio of the gap to that next to it.
    """
    for name, value in (
        ("max_gap", max_gap),
        ("tolerance", tolerance),
        ("max_gap_ratio", max_gap_ratio),
    ):
        if not value >= 0:
            raise ValueError(f"{name}: expected a number that is not negative, got {value}")
    expectation = per_beam(e, points)
    hits = [b for b in usable_beams(2, points, hit, offset, T_map_sensor) if b.hit]
    for a, b, others in _neighbours(hits):
        if any(_is_collinear(a, b, other, max_gap, tolerance, max_gap_ratio) for other in others):
            both = expectation[[a.number, b.number]]
            if not ((both >= 0) & (both <= 1)).all():
                raise ValueError(f"e: expected probabilities in [0, 1], got {both}")
            steps = ceil(float(np.linalg.norm(b.end - a.end)) / grid.resolution)
            for i in range(1, steps):
                end = a.end + (b.end - a.end) * (i / steps)
                cell = tuple(cell_of(end, grid.resolution).tolist())
                grid.add(cell, float(both.min()), 0.0, end)


def _neighbours(hits):
    """Pairs of adjacent hits in one scan, and the hits before and after them."""
    numbered = {(beam.scan, beam.number): beam for beam in hits}
    for (scan, n), a in numbered.items():
        b = numbered.get((scan, n + 1))
        if b is not None:
            around = numbered.get((scan, n - 1)), numbered.get((scan, n + 2))
            yield a, b, [other for other in around if other is not None]


def _is_collinear(a, b, other, max_gap, tolerance, max_gap_ratio):
    """Whether `other`, the nearer of a and b, and the farther one are collinear."""
    near, far = (a, b) if other.number < a.number else (b, a)
    before, step = near.end - other.end, far.end - near.end
    wide = float(np.linalg.norm(step))
    if not 0 < wide <= min(max_gap, max_gap_ratio * float(np.linalg.norm(before))):
        return False
    along = float(before @ step) / wide
    off = float(np.linalg.norm(before - along * step / wide))
    return along > 0 and off < tolerance
