"""The map: `map.npz`, and image and YAML file as map_server and nav2 read them; their masks."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float32
from stillmap.core.arrays import write_npz
from stillmap.core.grid_map import GridMap
from stillmap.core.tiles import Layer, TiledArray, compact, rows_of
from stillmap.em import Coverage, OccupancyMap
from stillmap.io.cameras import write_png
from stillmap.mapping import Change
from stillmap.pipeline.options import MapMode
from stillmap.results.reader import FREE_THRESH, OCCUPIED_THRESH

# what `changed` of `map.npz` says of a cell
CHANGED = {"came": 1, "left": 2, "comes and goes": 3, "door": 4}

ToPixels = Callable[[NDArray[Any]], NDArray[np.uint8]]

_OCCUPIED, _UNKNOWN, _FREE = 0, 205, 254

# the darkest pixels that map_server reads as in between and as free: (255 - pixel) / 255 against
# the thresholds
_IN_BETWEEN_FROM, _FREE_FROM = 90, 206


def trinary_pixels(p_occupied: Float32) -> NDArray[np.uint8]:
    """(H, W) uint8: 0 where p > 0.65, 254 where p < 0.196, 205 between and where p is NaN."""
    pixels = np.full(p_occupied.shape, _UNKNOWN, np.uint8)
    pixels[p_occupied > OCCUPIED_THRESH] = _OCCUPIED
    pixels[p_occupied < FREE_THRESH] = _FREE
    return pixels


def scale_pixels(p_occupied: Float32) -> NDArray[np.uint8]:
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


def raw_pixels(p_occupied: Float32) -> NDArray[np.uint8]:
    """(H, W) uint8: occupancy in percent, 255 where p is NaN."""
    known = ~np.isnan(p_occupied)
    return np.where(known, np.rint(100 * np.where(known, p_occupied, 0)), 255).astype(np.uint8)


def write_map_server(folder: Path, occupancy: GridMap, mode: MapMode = "trinary") -> None:
    """Write `map.pgm` (`map.png` in scale mode) and `map.yaml` into `folder`.

    The picture's top row is the map's highest y; the origin is the lower-left pixel's pose.
    """
    name = "map.png" if mode == "scale" else "map.pgm"
    p_occupied: Layer = occupancy.p_occupied
    if not p_occupied.size:
        p_occupied = np.full((1, 1), np.nan, np.float32)  # readers refuse a picture without pixels
    if mode == "scale":
        write_png(scale_pixels(np.asarray(p_occupied)[::-1]), folder / name, compress_level=6)
    else:
        _write_pgm(folder / name, p_occupied, trinary_pixels if mode == "trinary" else raw_pixels)
    _write_yaml(folder / "map.yaml", name, mode, occupancy)


def write_keepout_mask(folder: Path, keepout: Bool, occupancy: GridMap) -> None:
    """Write `keepout.pgm` and `keepout.yaml`, a mask for nav2's KeepoutFilter.

    A map server reads 100 where `keepout` (H, W) is true. Elsewhere it reads 0 where the map knows
    the cell and -1 where it does not: 0 would make unknown cells of a costmap free.
    """
    known = ~np.isnan(np.asarray(occupancy.p_occupied))
    pixels = np.where(keepout, _OCCUPIED, np.where(known, _FREE, _UNKNOWN)).astype(np.uint8)
    _write_pgm(folder / "keepout.pgm", pixels, np.asarray)
    _write_yaml(folder / "keepout.yaml", "keepout.pgm", "trinary", occupancy)


def write_speed_mask(folder: Path, values: NDArray[np.uint8], occupancy: GridMap) -> None:
    """Write `speed.pgm` and `speed.yaml`, a mask for nav2's SpeedFilter.

    A map server reads the values (H, W), 0 (no limit) to 100: in scale mode without thresholds,
    darker is larger, and a grey level is finer than a step of the values.
    """
    pixels = np.rint(255 * (1 - np.arange(101) / 100)).astype(np.uint8)[values]
    _write_pgm(folder / "speed.pgm", pixels, np.asarray)
    _write_yaml(folder / "speed.yaml", "speed.pgm", "scale", occupancy, (0.0, 1.0))


def _write_yaml(
    path: Path,
    image: str,
    mode: MapMode,
    occupancy: GridMap,
    thresholds: tuple[float, float] = (FREE_THRESH, OCCUPIED_THRESH),
) -> None:
    """Write the description of an image of a map; thresholds: of free and of occupied cells."""
    free, occupied = thresholds
    described = {
        "image": image,
        "mode": mode,
        "resolution": _clean(occupancy.resolution),
        "origin": [_clean(value) for value in occupancy.origin],
        "negate": 0,
        "occupied_thresh": occupied,
        "free_thresh": free,
    }
    text = yaml.safe_dump(described, sort_keys=False, default_flow_style=None)
    path.write_text(text, encoding="utf-8")


def _clean(value: float) -> float:
    """Without rounding errors: a multiple of the cell's edge is written as one, and never -0."""
    return round(float(value), 9) + 0.0


def _write_pgm(path: Path, layer: Layer, to_pixels: ToPixels) -> None:
    """Write a picture strip by strip: the map's row 0 is its lowest y, the picture's its top."""
    height, width = layer.shape
    with path.open("wb") as file:
        file.write(b"P5\n%d %d\n255\n" % (width, height))
        end = file.tell() + height * width
        for rows in rows_of(layer):  # from the bottom up
            end -= rows.size
            file.seek(end)
            file.write(to_pixels(rows[::-1]).tobytes())


def write_map_npz(
    path: Path,
    occupancy: OccupancyMap,
    changes: Sequence[Change] = (),
    evidence: Coverage | None = None,
) -> None:
    """Write `p_occupied`, `alpha`, `beta` (H, W), `origin` (x, y, yaw), `resolution` in metres.

    Also `changed` (H, W) uint8: 0, or how the cell changed, see CHANGED; and where evidence is
    given: `looks`, `clear_looks`, `thin` (H, W).
    """
    arrays: dict[str, Layer] = {
        "p_occupied": occupancy.p_occupied.astype(np.float32, copy=False),
        "alpha": occupancy.alpha.astype(np.float32, copy=False),
        "beta": occupancy.beta.astype(np.float32, copy=False),
        "changed": changed_cells(occupancy, changes),
    }
    if evidence is not None:
        arrays |= {
            "looks": evidence.observations.astype(np.uint16, copy=False),
            "clear_looks": evidence.unobstructed.astype(np.uint16, copy=False),
            "thin": evidence.thinly_observed.astype(np.bool_, copy=False),
        }
    arrays |= {
        "origin": np.asarray(occupancy.origin, np.float64),
        "resolution": np.asarray(occupancy.resolution, np.float64),
    }
    write_npz(path, arrays)


def changed_cells(occupancy: OccupancyMap, changes: Sequence[Change]) -> Layer:
    """(H, W) uint8 code of the last change of each cell; 0: unchanged."""
    height, width = occupancy.p_occupied.shape
    out = TiledArray((height, width), np.uint8, 0)
    first = np.round(np.array(occupancy.origin[:2]) / occupancy.resolution).astype(np.int64)
    for change in sorted(changes, key=lambda one: one.last_ns):
        column, row = (change.swept_cells - first).T
        inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
        code = np.full(int(inside.sum()), CHANGED[change.kind], np.uint8)
        out.put(row[inside], column[inside], code)
    codes: Layer = compact(out)
    return codes
