"""What must hold on any bare wall: along it nothing tells where a scan lies."""

from typing import Any

import numpy as np
import pytest

from stillmap import _core

SHIFTS = np.linspace(-0.4, 0.4, 17)  # metres, further than beams are apart on the wall


def one_scan(distance: float, slant: float, noise: float, seed: int) -> Any:
    """End points (N, 2) float32 on one wall.

    The wall is `distance` metres away and its direction `slant` radians off the x axis. A beam
    each degree leaves gaps of 5 cm and more; where they would come near a metre the wall ends.
    """
    bearings = np.arange(0.0, np.pi, np.radians(1.0))
    across = np.sin(bearings - slant)
    bearings = bearings[across > np.sqrt(np.radians(1.0) * distance / 0.9)]
    ranges = distance / np.sin(bearings - slant)
    ranges += noise * np.random.default_rng(seed).standard_normal(len(ranges))
    points = ranges[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    return points.astype(np.float32)


def costs_along(points: Any, slant: float, T: Any, is_filled: bool) -> Any:
    """Nats per beam that a scan costs when it is laid on itself, shifted along the wall."""
    n = len(points)
    grid = _core.OccupancyGrid2D(0.05, 0.5)
    ones, hit, offset = np.ones(n, np.float32), np.ones(n, bool), np.array([0, n])
    _core.add_beams(grid, points, hit, ones, offset, T[None])
    if is_filled:
        _core.interpolate_end_points(
            grid, points, hit, ones, offset, T[None], max_gap=1.5, tolerance=0.1, max_gap_ratio=3.0
        )
    # shifted, all of them still lie beside others
    inner = np.ascontiguousarray(points[2:-2])
    out = []
    for shift in SHIFTS:
        moved = T.copy()
        moved[:2, 2] += T[:2, :2] @ (shift * np.array([np.cos(slant), np.sin(slant)]))
        cost = _core.registration_cost(
            grid, inner, ones[2:-2], moved, sigma=0.04, radius=2, floor=0.05, unknown=0.05
        )
        out.append(cost / len(inner))
    return np.array(out)


@pytest.mark.parametrize("number", range(40))
def test_a_bare_wall_does_not_say_where_along_it(number):
    """Forty walls by chance; in the plane about one in some hundred is a little beyond a bound."""
    rng = np.random.default_rng(number)
    distance, slant, heading = rng.uniform([3.0, -0.6, -3.1], [8.0, 0.6, 3.1])
    T = np.eye(3)
    T[0, :2], T[1, :2] = (np.cos(heading), -np.sin(heading)), (np.sin(heading), np.cos(heading))
    T[:2, 2] = rng.uniform(-5.0, 5.0, 2)
    points = one_scan(distance, slant, rng.choice([0.0, 0.005, 0.01]), number)
    bare, filled = (costs_along(points, slant, T, is_filled) for is_filled in (False, True))
    # a scan of 150 beams, each counting a fifth: below 2 nats after filling, 4 and more before
    assert np.ptp(filled) < 0.06
    assert np.ptp(bare) > 0.13
    assert np.ptp(bare) > 5 * np.ptp(filled)
