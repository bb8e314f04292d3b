"""The `run.json` of a result folder read again: options, quality and what was mapped."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from stillmap.core import config
from stillmap.core.errors import InputError
from stillmap.core.grid_map import Region
from stillmap.core.json import read_json
from stillmap.core.local_frame import LocalFrame
from stillmap.core.short_repr import ShortRepr
from stillmap.io.rigid_transforms import MAX_TRANSLATION
from stillmap.mesh.options import MeshOptions
from stillmap.pipeline.options import MapMode, Options, OutputOptions
from stillmap.pipeline.quality import Quality
from stillmap.prepare.options import ReadOptions
from stillmap.results.run_json import EXTENDS, LOCAL_ORIGIN, RECORD
from stillmap.slam import SlamOptions

T = TypeVar("T")

_STATIC_CLOUD = "static.ply"  # results of 3D recordings have it
_MAX_RUN = 32 << 20  # bytes of a run.json


@dataclass(frozen=True)
class RunRecord(ShortRepr):
    """The record of a result.

    Attributes:
        folder: of the result.
        record: the content of its run.json.
    """

    folder: Path
    record: dict[str, Any]

    @property
    def options(self) -> Options:
        """Every option as it was resolved for the map.

        Raises:
            InputError: the record has options that this version does not know.
        """
        sections = self.record.get("options")
        return self._override(Options(), sections if isinstance(sections, dict) else {})

    @property
    def read_options(self) -> ReadOptions:
        """The options with which its recording was read: the same beams have the same numbers.

        Raises:
            InputError: the record does not say so.
        """
        read_as = self._section("read")
        if read_as is None:
            raise InputError("names no options", where=str(self.folder / RECORD))
        return self._override(ReadOptions(), read_as)

    @property
    def slam_options(self) -> SlamOptions:
        """The options that deskew its recording as it was deskewed for the map."""
        section = self._section("slam") or {}
        return SlamOptions(deskew=section.get("deskew") is not False)

    @property
    def texture_quality(self) -> int:
        """JPEG quality of the texture pages; the default where the record does not have it."""
        quality = (self._section("mesh") or {}).get("texture_quality")
        return self._override(MeshOptions(), {"texture_quality": quality}).texture_quality

    @property
    def quality(self) -> Quality:
        """Quality of the result; unknown where the record does not say so."""
        told = self.record.get("quality")
        parts = told if isinstance(told, dict) else {}
        overall, labels, geometry = (
            float(value) if isinstance(value := parts.get(name), int | float) else None
            for name in ("overall", "labels", "geometry")
        )
        return Quality(overall, labels, geometry)

    @property
    def region(self) -> Region | None:
        """The part of the map frame that it shows; None: everything."""
        section = self._section("output") or {}
        return self._override(OutputOptions(), {"region": section.get("region")}).region

    @property
    def frame(self) -> LocalFrame:
        """The frame in which it was computed.

        Raises:
            InputError: the record has an origin that cannot be.
        """
        return read_frame(self.folder, self.record, LOCAL_ORIGIN)

    @property
    def map_mode(self) -> MapMode:
        """Mode of its map image; the default where the record does not say."""
        mode = (self._section("output") or {}).get("map_mode")
        return self._override(OutputOptions(), {"map_mode": mode}).map_mode

    def _section(self, name: str) -> dict[str, Any] | None:
        """A section of the options in the record; None where there is none."""
        options = self.record.get("options")
        section = options.get(name) if isinstance(options, dict) else None
        return section if isinstance(section, dict) else None

    def _override(self, options: T, changes: dict[str, Any]) -> T:
        """The options with those of the record that are set."""
        try:
            return config.override(options, _drop_unset(changes))
        except InputError as error:
            where = str(self.folder)
            raise InputError(f"has options that cannot be: {error}", where=where) from error

    @property
    def dimension(self) -> int:
        """Dimension of its recording, 2 or 3."""
        noted = self.record.get("dimension")  # of a session of a place
        if noted in (2, 3):
            return int(noted)
        return 3 if (self.folder / _STATIC_CLOUD).is_file() else 2

    @property
    def extends_map(self) -> bool:
        """True if its clouds hold what its recording does not show: it extends a known map."""
        return self.record["input"].get(EXTENDS) is True

    @property
    def n_sensors(self) -> int:
        """Number of sensors of its recording that the record lists, at least 1."""
        sensors = self.record["input"].get("sensors")
        return max(len(sensors), 1) if isinstance(sensors, list) else 1


def _drop_unset(changes: dict[str, Any]) -> dict[str, Any]:
    """Nested options without those that are None."""
    return {
        key: _drop_unset(value) if isinstance(value, dict) else value
        for key, value in changes.items()
        if value is not None
    }


def read_frame(folder: Path, record: dict[str, Any], name: str) -> LocalFrame:
    """The frame whose origin (3,) a record of a folder has under a name; without one the map frame.

    Raises:
        InputError: it is no place.
    """
    noted = record.get(name)
    if noted is None:
        return LocalFrame()
    try:
        origin = np.array(noted, np.float64)
        usable = origin.shape == (3,) and bool((np.abs(origin) < MAX_TRANSLATION).all())
    except (TypeError, ValueError):
        usable = False
    if not usable:
        raise InputError(f"{name} is no place", where=str(folder / RECORD))
    return LocalFrame(origin)


def is_result(path: Path) -> bool:
    """True if a folder is a result."""
    return (path / RECORD).is_file()


def read_region(result: Path) -> Region | None:
    """The part of the map frame that a result shows; None: everything, or the record is missing.

    Raises:
        InputError: the record is damaged.
    """
    if not is_result(result):
        return None
    return RunRecord(result, read_record(result)).region


def read_record(result: Path) -> dict[str, Any]:
    """The `run.json` of a result folder.

    Raises:
        InputError: it is missing or damaged.
    """
    path = result / RECORD
    record = read_json(path, _MAX_RUN, "a result is what `stillmap map` wrote")
    if not isinstance(record, dict) or not isinstance(record.get("input"), dict):
        raise InputError("is no record of a run: no input named", where=str(path))
    return record
