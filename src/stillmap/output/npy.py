"""Arrays as `.npy` files, whatever their size."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.spool import blocks


def write_npy(path: Path, array: NDArray[Any]) -> None:
    """What np.save writes; of an array in a file no more than a part is in memory at a time."""
    header = np.lib.format.header_data_from_array_1_0(np.empty((0, *array.shape[1:]), array.dtype))
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {**header, "shape": array.shape})
        for block in blocks(array):
            file.write(np.ascontiguousarray(array[block]).reshape(-1).view(np.uint8).data)
