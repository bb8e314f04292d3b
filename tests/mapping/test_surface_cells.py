"""Lines through cells with surfaces."""

import numpy as np
import pytest

from stillmap.mapping.mirrors import iter_lines

RESOLUTION = 0.05


def test_a_wall_is_one_line():
    cells = np.stack([np.arange(60), np.full(60, 7)], axis=-1)
    ((normal, distance),) = iter_lines(cells, RESOLUTION)
    np.testing.assert_allclose(np.abs(normal), [0.0, 1.0], atol=1e-12)
    assert abs(distance) == pytest.approx(7.5 * RESOLUTION)


def test_the_last_bin_of_one_direction_is_no_neighbour_of_the_first_of_the_next():
    """A leaning wall most of whose cells lie in the first bin of a direction."""
    rows = {
        779: [48, *range(56, 60), 61, 64, 65, *range(67, 70), *range(158, 165), 166, 170, 172],
        780: range(199, 210),
        781: [172, 179, 182, *range(184, 187), 189, 190, 192, 196, *range(199, 210)],
    }
    cells = np.array([(x, y) for x, some in rows.items() for y in some])
    found = list(iter_lines(cells, RESOLUTION))
    assert found
    for normal, distance in found:
        near = np.abs((cells + 0.5) * RESOLUTION @ normal - distance) < 0.1
        assert near.sum() >= 10


def test_places_far_apart_have_the_same_lines():
    """The distances of lines are counted without the gaps between places."""
    wall = np.stack([np.arange(60), np.full(60, 7)], axis=-1)
    far = wall[:, ::-1] + np.array([3_000_000, -2_000_000])  # 100 km
    found = list(iter_lines(np.concatenate([wall, far]), RESOLUTION))
    for cells in (wall, far):
        ((normal, distance),) = iter_lines(cells, RESOLUTION)
        assert any(
            np.allclose(normal * np.sign(normal @ other), other)
            and abs(distance * np.sign(normal @ other) - at) < 1e-6
            for other, at in found
        )
