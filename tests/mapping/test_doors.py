"""The area of a door from cells where its leaf was seen; of anything else the cells alone."""

import numpy as np
import pytest
from synthetic_histories import block

from stillmap.mapping.doors import _fit_two_lines, fit_sector

LENGTH = 18.0  # cells
HINGE = np.array([-7, 12])
LEAF = 1.0 / LENGTH  # metres of a cell, so that the leaf is one of a metre


def leaf(angle, length=LENGTH, hinge=HINGE, thick=2):
    """The cells of a line from the hinge, so many wide."""
    along = np.arange(0.0, length + 0.25, 0.25)[:, None]
    u = np.array([np.cos(angle), np.sin(angle)])
    aside = np.array([-u[1], u[0]])
    points = [hinge + along * u + k * aside for k in np.arange(thick) - (thick - 1) / 2]
    return np.unique(np.round(np.concatenate(points)).astype(np.int64), axis=0)


def door(first, swing, **line):
    return np.unique(np.concatenate([leaf(first, **line), leaf(first + swing, **line)]), axis=0)


def compute_swept_cells(cells, resolution):
    """The cells and, if they are a door, those that it sweeps."""
    sector = fit_sector(cells, resolution)
    if sector is None:
        return cells
    return np.unique(np.concatenate([cells, sector.swept_cells()]), axis=0)


def held(cells):
    return set(map(tuple, np.asarray(cells).tolist()))


def inside(first, swing, margin, length=LENGTH):
    """Cells well within the true sector, and those well outside of it."""
    around = block(*(HINGE - 40), 80, 80)
    x, y = (around - HINGE).T
    far, angle = np.hypot(x, y), np.arctan2(y, x)
    middle = first + swing / 2
    off = np.abs(np.angle(np.exp(1j * (angle - middle)))) - swing / 2
    aside = far * np.sin(np.minimum(off, np.pi / 2))
    within = (far <= length - margin) & (aside < -margin)
    without = (far > length + margin) | ((aside > margin) & (far > margin))
    return held(around[within]), held(around[without])


@pytest.mark.parametrize("swing", [60, 90, 120, 145])
@pytest.mark.parametrize("first", range(-180, 180, 40))
def test_a_door_sweeps_a_sector(first, swing):
    first, swing = np.radians([first, swing])
    cells = door(first, swing)
    got = held(compute_swept_cells(cells, LEAF))
    assert got >= held(cells)
    within, without = inside(first, swing, 2.0)
    assert len(within) > 50
    assert len(within - got) <= 0.03 * len(within)
    assert not without & got


def test_where_the_cells_lie_and_their_order_change_nothing():
    cells = door(0.3, 1.4)
    one = compute_swept_cells(cells, LEAF)
    far = np.array([1000, -3000])
    assert held(compute_swept_cells(cells[::-1] + far, LEAF)) == held(one + far)
    assert len(held(one)) == len(one)  # none twice


def test_a_leaf_that_is_seen_on_its_way_now_and_then_is_still_a_door():
    cells = np.concatenate([door(0.0, np.pi / 2), leaf(0.7)[::5]])
    within, _ = inside(0.0, np.pi / 2, 2.0)
    assert len(within - held(compute_swept_cells(cells, LEAF))) <= 0.03 * len(within)


@pytest.mark.parametrize("length", [10.0, 18.0, 40.0])
def test_a_leaf_is_as_long_as_those_of_doors(length):
    cells = door(0.0, np.pi / 2, length=length)
    assert _fit_two_lines(cells).length == pytest.approx(length, abs=1.0)

    def sweeps(metres):
        return len(compute_swept_cells(cells, metres / length)) > len(cells)

    assert [sweeps(metres) for metres in (0.3, 0.5, 1.8, 2.3)] == [False, True, True, False]


def test_both_directions_and_the_nearer_one_of_cells():
    sector = fit_sector(door(0.3, 1.4), LEAF)
    np.testing.assert_allclose(sorted(sector.directions), [0.3, 1.7], atol=0.1)
    first, second = np.argsort(sector.directions)
    far = LENGTH * 0.8
    points = HINGE + far * np.array([[np.cos(a), np.sin(a)] for a in (0.3, 1.7, 1.0)])
    cells = np.round(points).astype(np.int64)
    assert sector.nearer_ends(cells).tolist() == [first, second, -1]
