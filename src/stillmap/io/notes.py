"""The notes of a reader in `source` of a recording, as a recording folder keeps them.

What other programs note in another form is left out: no result depends on it.
"""

from typing import Annotated, Any, TypedDict

from stillmap.core.config import Limits
from stillmap.core.schema import prune

_Count = Annotated[int, Limits(ge=0)]
_Vector = tuple[float, float, float]


class _Ranges(TypedDict, total=False):
    min_range: float
    threshold: float | None
    threshold_how: str
    free_range: float | None
    free_how: str
    zero_means: str
    zero_how: str
    self_filter: list[_Vector]


class _Extrinsics(TypedDict, total=False):
    x: float
    y: float
    theta: float
    how: str


class _Sensor(TypedDict, total=False):
    name: str
    frame: str
    scans: _Count
    places: Annotated[int, Limits(ge=1)]
    beams_per_scan: _Count
    start_angle: float
    angle_step: float
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
    stamp: float
    start: float


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
    stamp_azimuth: float
    origin: list[float]


def prune_notes(source: Any) -> dict[str, Any]:
    """The notes that have the form in which readers write them."""
    return prune(source, _Notes) if isinstance(source, dict) else {}
