"""A result folder opened again: its record, and the recording that was mapped."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core import arrays, config
from stillmap.core.array_folder import parse
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io import read
from stillmap.io.reader import read_parts
from stillmap.io.text_lines import Progress
from stillmap.io.trajectory import MAX_TRANSLATION, poses_from_tum
from stillmap.pipeline.calibration import apply_calibration
from stillmap.pipeline.options import Options, OutputOptions
from stillmap.prepare.options import ReadOptions
from stillmap.results.reader import LOCAL_ORIGIN, RECORD, Labels, read_labels, read_run
from stillmap.results.run_json import read_calibration
from stillmap.slam import SlamOptions


@dataclass(frozen=True)
class ResultFolder(ShortRepr):
    """A result folder.

    Attributes:
        folder: of the result.
        record: the content of its run.json.
        sources: where its recording is, or the parts of it in order of time; empty: it has several.
        source_given: whether the user named the recording.
    """

    folder: Path
    record: dict[str, Any]
    sources: tuple[Path, ...] = ()
    source_given: bool = False

    @property
    def path(self) -> Path:
        """Of the record."""
        return self.folder / RECORD

    @property
    def options(self) -> Options:
        """Every option as it was resolved for the map; the default where the record has none.

        Raises:
            InputError: the record has options that this version does not know.
        """
        return self._resolve(self.record.get("options") or {})

    @property
    def slam_options(self) -> SlamOptions:
        """The options that deskew its recording as it was deskewed for the map."""
        return self._resolve(self._section("slam", "deskew")).slam

    @property
    def output_options(self) -> OutputOptions:
        """Region and mode of its map, the band of its obstacles, and defaults."""
        keys = "region", "map_mode", "min_obstacle_height", "max_obstacle_height"
        return self._resolve(self._section("output", *keys)).output

    def _section(self, name: str, *keys: str) -> dict[str, Any]:
        """Some entries of a section of the options in the record, those that are there."""
        section = (self.record.get("options") or {}).get(name)
        return {name: {key: section.get(key) for key in keys}} if isinstance(section, dict) else {}

    def _resolve(self, changes: dict[str, Any]) -> Options:
        """The default options with those of the record that are set."""
        try:
            return config.override(Options(), _drop_unset(changes))
        except InputError as error:
            where = str(self.folder)
            raise InputError(f"has options that cannot be: {error}", where=where) from error

    @property
    def read_options(self) -> ReadOptions:
        """The options with which its recording was read: the same beams have the same numbers.

        Raises:
            InputError: the record does not say so.
        """
        noted = self.record.get("options") or {}
        if "read" not in noted:
            raise InputError("names no options", where=str(self.path))
        return self._resolve({"read": noted["read"]}).read

    def read_origin(self, name: str = LOCAL_ORIGIN) -> Float:
        """(3,) m, an entry of the record: by default the origin of the frame in which it was
        computed; zero without the entry.

        Raises:
            InputError: it is no place.
        """
        if self.record.get(name) is None:
            return np.zeros(3)
        origin = parse(self.record[name], tuple[float, float, float], self.path)
        if not (np.abs(origin) < MAX_TRANSLATION).all():
            raise InputError(f"{name} is no place", where=str(self.path))
        return np.array(origin)

    @property
    def dimension(self) -> int:
        """Dimension of its recording, 2 or 3."""
        noted = self.record.get("dimension")  # of a session of a place
        if noted in (2, 3):
            return int(noted)
        return 3 if (self.folder / "static.ply").is_file() else 2

    def require_source(self) -> Path:
        """Path of the recording.

        Raises:
            InputError: it is not there any more.
        """
        for path in self.sources:
            if not self.source_given and not path.exists():
                hint = "that is where it was when it was mapped: name it with recording=PATH"
                raise InputError("does not exist", where=str(path), hint=hint)
        return self.sources[0]

    def read(
        self,
        progress: Progress | None = None,
        scratch: Path | None = None,
        *,
        left_out: bool = False,
    ) -> tuple[Recording, Labels]:
        """The recording, as it was mapped, and its labels.

        Args:
            progress: hears which share of the recording is read.
            scratch: folder for what is too large for memory; None: the system's temporary folder.
            left_out: with the returns that the map left out.

        Raises:
            InputError: one of them is not there, or they do not belong together.
        """
        read_as, labels = self.read_options, read_labels(self.folder)
        source = self.require_source()
        if len(self.sources) > 1:
            recording = read_parts(
                self.sources, read_as, progress=progress, scratch=scratch, in_order=True
            )
        else:
            recording = read(source, read_as, progress=progress, scratch=scratch)
        mapped = match_labels(recording, labels, str(source))
        return recording if left_out else mapped, labels

    def read_poses(self, recording: Recording) -> Float:
        """The estimated poses (T, D+1, D+1) T_map_base of a recording that was read by `read`.

        Raises:
            InputError: the trajectory is missing or damaged.
        """
        return poses_from_tum(self.folder / "trajectory.tum", recording)

    def calibrate(self, recording: Recording) -> Recording:
        """The recording with mounts and odometry as they were calibrated for the map.

        Raises:
            InputError: the record of the calibration is damaged.
        """
        try:
            found = read_calibration(self.record.get("calibration"))
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            what = f"has a damaged calibration: {error!r}"
            raise InputError(what, where=str(self.path)) from error
        if recording.dimension != 2 or len(found.lasers) != len(recording.T_base_sensor):
            return recording
        return apply_calibration(recording, found)


def match_labels(recording: Recording, labels: Labels, where: str) -> Recording:
    """The recording without the returns that its map left out, which have no label.

    Raises:
        InputError: scans, beams or hits are others than those of the labels.
    """
    is_same = np.array_equal(recording.stamp_ns, labels.stamp_ns)
    is_same = is_same and np.array_equal(recording.offset, labels.offset)
    left_out = False
    for b in arrays.iter_blocks(recording.hit, labels.hit) if is_same else ():
        odd = np.flatnonzero(recording.hit[b] != labels.hit[b])
        left_out |= bool(len(odd))
        is_same &= bool((recording.hit[b][odd] & np.isnan(labels.p_static[b][odd])).all())
    if not is_same:
        what = "is not the recording that was mapped: other scans, beams or hits"
        raise InputError(what, where=where, hint="name it with recording=PATH")
    if not left_out:
        return recording
    points = arrays.copy(recording.points, recording.scratch)
    hit = arrays.copy(recording.hit, recording.scratch)
    for b in arrays.iter_blocks(points, hit):
        points[b][hit[b] & ~labels.hit[b]] = np.nan
        hit[b] = labels.hit[b]
    return replace(recording, points=points, hit=hit)


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
    record = read_run(result)
    if recording:
        paths = [recording] if isinstance(recording, str) else [os.fspath(one) for one in recording]
    else:
        parts = record["input"].get("parts")
        noted = parts if isinstance(parts, list) and parts else [record["input"]]
        paths = [str(one.get("path") or "") if isinstance(one, dict) else "" for one in noted]
        if not all(paths):
            hint = "name it with recording=PATH"
            raise InputError("names no recording", where=str(result / RECORD), hint=hint)
    return ResultFolder(result, record, tuple(map(Path, paths)), bool(recording))


def _drop_unset(changes: dict[str, Any]) -> dict[str, Any]:
    """Nested options without those that are None."""
    return {
        key: _drop_unset(value) if isinstance(value, dict) else value
        for key, value in changes.items()
        if value is not None
    }
