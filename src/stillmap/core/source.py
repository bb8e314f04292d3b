"""Notes of a reader on a recording: what it was read from, its sensors, what was left out."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.json import to_jsonable

# of notes in a file, which may hold anything: no sum and no angle in degrees overflows
Count = Annotated[int, Meta(ge=0, le=2**53)]
Stamp = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Angle = Annotated[float, Meta(ge=-1e3, le=1e3)]


@dataclass(frozen=True)
class LaserPose:
    """Pose of a laser on the robot in metres and radians, and how it was found."""

    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0
    how: str = ""

    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) T_base_sensor."""
        return se2.matrix(self.x, self.y, self.theta)

    def override(self, given: tuple[float | None, float | None, float | None]) -> LaserPose:
        """The pose with the values of x, y and theta that are given."""
        if given == (None, None, None):
            return self
        own = (self.x, self.y, self.theta)
        x, y, theta = (o if g is None else g for o, g in zip(own, given, strict=True))
        return LaserPose(x, y, theta, "given")


@dataclass(frozen=True)
class RangeRule:
    """Interpretation of the readings of one laser. Ranges in metres."""

    threshold: float | None = None
    threshold_how: str = ""
    zero_means: Literal["unusable", "max-range"] = "unusable"
    free_range: float | None = None  # None: unknown, maximum-range beams are unusable
    min_range: float = 0.0
    # first and last beam, maximum range of returns from the robot itself
    self_filter: tuple[tuple[int, int, float], ...] = ()


@dataclass(frozen=True)
class SensorNotes:
    """One sensor, or one that moves and has several poses (`places`); None: not known.

    `grid` are rows and columns of the images of a depth camera.
    """

    name: str = ""
    frame: str | None = None
    scans: Count | None = None
    places: Annotated[int, Meta(ge=1, le=2**53)] = 1
    beams_per_scan: Count | None = None
    start_angle: Angle | None = None
    angle_step: Angle | None = None
    upside_down: bool | None = None
    upside_down_how: str | None = None
    grid: tuple[Count, Count] | None = None
    extrinsics: LaserPose | None = None
    ranges: RangeRule | None = None


@dataclass(frozen=True)
class Skipped:
    """Records that were skipped for one reason: their count, and the numbers of the first."""

    count: Count
    lines: list[Count] = field(default_factory=list)


@dataclass(frozen=True)
class Part:
    """Part of a run, or of the time of a recording (`start`, `end` in seconds as given)."""

    first_stamp_ns: Stamp | None = None
    last_stamp_ns: Stamp | None = None
    path: str | None = None
    scans: Count | None = None
    omitted: Count = 0
    start: float | None = None
    end: float | None = None


@dataclass(frozen=True)
class BodyBox:
    """Box around a sensor, in metres, with the returns from the robot itself."""

    sensor: Count
    beams: Count
    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True)
class Spin:
    """Direction in which a lidar turns; azimuths in radians of its start and at its stamp."""

    direction: str
    turns_per_second: list[float] = field(default_factory=list)
    start: float | None = None
    stamp: float | None = None


def _without_unknown(entries: list[tuple[str, Any]]) -> dict[str, Any]:
    return {key: value for key, value in entries if value not in (None, [], {})}


@dataclass
class Source:
    """Notes of a reader; `details` are for people alone.

    Attributes:
        path: of the file or folder.
        made_from: of the recording that a recording folder was made from.
        sensors: one of each of the recording, in order.
        skipped, skipped_odometry, damage: records (numbers of `skipped_unit`) by reason.
        read_options: options that changed readings which were interpreted before.
        odometry: `from` what it is, scans `outside` its time.
        parts: of the run; `part`: of the recording's time, that was read.
        spin: from which beam times were computed.
        spin_direction, stamp_azimuth, max_range: as the format states them, m and rad.
        origin: by which the coordinates of clouds were shifted.
    """

    path: str | None = None
    made_from: str | None = None
    format: str | None = None
    sensors: list[SensorNotes] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    skipped_unit: str = "line"
    skipped: dict[str, Skipped] = field(default_factory=dict)
    skipped_odometry: dict[str, Skipped] = field(default_factory=dict)
    damage: dict[str, Skipped] = field(default_factory=dict)
    duplicates: list[str] = field(default_factory=list)
    base_frame: str | None = None
    base_frame_how: str | None = None
    odometry: dict[str, Any] = field(default_factory=dict)
    read_options: dict[str, Any] = field(default_factory=dict)
    records: dict[str, Any] = field(default_factory=dict)
    ignored: dict[str, Any] = field(default_factory=dict)
    params: dict[str, Any] = field(default_factory=dict)
    topics: list[dict[str, Any]] = field(default_factory=list)
    self_filter: list[BodyBox] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    part: Part | None = None
    spin: Spin | None = None
    spin_direction: str | None = None
    stamp_azimuth: float | None = None
    max_range: float | None = None
    origin: tuple[float, float, float] | None = None
    details: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        counts = f"{len(self.sensors)} sensors, {len(self.warnings)} warnings"
        return f"<Source: {self.format or 'unknown format'}, {self.path}, {counts}>"

    @property
    def has_depth_camera(self) -> bool:
        """True if scans of a sensor are the grids of depth images."""
        return any(sensor.grid is not None for sensor in self.sensors)

    @property
    def n_skipped(self) -> int:
        """Number of scans that were skipped."""
        return sum(skipped.count for skipped in self.skipped.values())

    def to_dict(self) -> dict[str, Any]:
        """The notes as JSON values, without those that say nothing."""
        entries = asdict(self, dict_factory=_without_unknown)
        details = entries.pop("details", {})
        return {**entries, **details}

    @classmethod
    def from_dict(cls, content: Any) -> Source:
        """The notes of JSON values, without those that another program wrote in another form."""
        content = to_jsonable(content)  # infinite numbers become None
        if not isinstance(content, dict):
            return cls()
        kinds = get_type_hints(cls, include_extras=True)
        del kinds["details"]
        source = cls(details={key: value for key, value in content.items() if key not in kinds})
        for key in kinds.keys() & content:
            with suppress(msgspec.ValidationError):
                setattr(source, key, msgspec.convert(content[key], kinds[key]))
        return source
