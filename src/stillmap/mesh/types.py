"""Array types of the mesh room, and how progress is told."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]  # also single colors
Index = NDArray[np.intp]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Tell = Callable[[int, int], None]  # called with the work done and the total


def no_tell(done: int, total: int) -> None:
    """Discards progress."""
