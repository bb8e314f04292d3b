"""A result opened from its folder, with the attributes of one that was just built."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.files import atomic_folder
from stillmap.core.input_files import copy_file
from stillmap.core.recording import Recording
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.options import Options
from stillmap.pipeline.quality import Quality
from stillmap.prepare.beam_times import add_beam_times
from stillmap.results.folder import ResultFolder, match_labels, open_result
from stillmap.results.labels import Labels, read_labels
from stillmap.results.reader import Grid, Track, read_grid, read_tracks
from stillmap.results.result import Result
from stillmap.results.run_json import RECORD, TILTING
from stillmap.results.run_record import read_record
from stillmap.slam import deskew_recording

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class SavedResult(Result):
    """A result of T scans with M beams, opened from its folder.

    Attributes:
        path: the folder.
        map: `p_occupied` (H, W), `origin`, `resolution`; `occupied` and `free` (H, W).
        poses: (T, D+1, D+1) T_map_base.
        objects: tracks of what moved.
        labels: stamps, hits and P(static), memory-mapped.
        folder: its record.
        source: the recording, its path or those of its parts, where it was given; None: as the
            record says.
    """

    path: Path
    map: Grid
    poses: Float
    objects: list[Track]
    labels: Labels
    folder: ResultFolder
    source: Recording | str | Sequence[str | os.PathLike[str]] | None = None

    __repr__ = Result.__repr__

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """(T,) stamps of the scans in nanoseconds."""
        return self.labels.stamp_ns

    @property
    def p_static(self) -> NDArray[np.float32]:
        """(M,) P(c = 1); NaN: unusable, the prior at maximum range."""
        return self.labels.p_static

    @property
    def hit(self) -> NDArray[np.bool_]:
        """(M,) whether a beam ended on something."""
        return self.labels.hit

    @property
    def run(self) -> dict[str, Any]:
        """The content of `run.json`."""
        return self.folder.record

    @property
    def quality(self) -> Quality:
        """Of labels and geometry, from 0 to 100; None where it cannot be told."""
        return self.folder.quality

    @property
    def warnings(self) -> list[str]:
        """One sentence each."""
        noted = self.run.get("warnings")
        return [str(one) for one in noted] if isinstance(noted, list) else []

    @property
    def options(self) -> Options:
        """Every option as resolved.

        Raises:
            InputError: this version does not know them.
        """
        return self.folder.options

    @cached_property
    def recording(self) -> Recording:
        """The recording as it was mapped, read when it is first used.

        Raises:
            InputError: it is not there, or is not the one that was mapped.
        """
        if isinstance(self.source, Recording):
            mapped = match_labels(self.source, self.labels, "recording")
            # read from a file, it would have them already
            recording = add_beam_times(mapped, self.folder.read_options.spin)
        else:
            recording, _ = open_result(self.path, self.source).read()
        if recording.dimension != self.poses.shape[-1] - 1:
            what = f"is in {recording.dimension}D, another dimension than the result"
            raise InputError(what, where="recording")
        return self.folder.calibrate(recording)

    @property
    def deskewed(self) -> Recording:
        """The recording without the motion during its scans, computed at every call."""
        return deskew_recording(self.recording, self.poses, self.folder.slam_options)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Copy the folder with all its files, complete or not at all.

        Args:
            path: the copy; must not exist or be empty unless `overwrite`.
            overwrite: replace an earlier result.

        Raises:
            InputError: the folder is taken or cannot be written, or lies in the result.
        """
        target = Path(path)
        if self.path.resolve() in (target.resolve(), *target.resolve().parents):
            raise InputError("is the result itself, or inside", where=str(target))
        with atomic_folder(target, RECORD, overwrite) as folder:
            shutil.copytree(self.path, folder, dirs_exist_ok=True, copy_function=copy_file)


def load(
    path: str | os.PathLike[str],
    *,
    recording: Recording | str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None = None,
) -> SavedResult:
    """Open a result folder that `stillmap map` or `save` wrote.

    Args:
        path: the folder.
        recording: what was mapped, or where it lies now, all parts in order of time; None: where
            it was then. It is read when it is first used, say for `deskewed` or the table of beams.

    Raises:
        InputError: there is no result, or a file of it is missing or damaged.

    Examples:
        >>> result = stillmap.load("out")
        >>> result.plot()
    """
    folder = Path(path)
    labels = read_labels(folder)
    given = recording is not None
    source = os.fspath(recording) if isinstance(recording, os.PathLike) else recording
    record = ResultFolder(folder, read_record(folder), Path(), given)
    return SavedResult(
        path=folder,
        map=read_grid(folder),
        poses=_read_poses(record, labels),
        objects=read_tracks(folder / "objects" / "objects.json"),
        labels=labels,
        folder=record,
        source=source,
    )


def _read_poses(record: ResultFolder, labels: Labels) -> Float:
    """(T, D+1, D+1) T_map_base."""
    folder = record.folder
    path = folder / "trajectory.tum"
    stamp_ns, poses = read_tum(path)
    if not np.array_equal(stamp_ns, labels.stamp_ns):
        what = f"has {len(stamp_ns)} poses, not one for each of {len(labels.stamp_ns)} scans"
        raise InputError(what, where=str(path))
    # a rig with a tilting laser writes clouds, but its map is that of the planar one
    is_3d = record.dimension == 3 and not (folder / TILTING).is_dir()
    return poses if is_3d else se2.project_to_plane(poses)
