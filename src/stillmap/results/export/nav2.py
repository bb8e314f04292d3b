"""Write a folder for nav2: an edited map, masks of costmap filters, and parameters for them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.pipeline.options import MapMode
from stillmap.results.export import nav2_parameters
from stillmap.results.export.nav2_parameters import NO_LIMITS, PARAMETERS, MaskCode
from stillmap.results.export.zone_cells import cells_inside, is_within
from stillmap.results.export.zones import SpeedLimit, Zone
from stillmap.results.map_server import write_keepout_mask, write_map_server, write_speed_mask
from stillmap.results.reader import Crossings, Grid

Mask = NDArray[np.bool_]

_TRAFFIC = "traffic"  # where the limit of the slow squares comes from


class TrafficRule(NamedTuple):
    """Zones from traffic: the squares that were crossed at least so often.

    Attributes:
        keepout: crossings from which a square is a keep-out zone; None: none is.
        slow: crossings from which the speed in a square is limited; None: it is not.
        limit: of the slow squares.
    """

    keepout: int | None
    slow: int | None
    limit: SpeedLimit


@dataclass(eq=False)
class Maps:
    """A map and its masks.

    Attributes:
        map: the edited map, (H, W) cells.
        keepout: (H, W), cells of keep-out zones; None where no zone is.
        speed: (H, W) uint8 values of the speed mask, 0 for no limit; None likewise.
        code: of the speed mask.
        warnings: zones that are not as they were drawn, a sentence each.
    """

    map: Grid
    keepout: Mask | None = None
    speed: NDArray[np.uint8] | None = None
    code: MaskCode = NO_LIMITS
    warnings: list[str] = field(default_factory=list)

    @property
    def keepout_area(self) -> float:
        """m2."""
        count = 0 if self.keepout is None else int(np.count_nonzero(self.keepout))
        return count * self.map.resolution**2

    @property
    def slow_area(self) -> float:
        """m2 with a speed limit."""
        count = 0 if self.speed is None else int(np.count_nonzero(self.speed))
        return count * self.map.resolution**2


def make_maps(
    grid: Grid, zones: Sequence[Zone], rule: TrafficRule, crossings: Crossings | None
) -> Maps:
    """Edit a copy of a map, and draw the masks: zones from traffic, then the others in order.

    `erase` makes cells free in the map and removes zones there, `block` makes them occupied and
    keeps out of them, `keepout` only keeps out of them, `speed` limits the speed.

    Args:
        grid: the map.
        zones: a later one replaces earlier ones where they overlap.
        rule: which crossings make zones.
        crossings: None only where the rule has no zones.

    Raises:
        InputError: a zone holds no cell, limits are in percent and in m/s, or the map is turned.
    """
    if grid.origin[2] != 0.0:
        raise InputError("is a turned map: costmaps of nav2 have no orientation")
    limits = {zone.where: zone.limit for zone in zones if zone.limit is not None}
    if rule.slow is not None:
        limits[_TRAFFIC] = rule.limit
    maps = Maps(
        Grid(grid.p_occupied.copy(), grid.origin, grid.resolution), code=MaskCode.of(limits)
    )
    shape = grid.p_occupied.shape
    if rule.keepout is not None or any(one.action in ("block", "keepout") for one in zones):
        maps.keepout = np.zeros(shape, bool)
    if limits:
        maps.speed = np.zeros(shape, np.uint8)
    if crossings is not None:
        _add_traffic(maps, rule, crossings)
    for zone in zones:
        _add_zone(maps, zone)
    return maps


def _add_traffic(maps: Maps, rule: TrafficRule, crossings: Crossings) -> None:
    """Keep out of, and limit the speed in, the squares that were crossed often."""
    if rule.keepout is not None and maps.keepout is not None:
        maps.keepout |= _find_crossed_cells(maps, crossings, rule.keepout, "keep-out")
    if rule.slow is not None and maps.speed is not None:
        cells = _find_crossed_cells(maps, crossings, rule.slow, "slow")
        maps.speed[cells] = maps.code.encode(rule.limit, _TRAFFIC)


def _find_crossed_cells(maps: Maps, crossings: Crossings, least: int, kind: str) -> Mask:
    """(H, W) cells in squares that were crossed at least so often; warns if there are none."""
    cells = _cells_of_squares(crossings.number >= least, crossings, maps.map)
    if not cells.any():
        most = int(crossings.number.max(initial=0))
        what = f"no square of the floor was crossed {least} times, at most {most}"
        maps.warnings.append(f"{what}: traffic makes no {kind} zones")
    return cells


def _cells_of_squares(squares: Mask, crossings: Crossings, grid: Grid) -> Mask:
    """(H, W) cells of the map whose centres lie in squares that are true."""
    inside, index = [], []
    for axis, cells, n in zip((1, 0), grid.p_occupied.shape, squares.shape, strict=True):
        centres = grid.origin[axis] + (np.arange(cells) + 0.5) * grid.resolution
        square = np.floor((centres - crossings.origin[axis]) / crossings.resolution).astype(int)
        inside.append((square >= 0) & (square < n))
        index.append(square.clip(0, max(n - 1, 0)))
    if not squares.size:
        return np.zeros(grid.p_occupied.shape, bool)
    return np.asarray(squares[np.ix_(*index)] & inside[0][:, None] & inside[1])


def _add_zone(maps: Maps, zone: Zone) -> None:
    p_occupied, count = maps.map.p_occupied, 0
    for polygon in zone.polygons:
        window, inside = cells_inside(polygon, maps.map)
        count += int(np.count_nonzero(inside))
        if zone.action == "erase":
            p_occupied[window][inside] = 0.0
        elif zone.action == "block":
            p_occupied[window][inside] = 1.0
        if maps.keepout is not None and zone.action != "speed":
            maps.keepout[window][inside] = zone.action != "erase"
        if maps.speed is not None and zone.action in ("erase", "speed"):
            limit = zone.limit
            value = 0 if limit is None else maps.code.encode(limit, zone.where)
            maps.speed[window][inside] = value
    if not count:
        raise InputError(
            "holds no cell of the map", where=zone.where, hint=f"the map: {_extent(maps.map)}"
        )
    if not all(is_within(polygon, maps.map) for polygon in zone.polygons):
        maps.warnings.append(f"{zone.where} reaches beyond the map: only the part on it counts")


def _extent(grid: Grid) -> str:
    height, width = grid.p_occupied.shape
    (x, y, _), r = grid.origin, grid.resolution
    return f"x {x:.2f} to {x + width * r:.2f} m, y {y:.2f} to {y + height * r:.2f} m"


def write(maps: Maps, folder: Path, mode: MapMode, *, overwrite: bool = False) -> None:
    """Write `map.yaml`, where there are zones `keepout.yaml` and `speed.yaml`, their images, and
    the parameters of nav2 for them.

    Args:
        maps: the map and its masks.
        folder: appears complete or not at all.
        mode: of the map's image.
        overwrite: replace an earlier folder of this kind.

    Raises:
        InputError: the folder is taken or cannot be written.
    """
    with atomic_folder(folder, PARAMETERS, overwrite) as work:
        write_map_server(work, maps.map, mode)
        if maps.keepout is not None:
            write_keepout_mask(work, maps.keepout, maps.map)
        if maps.speed is not None:
            write_speed_mask(work, maps.speed, maps.map)
        code = maps.code if maps.speed is not None else None
        nav2_parameters.write(work / PARAMETERS, maps.keepout is not None, code)
