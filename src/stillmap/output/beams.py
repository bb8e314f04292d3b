"""`beams/`: the label of every beam, as flat arrays that can be memory-mapped."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.output.protocols import ResultLike
from stillmap.recording.spool import blocks


def write_beams(folder: Path, result: ResultLike) -> None:
    """Write `stamp_ns` (T,), `offset` (T+1,), `p_static` (M,) and `hit` (M,) as .npy into `folder`.

    `folder` is made. Scan t owns the beams offset[t]:offset[t+1], in the recording's order.
    """
    recording = result.recording
    if result.p_static.shape != (recording.n_beams,):
        raise ValueError(f"p_static: expected ({recording.n_beams},), got {result.p_static.shape}")
    folder.mkdir()
    write_npy(folder / "stamp_ns.npy", np.asarray(recording.stamp_ns, np.int64))
    write_npy(folder / "offset.npy", np.asarray(recording.offset, np.int64))
    write_npy(folder / "p_static.npy", np.asarray(result.p_static, np.float32))
    write_npy(folder / "hit.npy", np.asarray(recording.hit, np.bool_))


def write_npy(path: Path, array: NDArray[Any]) -> None:
    """What np.save writes; of an array in a file no more than a part is in memory at a time."""
    array = np.ascontiguousarray(array).reshape(array.shape)
    header = np.lib.format.header_data_from_array_1_0(array)
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for block in blocks(array) if array.ndim else [...]:
            file.write(array[block].reshape(-1).view(np.uint8).data)
