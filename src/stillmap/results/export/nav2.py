"""Write a folder for nav2: an edited map, masks of costmap filters, and parameters for them."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder, write_text
from stillmap.pipeline.options import MapMode
from stillmap.results.export.zones import SpeedLimit, Zone, cells_inside, is_within
from stillmap.results.map_server import write_keepout_mask, write_map_server, write_speed_mask
from stillmap.results.reader import Crossings, Grid
from stillmap.results.report.template import render

PARAMETERS = "nav2_params.yaml"

# of nav2_msgs/CostmapFilterInfo
_KEEPOUT, _SPEED_PERCENT, _SPEED_ABSOLUTE = 0, 1, 2
_STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # m/s of a value of the mask


class MaskCode(NamedTuple):
    """The meaning of values in a mask: base + multiplier * value; of speed limits 0 is none.

    Attributes:
        type: of nav2_msgs/CostmapFilterInfo.
        base: of speed limits in percent or m/s.
        multiplier: likewise.
    """

    type: int
    base: float
    multiplier: float

    @classmethod
    def of(cls, limits: Mapping[str, SpeedLimit]) -> Self:
        """The code for speed limits, by their origin for messages.

        Raises:
            InputError: some are in percent, others in m/s.
        """
        is_percent = all(limit.is_percent for limit in limits.values())
        if is_percent:
            return cls(_SPEED_PERCENT, 100.0, -1.0)
        for where, limit in limits.items():
            if limit.is_percent:
                what = "has a speed limit in percent, others are in m/s: a mask holds one of them"
                raise InputError(what, where=where, hint="write all as '50%', or all in m/s")
        fastest = max(limit.value for limit in limits.values())
        return cls(_SPEED_ABSOLUTE, 0.0, next(s for s in _STEPS if fastest <= 100 * s + 1e-9))

    def encode(self, limit: SpeedLimit, where: str) -> int:
        """The value, 0 to 100, of a limit, rounded down to what the mask can hold.

        Raises:
            InputError: it is below one step of the mask.
        """
        if limit.is_percent:
            return 100 - math.floor(limit.value)
        value = math.floor(limit.value / self.multiplier + 1e-9)
        if value < 1:
            what = f"a limit of {limit.value:g} m/s is less than a step of the mask"
            hint = f"steps are {self.multiplier:g} m/s, by the fastest of the limits"
            raise InputError(what, where=where, hint=hint)
        return value


class TrafficZone(NamedTuple):
    """A zone of the squares that were crossed at least so often; its polygons do not count."""

    least: int
    zone: Zone


class Maps:
    """An edited copy of a map, and its masks: zones from traffic, then the others in order.

    `erase` makes cells free in the map and removes zones there, `block` makes them occupied and
    keeps out of them, `keepout` only keeps out of them, `speed` limits the speed.

    Attributes:
        map: the edited map, (H, W) cells.
        keepout: (H, W), cells of keep-out zones; None where no zone is.
        speed: (H, W) uint8 values of the speed mask, 0 for no limit; None likewise.
        code: of the speed mask.
        warnings: zones that are not as they were drawn, a sentence each.
    """

    def __init__(
        self,
        grid: Grid,
        traffic: Sequence[TrafficZone],
        crossings: Crossings | None,
        zones: Sequence[Zone],
    ) -> None:
        """Draw the zones.

        Args:
            grid: the map.
            traffic: zones from crossings.
            crossings: None only where there are no such zones.
            zones: a later one replaces earlier ones where they overlap.

        Raises:
            InputError: a zone holds no cell, limits are in percent and in m/s, or the map is
                turned.
        """
        if grid.origin[2] != 0.0:
            raise InputError("is a turned map: costmaps of nav2 have no orientation")
        every, shape = [*zones, *(one.zone for one in traffic)], grid.p_occupied.shape
        limits = {zone.where: zone.limit for zone in every if zone.limit is not None}
        is_kept_out = any(zone.action in ("block", "keepout") for zone in every)
        self.map = Grid(grid.p_occupied.copy(), grid.origin, grid.resolution)
        self.keepout = np.zeros(shape, bool) if is_kept_out else None
        self.speed = np.zeros(shape, np.uint8) if limits else None
        self.code, self.warnings = MaskCode.of(limits), list[str]()
        if crossings is not None:
            for least, zone in traffic:
                cells = _cells_of_squares(crossings.number >= least, crossings, grid)
                if not cells.any():
                    most = int(crossings.number.max(initial=0))
                    what = f"no square of the floor was crossed {least} times, at most {most}"
                    kind = "keep-out" if zone.action == "keepout" else "slow"
                    self.warnings.append(f"{what}: traffic makes no {kind} zones")
                self._edit(zone, cells)
        for zone in zones:
            self._add(zone)

    def _add(self, zone: Zone) -> None:
        cells = np.zeros(self.map.p_occupied.shape, bool)
        for polygon in zone.polygons:
            window, inside = cells_inside(polygon, self.map)
            cells[window] |= inside
        if not cells.any():
            hint = f"the map: {_extent(self.map)}"
            raise InputError("holds no cell of the map", where=zone.where, hint=hint)
        if not all(is_within(polygon, self.map) for polygon in zone.polygons):
            self.warnings.append(f"{zone.where} reaches beyond the map: only the part on it counts")
        self._edit(zone, cells)

    def _edit(self, zone: Zone, cells: Bool) -> None:
        """Do with cells (H, W) what a zone says."""
        if zone.action in ("erase", "block"):
            self.map.p_occupied[cells] = float(zone.action == "block")
        if self.keepout is not None and zone.action != "speed":
            self.keepout[cells] = zone.action != "erase"
        if self.speed is not None and zone.action in ("erase", "speed"):
            limit = zone.limit
            self.speed[cells] = 0 if limit is None else self.code.encode(limit, zone.where)

    def area(self, mask: NDArray[Any]) -> float:
        """m2 of the cells of a mask that are not 0."""
        return int(np.count_nonzero(mask)) * self.map.resolution**2


def _cells_of_squares(squares: Bool, crossings: Crossings, grid: Grid) -> Bool:
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
        masks = {} if maps.keepout is None else {"keepout": MaskCode(_KEEPOUT, 0.0, 1.0)}
        if maps.speed is not None:
            masks["speed"] = maps.code
        write_text(work / PARAMETERS, render("nav2_params.yaml.j2", masks=masks))
