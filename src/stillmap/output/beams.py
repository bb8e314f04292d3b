"""`beams/`: the label of every beam, as flat arrays that can be memory-mapped."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.output.npy import write_npy
from stillmap.output.protocols import ResultLike
from stillmap.recording.model import Recording


def write_beams(folder: Path, result: ResultLike, colours: NDArray[np.uint8] | None = None) -> None:
    """Write `stamp_ns` (T,), `offset` (T+1,), `p_static` (M,) and `hit` (M,) as .npy into `folder`.

    `folder` is made. Scan t owns the beams offset[t]:offset[t+1], in the recording's order. Where
    there are colours of the beams' ends, they are written as `colour` (M, 3).
    """
    write_beams_of(folder, result.recording, result.p_static, colours)


def write_beams_of(
    folder: Path,
    recording: Recording,
    p_static: NDArray[np.float32],
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """The same of a recording with M beams and their labels (M,)."""
    if p_static.shape != (recording.n_beams,):
        raise ValueError(f"p_static: expected ({recording.n_beams},), got {p_static.shape}")
    folder.mkdir()
    write_npy(folder / "stamp_ns.npy", np.asarray(recording.stamp_ns, np.int64))
    write_npy(folder / "offset.npy", np.asarray(recording.offset, np.int64))
    write_npy(folder / "p_static.npy", np.asarray(p_static, np.float32))
    write_npy(folder / "hit.npy", np.asarray(recording.hit, np.bool_))
    if colours is not None:
        write_npy(folder / "colour.npy", colours)
