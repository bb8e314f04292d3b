"""The result folder of a live run: that of `stillmap map`, and what was answered at the time."""

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npy
from stillmap.core.profiling import Progress, no_progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.io.trajectory import write_tum
from stillmap.live.history import Answers
from stillmap.pipeline.options import Options
from stillmap.pipeline.result import MappingResult, map_recording
from stillmap.results.result import BuiltResult
from stillmap.results.save import save

FOLDER = "live"


@dataclass(frozen=True, eq=False)
class Snapshot(ShortRepr):
    """All scans so far and what is known of them, which stays while more scans are pushed.

    Attributes:
        recording: the scans.
        poses: (T, D+1, D+1) T_map_base.
        answers: what was answered at the time.
        options: see Options.
        scratch: folder of temporary files; None: the system's.
    """

    recording: Recording
    poses: NDArray[np.float64]
    answers: Answers
    options: Options
    scratch: Path | None

    def build(self, progress: Progress = no_progress) -> BuiltResult:
        """Labels, map and objects at these poses."""
        found = map_recording(
            self.recording, self.options, poses=self.poses, progress=progress, scratch=self.scratch
        )
        return BuiltResult(**vars(found))

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        progress: Progress = no_progress,
    ) -> None:
        """Write the result folder, as `LiveMapper.save` does; may run in a thread of its own.

        Raises:
            InputError: the folder is taken or cannot be written to.
        """
        save_live(self.build(progress), self.answers, Path(path), overwrite)


def save_live(result: MappingResult, answers: Answers, path: Path, overwrite: bool = False) -> None:
    """Write a result, and `live/trajectory.tum` and `live/beams/p_static.npy` with the answers.

    Raises:
        InputError: `path` is taken or cannot be written to.
    """
    stamps = result.recording.stamp_ns
    save(result, path, overwrite, write_more=partial(_write_answers, answers, stamps))


def _write_answers(answers: Answers, stamp_ns: NDArray[np.int64], folder: Path) -> None:
    inside = folder / FOLDER
    (inside / "beams").mkdir(parents=True)
    write_tum(inside / "trajectory.tum", stamp_ns, answers.poses)
    write_npy(inside / "beams/p_static.npy", answers.p_static)
