"""A result folder opened again: its `run.json`, its recording and its labels."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, config
from stillmap.core.errors import InputError
from stillmap.core.files import read_text, require_regular
from stillmap.core.recording import Recording
from stillmap.core.region import Region
from stillmap.core.short_repr import ShortRepr
from stillmap.io import read
from stillmap.io.input_groups import read_parts
from stillmap.io.text_lines import Progress
from stillmap.io.trajectory import poses_from_tum
from stillmap.mesh.options import MeshOptions
from stillmap.pipeline.calibration import apply_calibration
from stillmap.pipeline.options import MapMode, Options, OutputOptions
from stillmap.pipeline.quality import Quality
from stillmap.preprocessing.options import ReadOptions
from stillmap.results.labels import Labels, read_colors, read_labels
from stillmap.results.reader import Grid, Track, read_grid, read_tracks
from stillmap.results.run_json import RECORD, read_calibration
from stillmap.slam import SlamOptions, deskew_recording

T = TypeVar("T")

_STATIC_CLOUD = "static.ply"  # results of 3D recordings have it
_MAX_RUN = 32 << 20  # bytes of a run.json


@dataclass(frozen=True, eq=False)
class Exported(ShortRepr):
    """A result for export: recording, poses, labels, map and tracks.

    Attributes:
        recording: T scans with M beams.
        poses: (T, D+1, D+1) T_map_base.
        p_static: (M,) float32, NaN for unusable beams.
        map: occupancy of the static cells; in 3D of those in a robot's way.
        tracks: of the moving objects.
        slam: the options of deskewing.
        colors: (M, 3) uint8 of the end points; None: without.
        region: the part of the map frame that is shown; None: everything.
    """

    recording: Recording
    poses: NDArray[np.float64]
    p_static: NDArray[np.float32]
    map: Grid
    tracks: list[Track]
    slam: SlamOptions
    colors: NDArray[np.uint8] | None = None
    region: Region | None = None

    def deskew(self) -> Recording:
        """The recording without the motion during its scans."""
        return deskew_recording(self.recording, self.poses, self.slam)


@dataclass(frozen=True)
class ResultFolder(ShortRepr):
    """A result folder.

    Attributes:
        folder: where it lies.
        record: its run.json.
        source: where its recording is; of one in parts, where the first is.
        source_given: whether the user named the recording.
        parts: where the parts of its recording are, in order of time; empty: it is whole.
    """

    folder: Path
    record: dict[str, Any]
    source: Path
    source_given: bool
    parts: tuple[Path, ...] = ()

    @property
    def sources(self) -> tuple[Path, ...]:
        """Where its recording is, or all parts of it."""
        return self.parts or (self.source,)

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
        """How good the result is; unknown where the record does not say so."""
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
    def map_mode(self) -> MapMode:
        """How its map image is written; the default where the record does not say."""
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
    def n_sensors(self) -> int:
        """Number of sensors of its recording that the record lists, at least 1."""
        sensors = self.record["input"].get("sensors")
        return max(len(sensors), 1) if isinstance(sensors, list) else 1

    def require_source(self) -> Path:
        """Where the recording is.

        Raises:
            InputError: it is not there any more.
        """
        for path in self.sources:
            if not self.source_given and not path.exists():
                hint = "that is where it was when it was mapped: name it with recording=PATH"
                raise InputError("does not exist", where=str(path), hint=hint)
        return self.source

    def read(
        self, progress: Progress | None = None, scratch: Path | None = None
    ) -> tuple[Recording, Labels]:
        """The recording, as it was read when it was mapped, and its labels.

        Args:
            progress: hears which share of the recording is read.
            scratch: folder for what is too large for memory; None: the system's temporary folder.

        Raises:
            InputError: one of them is not there, or they do not belong together.
        """
        read_as, labels = self.read_options, read_labels(self.folder)
        source = self.require_source()
        if self.parts:
            recording = read_parts(self.parts, read_as, progress=progress, scratch=scratch)
        else:
            recording = read(source, read_as, progress=progress, scratch=scratch)
        require_labelled(recording, labels, str(source))
        return recording, labels

    def calibrate(self, recording: Recording) -> Recording:
        """The recording with mounts and odometry as they were calibrated for the map.

        Raises:
            InputError: the record of the calibration is damaged.
        """
        try:
            found = read_calibration(self.record.get("calibration"))
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            where = str(self.folder / RECORD)
            raise InputError(f"has a damaged calibration: {error!r}", where=where) from error
        if recording.dimension != 2 or len(found.lasers) != len(recording.T_base_sensor):
            return recording
        return apply_calibration(recording, found)

    def read_poses(self, recording: Recording) -> NDArray[np.float64]:
        """The estimated poses (T, D+1, D+1) T_map_base of a recording that was read by `read`.

        Raises:
            InputError: the trajectory is missing or damaged.
        """
        return poses_from_tum(self.folder / "trajectory.tum", recording)

    def export(self, progress: Progress | None = None, scratch: Path | None = None) -> Exported:
        """The content of a result; arguments are those of `read`.

        Raises:
            InputError: a file is missing or damaged.
        """
        recording, labels = self.read(progress, scratch)
        return Exported(
            self.calibrate(recording),
            self.read_poses(recording),
            labels.p_static,
            read_grid(self.folder),
            read_tracks(self.folder / "objects" / "objects.json"),
            self.slam_options,
            read_colors(self.folder, recording.n_beams) if recording.dimension == 3 else None,
            self.region,
        )


def _drop_unset(changes: dict[str, Any]) -> dict[str, Any]:
    """Nested options without those that are None."""
    return {
        key: _drop_unset(value) if isinstance(value, dict) else value
        for key, value in changes.items()
        if value is not None
    }


def require_labelled(recording: Recording, labels: Labels, where: str) -> None:
    """Refuse a recording other than the one that was mapped.

    Raises:
        InputError: scans, beams or hits are others than those of the labels.
    """
    other = ""
    if not np.array_equal(recording.stamp_ns, labels.stamp_ns) or not np.array_equal(
        recording.offset, labels.offset
    ):
        other = "scans or beams"
    elif any(
        (recording.hit[b] != labels.hit[b]).any()
        for b in arrays.iter_blocks(recording.hit, labels.hit)
    ):
        other = "beams hit something"
    if other:
        what = f"is not the recording that was mapped: other {other}"
        raise InputError(what, where=where, hint="name it with recording=PATH")


def is_result(path: Path) -> bool:
    """Whether a folder is a result."""
    return (path / RECORD).is_file()


def read_region(result: Path) -> Region | None:
    """The part of the map frame that a result shows; None: everything, or the record is missing.

    Raises:
        InputError: the record is damaged.
    """
    if not is_result(result):
        return None
    return ResultFolder(result, read_record(result), Path(), False).region


def open_result(
    result: Path, recording: str | Sequence[str | os.PathLike[str]] | None = None
) -> ResultFolder:
    """A result folder; its recording is where `run.json` says, or at the path `recording`.

    Args:
        result: the folder.
        recording: path, or those of all parts in order of time.

    Raises:
        InputError: it is none, or names no recording.
    """
    record = read_record(result)
    if recording:
        paths = [recording] if isinstance(recording, str) else [os.fspath(one) for one in recording]
    else:
        paths = _find_paths(record["input"], str(result / RECORD))
    parts = tuple(map(Path, paths)) if len(paths) > 1 else ()
    return ResultFolder(result, record, Path(paths[0]), bool(recording), parts)


def _find_paths(noted: dict[str, Any], where: str) -> list[str]:
    """The paths of the recording in a record, or of its parts.

    Raises:
        InputError: there are none.
    """
    parts = noted.get("parts")
    if isinstance(parts, list) and parts:
        paths = [one.get("path") if isinstance(one, dict) else None for one in parts]
    else:
        paths = [noted.get("path")]
    found = [path for path in paths if isinstance(path, str) and path]
    if len(found) < len(paths):
        raise InputError("names no recording", where=where, hint="name it with recording=PATH")
    return found


def read_record(result: Path) -> dict[str, Any]:
    """The `run.json` of a result folder.

    Raises:
        InputError: it is missing or damaged.
    """
    path = result / RECORD
    try:
        require_regular(path)
        record = json.loads(read_text(path, _MAX_RUN))
    except InputError as error:
        hint = "a result is what `stillmap map` wrote"
        raise InputError(error.what, where=error.where, hint=hint) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {error}", where=str(path)) from error
    if not isinstance(record, dict) or not isinstance(record.get("input"), dict):
        raise InputError("is no record of a run: no input named", where=str(path))
    return record
