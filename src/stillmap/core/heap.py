"""Memory of the C library's allocator, in which the kernels and NumPy's small arrays lie."""

import ctypes
import sys


def trim_heap() -> None:
    """Give freed memory back to the system, after a stage that needed much of it.

    The blocks of the kernels' grids are small: the allocator keeps them when a grid goes, one heap
    per thread, and the next stage takes others. Only glibc does so and has a function against it.
    """
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
