"""A result folder opened again: its recording, its labels and its poses."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.errors import InputError
from stillmap.core.grid_map import Region
from stillmap.core.local_frame import LocalFrame
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io import read
from stillmap.io.reader import read_parts
from stillmap.io.text_lines import Progress
from stillmap.io.trajectory import poses_from_tum
from stillmap.pipeline.calibration import apply_calibration
from stillmap.results.reader import (
    RECORD,
    Grid,
    Labels,
    RunRecord,
    Track,
    read_colors,
    read_grid,
    read_labels,
    read_run,
    read_tracks,
)
from stillmap.results.run_json import read_calibration
from stillmap.slam import SlamOptions, deskew_recording


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
        frame: in which it was computed.
    """

    recording: Recording
    poses: NDArray[np.float64]
    p_static: NDArray[np.float32]
    map: Grid
    tracks: list[Track]
    slam: SlamOptions
    colors: NDArray[np.uint8] | None = None
    region: Region | None = None
    frame: LocalFrame = field(default_factory=LocalFrame)

    def deskew(self) -> Recording:
        """The recording without the motion during its scans."""
        return deskew_recording(self.recording, self.poses, self.slam)


@dataclass(frozen=True)
class ResultFolder(RunRecord):
    """A result folder.

    Attributes:
        source: where its recording is; of one in parts, where the first is.
        source_given: whether the user named the recording.
        parts: where the parts of its recording are, in order of time; empty: it is whole.
    """

    source: Path
    source_given: bool
    parts: tuple[Path, ...] = ()

    @property
    def sources(self) -> tuple[Path, ...]:
        """Path of its recording, or of all parts of it."""
        return self.parts or (self.source,)

    def require_source(self) -> Path:
        """Path of the recording.

        Raises:
            InputError: it is not there any more.
        """
        for path in self.sources:
            if not self.source_given and not path.exists():
                hint = "that is where it was when it was mapped: name it with recording=PATH"
                raise InputError("does not exist", where=str(path), hint=hint)
        return self.source

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
        if self.parts:
            recording = read_parts(
                self.parts, read_as, progress=progress, scratch=scratch, in_order=True
            )
        else:
            recording = read(source, read_as, progress=progress, scratch=scratch)
        mapped = match_labels(recording, labels, str(source))
        return recording if left_out else mapped, labels

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
            self.frame,
        )


def match_labels(recording: Recording, labels: Labels, where: str) -> Recording:
    """The recording without the returns that its map left out, which have no label.

    Raises:
        InputError: scans, beams or hits are others than those of the labels.
    """
    other, left_out = "", False
    if not np.array_equal(recording.stamp_ns, labels.stamp_ns) or not np.array_equal(
        recording.offset, labels.offset
    ):
        other = "scans or beams"
    else:
        for b in arrays.iter_blocks(recording.hit, labels.hit):
            odd = np.flatnonzero(recording.hit[b] != labels.hit[b])
            left_out |= bool(len(odd))
            if not (recording.hit[b][odd] & np.isnan(labels.p_static[b][odd])).all():
                other = "beams hit something"
    if other:
        what = f"is not the recording that was mapped: other {other}"
        raise InputError(what, where=where, hint="name it with recording=PATH")
    return _drop_unlabelled(recording, labels) if left_out else recording


def _drop_unlabelled(recording: Recording, labels: Labels) -> Recording:
    """The recording without the returns that have no label."""
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
