"""The map as map_server and nav2 load it, by their public rules.

The rules are those of http://wiki.ros.org/map_server (image format, value interpretation) and of
nav2_map_server's README, with the modes trinary, scale and raw. Nothing here is shared with the
writer.
"""

import dataclasses

import numpy as np
import pytest
import yaml
from PIL import Image

from stillmap.cli.main import main

OCCUPIED, FREE, UNKNOWN = 100, 0, -1


@dataclasses.dataclass
class Loaded:
    """An OccupancyGrid: cells (H, W), row 0 at the lowest y."""

    cells: np.ndarray
    resolution: float
    origin: tuple[float, float, float]

    def at(self, x, y):
        """The cell at a place in the map frame."""
        x0, y0, yaw = self.origin
        dx, dy = x - x0, y - y0
        along, up = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
        return self.cells[int(up // self.resolution), int(along // self.resolution)]


def load(path):
    """A map from its YAML file."""
    described = yaml.safe_load(path.read_text())
    image = Image.open(path.parent / described["image"])
    has_alpha = image.mode in ("LA", "RGBA", "PA")
    channels = np.asarray(image.convert("RGBA")).astype(float)
    grey, alpha = channels[..., :3].mean(axis=-1), channels[..., 3]
    mode = described.get("mode", "trinary")
    high, low = described["occupied_thresh"], described["free_thresh"]
    assert 0 <= low < high <= 1
    # the lightness of a pixel says how free it is, the darkness if negated
    occupancy = grey / 255.0 if described["negate"] else (255.0 - grey) / 255.0
    cells = np.full(grey.shape, UNKNOWN)
    if mode == "raw":
        whole = np.rint(grey)
        cells[whole <= 100] = whole[whole <= 100]
    else:
        if mode == "scale":
            between = np.rint(100.0 * (occupancy - low) / (high - low))
            cells = between.astype(int)
        cells[occupancy > high] = OCCUPIED
        cells[occupancy < low] = FREE
        if mode == "scale" and has_alpha:
            cells[alpha < 255] = UNKNOWN
    # an image begins at its top, a grid at its lower-left corner
    return Loaded(cells[::-1], described["resolution"], tuple(described["origin"]))


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
