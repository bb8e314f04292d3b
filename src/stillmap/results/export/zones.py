"""Zones of a map as polygons in a GeoJSON file (RFC 7946), in metres in the map frame."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from msgspec import Meta

from stillmap.core.array_folder import parse
from stillmap.core.array_types import Bool, Float
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.core.json import read_json

Action = Literal["erase", "block", "keepout", "speed"]
Polygon = list[Float]  # rings (n, 2), the last position equal to the first: outline, then holes

_MAX_BYTES = 16 << 20
_MIN_PERCENT, _MIN_SPEED, _MAX_SPEED = 1.0, 0.01, 100.0  # m/s
_Axis = Annotated[float, Meta(ge=-1e9, le=1e9)]  # m
_Ring = Annotated[list[Annotated[list[_Axis], Meta(min_length=2)]], Meta(min_length=4)]
_Polygons = Annotated[list[Annotated[list[_Ring], Meta(min_length=1)]], Meta(min_length=1)]


class SpeedLimit(NamedTuple):
    """A speed limit.

    Attributes:
        value: in percent of the robot's maximum, or in m/s.
        is_percent: whether in percent.
    """

    value: float
    is_percent: bool


class Zone(NamedTuple):
    """A zone of the map.

    Attributes:
        where: the file and the feature, for messages.
        action: what is done with the cells in it.
        limit: of action "speed"; None for others.
        polygons: their union is the zone.
    """

    where: str
    action: Action
    limit: SpeedLimit | None
    polygons: list[Polygon]


@dataclass(frozen=True)
class _Properties:
    action: Action
    speed: Any = None
    name: Any = None


@dataclass(frozen=True)
class _Geometry:
    type: Literal["Polygon", "MultiPolygon"]
    coordinates: list[Any]


@dataclass(frozen=True)
class _Feature:
    type: Literal["Feature"]
    properties: _Properties
    geometry: _Geometry


@dataclass(frozen=True)
class _Collection:
    type: Literal["FeatureCollection"]
    features: list[dict[str, Any]]


def parse_speed_limit(value: object, where: str) -> SpeedLimit:
    """A limit from a number in m/s, or from text: `"0.5"` in m/s, `"50%"` of the maximum.

    Raises:
        InputError: it is none, or out of range.
    """
    text = str(value).strip()
    is_percent = text.endswith("%")
    try:
        number = float(text.removesuffix("%"))
    except ValueError:
        number = math.nan
    low, high = (_MIN_PERCENT, 100.0) if is_percent else (_MIN_SPEED, _MAX_SPEED)
    if not low <= number <= high:
        what = f"{value!r:.40} is no speed limit"
        hint = f"{_MIN_SPEED:g} to {_MAX_SPEED:g} in m/s, or '{_MIN_PERCENT:g}%' to '100%'"
        raise InputError(what, where=where, hint=hint)
    return SpeedLimit(number, is_percent)


def read_zones(path: Path) -> list[Zone]:
    """The features of a FeatureCollection, in the order of the file.

    Their property `action` is `erase`, `block`, `keepout` or `speed`; the last one needs a
    property `speed`, see `parse_speed_limit`. Geometries are Polygon or MultiPolygon.

    Raises:
        InputError: names the file and the feature that is at fault.
    """
    content = parse(read_json(path, _MAX_BYTES), _Collection, path, "a GeoJSON FeatureCollection")
    numbered = enumerate(content.features, start=1)
    return [_read_zone(one, Path(f"{path}: feature {number}")) for number, one in numbered]


def _read_zone(content: dict[str, Any], where: Path) -> Zone:
    hint = f"its action is {', '.join(get_args(Action))}, its geometry Polygon or MultiPolygon"
    feature = parse(content, _Feature, where, hint)
    properties, coordinates = feature.properties, feature.geometry.coordinates
    if isinstance(properties.name, str) and properties.name:
        where = Path(f"{where} {properties.name!r:.40}")
    if feature.geometry.type == "Polygon":
        coordinates = [coordinates]
    hint = "rings of four positions x, y in metres, or more, in the map frame"
    polygons = [
        [np.array([position[:2] for position in ring]) for ring in polygon]
        for polygon in parse(coordinates, _Polygons, where, hint)
    ]
    if any((ring[0] != ring[-1]).any() for polygon in polygons for ring in polygon):
        raise InputError("has a ring whose last position is not its first", where=str(where))
    is_limit = properties.action == "speed"
    limit = parse_speed_limit(properties.speed, str(where)) if is_limit else None
    return Zone(str(where), properties.action, limit, polygons)


def cells_inside(polygon: Sequence[Float], grid: GridMap) -> tuple[tuple[slice, slice], Bool]:
    """The cells of a map whose centres lie inside a polygon.

    Args:
        polygon: rings (n, 2) in m in the map frame, closed: the outline, then holes.
        grid: not turned: its yaw is 0.

    Returns:
        Rows and columns of the map around the polygon, and whether each cell there lies inside.
    """
    height, width = grid.p_occupied.shape
    corner = np.array(grid.origin[:2])
    # in cells: the centre of cell (row, column) is (column + 0.5, row + 0.5)
    rings = [(ring - corner) / grid.resolution for ring in polygon]
    low = np.floor(rings[0].min(axis=0)).clip(0, (width, height)).astype(int)
    high = np.ceil(rings[0].max(axis=0)).clip(low, (width, height)).astype(int)
    shape = (int(high[1] - low[1]), int(high[0] - low[0]))
    inside, *holes = (_inside_ring(ring - low, shape) for ring in rings)
    for hole in holes:
        inside &= ~hole
    return (slice(low[1], high[1]), slice(low[0], high[0])), inside


def is_within(polygon: Sequence[Float], grid: GridMap) -> bool:
    """True if no part of a polygon lies outside the map."""
    outline = (polygon[0] - np.array(grid.origin[:2])) / grid.resolution
    beyond = outline - np.array(grid.p_occupied.shape[::-1])
    return bool((outline >= -1e-6).all() and (beyond <= 1e-6).all())


def _inside_ring(ring: Float, shape: tuple[int, int]) -> Bool:
    """Cells (h, w) whose centres lie inside a ring in cells, by the even-odd rule.

    Along a row, each edge that crosses the line through the centres changes inside to outside or
    back from the first centre to the right of it.
    """
    h, w = shape
    changes = np.zeros((h, w + 1), np.bool_)
    for (x0, y0), (x1, y1) in itertools.pairwise(ring.tolist()):
        # an edge holds its lower end, not its upper one: corners count once
        first, last = (min(max(math.ceil(y - 0.5), 0), h) for y in sorted((y0, y1)))
        row = np.arange(first, last)
        x = x0 + (row + 0.5 - y0) * (x1 - x0) / (y1 - y0 or 1.0)
        changes[row, np.ceil(x - 0.5).clip(0, w).astype(np.int64)] ^= True
    return np.asarray(np.logical_xor.accumulate(changes, axis=1)[:, :w])
