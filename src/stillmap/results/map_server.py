"""`map.pgm` or `map.png` with `map.yaml`, as map_server and nav2 read them."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.tiles import Layer, rows_of
from stillmap.pipeline.options import MapMode
from stillmap.results.reader import FREE_THRESH, OCCUPIED_THRESH

if TYPE_CHECKING:
    from stillmap.em import OccupancyMap

ToPixels = Callable[[NDArray[np.float32]], NDArray[np.uint8]]

_OCCUPIED, _UNKNOWN, _FREE = 0, 205, 254

# the darkest pixels that map_server reads as in between and as free: (255 - pixel) / 255 against
# the thresholds
_IN_BETWEEN_FROM, _FREE_FROM = 90, 206


def trinary_pixels(p_occupied: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W) uint8: 0 where p > 0.65, 254 where p < 0.196, 205 between and where p is NaN."""
    pixels = np.full(p_occupied.shape, _UNKNOWN, np.uint8)
    pixels[p_occupied > OCCUPIED_THRESH] = _OCCUPIED
    pixels[p_occupied < FREE_THRESH] = _FREE
    return pixels


def scale_pixels(p_occupied: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 2) uint8 grey and alpha: grey 255 (1 - p), transparent where p is NaN.

    Rounding to a grey level never moves a cell across a threshold, so that a reader finds the
    same cells occupied and free as in trinary mode.
    """
    known = ~np.isnan(p_occupied)
    grey = np.rint(255 * (1 - np.where(known, p_occupied, np.float32(0.5))))
    free, occupied = p_occupied < FREE_THRESH, p_occupied > OCCUPIED_THRESH
    low = np.where(free, _FREE_FROM, np.where(occupied, 0, _IN_BETWEEN_FROM))
    high = np.where(free, 255, np.where(occupied, _IN_BETWEEN_FROM - 1, _FREE_FROM - 1))
    alpha = np.where(known, 255, 0)
    return np.stack([np.clip(grey, low, high), alpha], axis=-1).astype(np.uint8)


def raw_pixels(p_occupied: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W) uint8: occupancy in percent, 255 where p is NaN."""
    known = ~np.isnan(p_occupied)
    return np.where(known, np.rint(100 * np.where(known, p_occupied, 0)), 255).astype(np.uint8)


def write_map_server(folder: Path, occupancy: "OccupancyMap", mode: MapMode = "trinary") -> None:
    """Write `map.pgm` (`map.png` in scale mode) and `map.yaml` into `folder`.

    The picture's top row is the map's highest y; the origin is the lower-left pixel's pose.
    """
    name = "map.png" if mode == "scale" else "map.pgm"
    p_occupied: Layer = occupancy.p_occupied
    if not p_occupied.size:
        p_occupied = np.full((1, 1), np.nan, np.float32)  # readers refuse a picture without pixels
    if mode == "scale":
        Image.fromarray(scale_pixels(np.asarray(p_occupied)[::-1])).save(folder / name)
    else:
        _write_pgm(folder / name, p_occupied, trinary_pixels if mode == "trinary" else raw_pixels)
    described = {
        "image": name,
        "mode": mode,
        "resolution": float(occupancy.resolution),
        # a multiple of the cell's edge is written as one
        "origin": [round(float(value), 9) for value in occupancy.origin],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESH,
        "free_thresh": FREE_THRESH,
    }
    text = yaml.safe_dump(described, sort_keys=False, default_flow_style=None)
    (folder / "map.yaml").write_text(text, encoding="utf-8")


def _write_pgm(path: Path, p_occupied: Layer, to_pixels: ToPixels) -> None:
    """Write a picture strip by strip: the map's row 0 is its lowest y, the picture's its top."""
    height, width = p_occupied.shape
    with path.open("wb") as file:
        file.write(b"P5\n%d %d\n255\n" % (width, height))
        end = file.tell() + height * width
        for rows in rows_of(p_occupied):  # from the bottom up
            end -= rows.size
            file.seek(end)
            file.write(to_pixels(rows[::-1]).tobytes())
