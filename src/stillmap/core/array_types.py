"""Types of NumPy arrays by their elements; shapes are in the docstrings."""

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Index = NDArray[np.intp]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Cells = Int64  # (..., D) indices of cells
