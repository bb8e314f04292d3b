"""Loading of maps as map_server and nav2 do it, by their public rules.

The rules are those of http://wiki.ros.org/map_server (image format, value interpretation) and of
nav2_map_server's README, with the modes trinary, scale and raw. Nothing here is shared with the
writer.
"""

import dataclasses

import numpy as np
import yaml
from PIL import Image

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
