"""The map as map_server and nav2 load it, by their public rules."""

import numpy as np
import pytest
from map_server_rules import FREE, OCCUPIED, UNKNOWN, load

from stillmap.cli.main import main


@pytest.fixture(scope="module", params=["trinary", "scale", "raw"])
def mapped(request, recorded, result):
    """A mode, the loaded map, and the expected map."""
    mode, folder = request.param, result
    if mode != "trinary":
        folder = recorded.parent / mode
        words = ["map", recorded, "-o", folder, "--quiet", "--set", "em.max_iterations=1"]
        words += ["--poses", result / "trajectory.tum", "--map-mode", mode]
        assert main([*map(str, words)]) == 0
    with np.load(folder / "map.npz") as meant:
        return mode, load(folder / "map.yaml"), dict(meant)


def test_cell_values(mapped):
    mode, grid, meant = mapped
    p = meant["p_occupied"]
    assert grid.cells.shape == p.shape
    unknown = np.isnan(p)
    p = np.where(unknown, 0.5, p)
    assert min(unknown.sum(), (p > 0.65).sum(), (p < 0.196).sum()) > 100
    if mode == "raw":
        np.testing.assert_array_equal(grid.cells == UNKNOWN, unknown)
        assert np.abs(grid.cells - 100 * p)[~unknown].max() <= 0.501
        return
    np.testing.assert_array_equal(grid.cells == OCCUPIED, p > np.float32(0.65))
    between = ~unknown & (p <= np.float32(0.65)) & (p >= np.float32(0.196))
    if mode == "trinary":
        np.testing.assert_array_equal(grid.cells == UNKNOWN, unknown | between)
        np.testing.assert_array_equal(grid.cells == FREE, p < np.float32(0.196))
    else:
        np.testing.assert_array_equal(grid.cells == UNKNOWN, unknown)
        expected = 100 * (p - 0.196) / (0.65 - 0.196)
        step = 100 / 255 / (0.65 - 0.196)  # of a grey level
        assert np.abs(grid.cells - expected)[between].max(initial=0) <= step + 0.5


def test_origin_and_resolution(mapped):
    _, grid, meant = mapped
    assert grid.resolution == meant["resolution"]
    np.testing.assert_allclose(grid.origin, meant["origin"])
    rows, columns = np.nonzero(meant["p_occupied"] > 0.9)
    x0, y0, yaw = meant["origin"]
    assert yaw == 0
    for row, column in zip(rows[::50], columns[::50], strict=True):
        middle = (np.array([column, row]) + 0.5) * meant["resolution"]
        assert grid.at(x0 + middle[0], y0 + middle[1]) > 85


def test_trajectory_is_free(mapped, result):
    mode, grid, _ = mapped
    rows = np.loadtxt(result / "trajectory.tum")
    cells = [grid.at(x, y) for x, y in rows[:, 1:3]]
    assert np.mean(np.array(cells) <= (10 if mode == "raw" else FREE)) > 0.95
