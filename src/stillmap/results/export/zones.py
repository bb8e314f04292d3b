"""Zones of a map as polygons in a GeoJSON file (RFC 7946), in metres in the map frame."""

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError, closest_match
from stillmap.core.json import read_json

Float = NDArray[np.float64]
Action = Literal["erase", "block", "keepout", "speed"]
Polygon = list[Float]  # rings (n, 2), the last position equal to the first: outline, then holes

_ACTIONS: tuple[Action, ...] = get_args(Action)
_MAX_BYTES = 16 << 20
_MAX_COORDINATE = 1e9  # m
_MIN_PERCENT, _MIN_SPEED, _MAX_SPEED = 1.0, 0.01, 100.0  # m/s
_MAX_NAME = 40  # characters in messages


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


def parse_speed_limit(value: object, where: str) -> SpeedLimit:
    """A limit from a number in m/s, or from text: `"0.5"` in m/s, `"50%"` of the maximum.

    Raises:
        InputError: it is none, or out of range.
    """
    text = value.strip() if isinstance(value, str) else ""
    is_percent = text.endswith("%")
    try:
        number = float(text.removesuffix("%") if isinstance(value, str) else _number(value))
    except (ValueError, TypeError, OverflowError):
        number = math.nan
    low, high = (_MIN_PERCENT, 100.0) if is_percent else (_MIN_SPEED, _MAX_SPEED)
    if not low <= number <= high:
        what = f"{_short(value)} is no speed limit"
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
    content = read_json(path, _MAX_BYTES)
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list) or content.get("type") != "FeatureCollection":
        raise InputError("is no GeoJSON FeatureCollection", where=str(path))
    return [_read_zone(one, path, number) for number, one in enumerate(features, start=1)]


def _read_zone(feature: Any, path: Path, number: int) -> Zone:
    where = f"{path}: feature {number}"
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise InputError("is no Feature", where=where)
    properties = feature.get("properties")
    if not isinstance(properties, dict):
        properties = {}
    name = properties.get("name")
    if isinstance(name, str) and name:
        where = f"{where} {_short(name)}"
    action, limit = _read_action(properties.get("action"), where), None
    if action == "speed":
        if "speed" not in properties:
            hint = "a number in m/s, or a text such as '50%'"
            raise InputError("has no property speed", where=where, hint=hint)
        limit = parse_speed_limit(properties["speed"], where)
    return Zone(where, action, limit, _read_polygons(feature.get("geometry"), where))


def _read_action(name: object, where: str) -> Action:
    for action in _ACTIONS:
        if action == name:
            return action
    what = "has no action" if name is None else f"has the action {_short(name)}"
    nearest = closest_match(name, _ACTIONS) if isinstance(name, str) else None
    hint = f"do you mean {nearest!r}?" if nearest else f"a property: {', '.join(_ACTIONS)}"
    raise InputError(what, where=where, hint=hint)


def _read_polygons(geometry: Any, where: str) -> list[Polygon]:
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in ("Polygon", "MultiPolygon"):
        what = "has no geometry" if geometry is None else f"is a {_short(kind)}"
        raise InputError(what, where=where, hint="Polygon or MultiPolygon")
    coordinates = geometry.get("coordinates")
    polygons = [coordinates] if kind == "Polygon" else coordinates
    try:
        return [[_read_ring(ring) for ring in _list(one)] for one in _list(polygons)]
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"has no usable coordinates: {error}", where=where) from error


def _read_ring(positions: Any) -> Float:
    """(n, 2) positions of a closed ring; heights are ignored."""
    ring = np.array(
        [[_number(axis) for axis in _list(position)[:2]] for position in _list(positions)]
    )
    if ring.ndim != 2 or ring.shape[1] != 2:
        raise ValueError("a position without x and y")
    if len(ring) < 4 or (ring[0] != ring[-1]).any():
        raise ValueError("a ring of less than four positions, or whose last is not its first")
    if not (np.abs(ring) <= _MAX_COORDINATE).all():
        raise ValueError("beyond a million kilometres; they are metres in the map frame")
    return ring


def _list(value: object) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise TypeError("not nested as the type of geometry wants it")
    return value


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError("something else than a number")
    return float(value)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _MAX_NAME else f"{text[: _MAX_NAME - 3]}..."
