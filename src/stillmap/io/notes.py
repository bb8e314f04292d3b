"""The notes of a reader in `source` of a recording, as a recording folder keeps them.

What other programs note in another form is left out: no result depends on it.
"""

import json
from typing import Annotated, Any

from pydantic import Field, FiniteFloat, TypeAdapter, ValidationError
from typing_extensions import TypedDict

_Count = Annotated[int, Field(ge=0, lt=1 << 63)]
_Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class _Ranges(TypedDict, total=False):
    min_range: FiniteFloat
    threshold: FiniteFloat | None
    threshold_how: str
    free_range: FiniteFloat | None
    free_how: str
    zero_means: str
    zero_how: str
    self_filter: list[_Vector]


class _Extrinsics(TypedDict, total=False):
    x: FiniteFloat
    y: FiniteFloat
    theta: FiniteFloat
    how: str


class _Sensor(TypedDict, total=False):
    name: str
    frame: str
    scans: _Count
    places: Annotated[int, Field(ge=1, lt=1 << 63)]
    beams_per_scan: _Count
    start_angle: FiniteFloat
    angle_step: FiniteFloat
    grid: tuple[_Count, _Count]
    extrinsics: _Extrinsics
    ranges: _Ranges
    upside_down: bool
    upside_down_how: str


class _Skipped(TypedDict):
    count: _Count
    lines: list[_Count]


class _Spin(TypedDict, total=False):
    direction: str
    stamp: FiniteFloat
    start: FiniteFloat


class _Part(TypedDict, total=False):
    path: str
    scans: _Count
    omitted: _Count
    first_stamp_ns: int
    last_stamp_ns: int


class _Box(TypedDict):
    sensor: _Count
    beams: _Count
    low: _Vector
    high: _Vector


_Table = dict[str, Any]


class _Notes(TypedDict, total=False):
    """By key; others are kept as they are."""

    path: str | None
    made_from: str | None
    format: str | None
    base_frame: str | None
    base_frame_how: str | None
    skipped_unit: str | None
    skipped: dict[str, _Skipped] | None
    skipped_odometry: dict[str, _Skipped] | None
    damage: dict[str, _Skipped] | None
    records: _Table
    ignored: _Table
    params: _Table
    read_options: _Table
    odometry: _Table
    duplicates: list[str]
    warnings: list[str]
    topics: list[_Table]
    sensors: list[_Sensor]
    self_filter: list[_Box]
    parts: list[_Part]
    part: _Part
    spin: _Spin
    stamp_azimuth: FiniteFloat
    origin: list[FiniteFloat]


def prune_notes(source: Any) -> dict[str, Any]:
    """The notes that have the form in which readers write them; others are removed from them."""
    if not isinstance(source, dict):
        return {}
    while True:
        try:
            text = json.dumps(source, ensure_ascii=False).encode("utf-8", "replace")
            TypeAdapter(_Notes).validate_json(text, strict=True)
            return source
        except ValidationError as error:
            faults = [_innermost_entry(source, fault["loc"]) for fault in error.errors()]
            for mapping, key in faults:
                mapping.pop(key, None)


def _innermost_entry(notes: dict[str, Any], path: tuple[int | str, ...]) -> tuple[Any, int | str]:
    """The mapping and key of the last entry of a mapping on the path to a fault."""
    node: Any = notes
    entry = node, path[0]
    for step in path:
        is_entry = isinstance(node, dict) and step in node
        if is_entry:
            entry = node, step
        elif not (isinstance(node, list) and isinstance(step, int) and step < len(node)):
            break
        node = node[step]
    return entry
