"""The result folder of a live run: that of `stillmap map`, and what was answered at the time."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npy
from stillmap.core.files import nearest_folder_above
from stillmap.core.profiling import Progress, no_progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.trajectory import write_tum
from stillmap.live.history import Answers, KeptScans
from stillmap.live.known_map import KnownMap
from stillmap.live.map_extension import write_extended
from stillmap.pipeline.options import Options
from stillmap.pipeline.result import MappingResult, map_recording
from stillmap.results.result import BuiltResult
from stillmap.results.save import save

FOLDER = "live"


@dataclass(frozen=True, eq=False)
class Snapshot(ShortRepr):
    """All scans so far and what is known of them, which stays while more scans are pushed.

    Attributes:
        kept: the scans, and what was answered at the time.
        poses: (T, D+1, D+1) T_map_base.
        options: see Options.
        scratch: folder of temporary files; None: the system's.
        extended: the known map that is extended; None: there is none.
    """

    kept: KeptScans
    poses: NDArray[np.float64]
    options: Options
    scratch: Path | None
    extended: KnownMap | None = None

    def build(self, progress: Progress = no_progress) -> BuiltResult:
        """Labels, map and objects at these poses."""
        scratch = None if self.kept.disk_was_full else self.scratch
        return self._map(self.kept.load(scratch)[0], progress, scratch)

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        progress: Progress = no_progress,
    ) -> None:
        """Write the result folder, as `LiveMapper.save` does; may run in a thread of its own.
        If the disk of `scratch` was full, temporary files lie where the result goes.

        Raises:
            InputError: the folder is taken or cannot be written to.
        """
        scratch = nearest_folder_above(path) if self.kept.disk_was_full else self.scratch
        recording, answers = self.kept.load(scratch)
        result = self._map(recording, progress, scratch)
        save_live(result, answers, Path(path), overwrite, extended=self.extended)

    def _map(self, recording: Recording, progress: Progress, scratch: Path | None) -> BuiltResult:
        found = map_recording(
            recording, self.options, poses=self.poses, progress=progress, scratch=scratch
        )
        return BuiltResult(**vars(found))


def save_live(
    result: MappingResult,
    answers: Answers,
    path: Path,
    overwrite: bool = False,
    *,
    extended: KnownMap | None = None,
) -> None:
    """Write a result, and `live/trajectory.tum` and `live/beams/p_static.npy` with the answers;
    with a known map, the map is that one with what was seen.

    Raises:
        InputError: `path` is taken or cannot be written to.
    """

    def write_more(folder: Path) -> None:
        _write_answers(answers, result.recording.stamp_ns, folder)
        if extended is not None:
            mode = result.options.output.map_mode
            write_extended(folder, extended.grid, extended.hits, result.map, mode)

    save(result, path, overwrite, write_more=write_more)


def _write_answers(answers: Answers, stamp_ns: NDArray[np.int64], folder: Path) -> None:
    inside = folder / FOLDER
    (inside / "beams").mkdir(parents=True)
    write_tum(inside / "trajectory.tum", stamp_ns, answers.poses)
    write_npy(inside / "beams/p_static.npy", answers.p_static)
