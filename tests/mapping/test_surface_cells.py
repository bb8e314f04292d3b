"""Lines through cells with surfaces."""

import numpy as np
import pytest

from stillmap.mapping import surface_cells
from stillmap.mapping.surface_cells import iter_lines

RESOLUTION = 0.05


def test_a_wall_is_one_line():
    cells = np.stack([np.arange(60), np.full(60, 7)], axis=-1)
    ((normal, distance),) = iter_lines(cells, RESOLUTION)
    np.testing.assert_allclose(np.abs(normal), [0.0, 1.0], atol=1e-12)
    assert abs(distance) == pytest.approx(7.5 * RESOLUTION)


def test_short_pieces_at_the_edge_are_lines_of_their_own_direction(monkeypatch):
    """The last bin of one direction is no neighbour of the first bin of the next."""
    monkeypatch.setattr(surface_cells, "_MIN_LINE", 0.0)
    monkeypatch.setattr(surface_cells, "_MIN_LINE_CELLS", 2)
    for seed in range(20):
        cells = np.random.default_rng(seed).integers(-40, 40, (60, 2))
        cells = np.unique(cells, axis=0)
        for normal, distance in iter_lines(cells, RESOLUTION):
            assert np.linalg.norm(normal) == pytest.approx(1.0)
            assert abs(distance) < 40 * np.sqrt(2.0) * RESOLUTION
