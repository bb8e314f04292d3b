"""The result folder of a live run: that of `stillmap map`, and what was answered at the time."""

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npy
from stillmap.io.trajectory import write_tum
from stillmap.live.history import Answers
from stillmap.pipeline.result import MappingResult
from stillmap.results.save import save

FOLDER = "live"


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
